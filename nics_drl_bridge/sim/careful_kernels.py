"""Compiled motion of the robots of one world in tight spots, up to their contacts.

All bodies move at the same time. At the first contact, each body that approached the other stops:
a robot until the end of the substep, an obstacle until the end of the period. Then the next
contact is sought. Shapes are those of `kernels`; `flights`, `events` and `scene` those of
`impact_kernels`.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.robot.kernels import delayed, move, rates, wrap
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import impact_kernels as impact
from nics_drl_bridge.sim.impact_kernels import (
    AFTER,
    DEPTH,
    NOTHING,
    OTHERS,
    OWN,
    STOP,
    TIME,
    TURN,
    VX,
    VY,
    WITH,
)
from nics_drl_bridge.sim.sensing_kernels import drift_of

SHARE = 1e-3
"""A body that contributes less than this share of the closing speed is not stopped."""
SMALL = 0.1
"""Step, in radii, by which an overlapping robot is moved to test whether it gets out."""
MOST_MOVES = 1000


@kernel
def rates_at(j, dq, x, state, history, n, m, delay, substeps, terms):  # type: ignore[no-untyped-def]
    """Computes the rates dq in substep j of a period, under the command then in effect."""
    row = delayed(j, delay, substeps, history.shape[2])
    size = state.shape[2]
    for s in range(size):
        x[s] = state[n, m, s]
    for c in range(history.shape[3]):
        x[size + c] = history[n, m, row, c]
    rates(dq, x, terms)


@kernel
def _put(body, base, flight, time, series):  # type: ignore[no-untyped-def]
    """Writes to `body` (7,) a robot that began at `base` (7,), after `time` [s]."""
    turn = flight[TURN] * time
    body[0], body[1], body[3], body[4] = move(
        base[0], base[1], base[3], base[4], flight[VX], flight[VY], turn, time, series
    )
    body[2] = base[2] + turn
    body[5], body[6] = base[5], base[6]


@kernel
def _first_touch(m, begin, until, tight, events, scene):  # type: ignore[no-untyped-def]
    """Finds the first contact of robot m from a time of the substep on, see `impact_kernels`."""
    meets, near, walls, grid = tight
    world, _, first, _, _ = scene
    event, me = events[m], first + m
    event[TIME] = until
    if meets[m] & contacts.BODIES and event[DEPTH] >= 0.0:
        listed = near[m, 0] <= contacts.SEVERAL
        for i in range(near[m, 0] if listed else world.shape[0]):
            k = near[m, 1 + i] if listed else i
            if k != me and world[k, 5] > 0.0:
                impact.touch_body(event, me, k, begin, scene)
    if meets[m] & contacts.WALLS and event[DEPTH] >= 0.0:
        impact.touch_walls(event, me, walls, begin, scene)
    if meets[m] & contacts.MAP and event[DEPTH] >= 0.0:
        impact.touch_map(event, me, grid, begin, scene)


@kernel
def _leave(m, until, tight, events, scene, trial, spare):  # type: ignore[no-untyped-def]
    """Moves a robot that overlaps something for as long as it gets no deeper."""
    meets, near, walls, grid = tight
    world, flights, first, outlines, series = scene
    flight, me = flights[first + m], first + m
    way = math.sqrt(flight[VX] ** 2 + flight[VY] ** 2) + abs(flight[TURN]) * world[me, 5]
    moves = int(min(max(math.ceil(way * until / (SMALL * world[me, 5])), 1), MOST_MOVES))
    flight[STOP], events[m, AFTER] = 0.0, events[m, DEPTH]
    for i in range(1, moves + 1):
        time = until if i == moves else until * i / moves
        _put(trial, world[me], flight, time, series)
        depth, _ = contacts.contact(
            trial, m, meets[m], near, world, walls, grid, outlines, spare, 0.0
        )
        if depth < events[m, AFTER]:
            break
        events[m, AFTER], flight[STOP] = depth, time


@kernel
def _within(p, b, until, world, flights, first):  # type: ignore[no-untyped-def]
    """True if robot p may come near body b within the substep."""
    a = first + p
    dx, dy = world[a, 0] - world[b, 0], world[a, 1] - world[b, 1]
    ways = impact.speed_at(a, -1.0, flights) + impact.speed_at(b, -1.0, flights)
    far = world[a, 5] + world[b, 5] + ways * until + impact.SLACK
    return dx * dx + dy * dy <= far * far


@kernel
def _settle(until, tight, events, touched, scene):  # type: ignore[no-untyped-def]
    """Stops the bodies of a world at their contacts within a substep, in order of time.

    Args:
        until: length of the substep [s].
        tight: what each robot may meet, bodies near it, walls and map, see `contact_kernels`.
        events: (M, EVENT), updated in place.
        touched: (M,) set to 1 by a contact.
        scene: its `flights` are updated in place.
    """
    world, flights, first, _, _ = scene
    meets, robots = tight[0], events.shape[0]
    for m in range(robots):
        events[m, TIME] = until
        if meets[m] != contacts.FREE:
            _first_touch(m, 0.0, until, tight, events, scene)
    for _ in range(2 * world.shape[0] + 2):
        m = 0
        for p in range(1, robots):
            if events[p, TIME] < events[m, TIME]:
                m = p
        time, k = events[m, TIME], int(events[m, WITH])
        if time >= until:
            return
        own, others = -events[m, OWN], -events[m, OTHERS]
        touched[m] = 1
        if k >= first:
            touched[k - first] = 1
        if own >= SHARE * (own + others):
            flights[first + m, STOP] = min(flights[first + m, STOP], time)
        if k >= 0 and others >= SHARE * (own + others):
            flights[k, STOP] = min(flights[k, STOP], time)
        for p in range(robots):
            if meets[p] != contacts.FREE and (
                p == m
                or _within(p, first + m, until, world, flights, first)
                or (k >= 0 and _within(p, k, until, world, flights, first))
            ):
                _first_touch(p, time, until, tight, events, scene)


@kernel
def _begin_substep(n, time, dt, velocity, moving, bodies, start, flights):  # type: ignore[no-untyped-def]
    """Places the obstacles at a time of the period and sets their flights from there."""
    if moving:
        contacts.move_obstacles(bodies, start, velocity, n, time)
    for k in range(velocity.shape[1]):
        flights[k, VX], flights[k, VY] = velocity[n, k, 0], velocity[n, k, 1]
        flights[k, TURN], flights[k, STOP] = velocity[n, k, 2], dt


@kernel
def _hold_obstacles(n, time, dt, velocity, bodies, start, flights):  # type: ignore[no-untyped-def]
    """Keeps obstacles at rest that were stopped within the substep that begins at `time`."""
    for k in range(velocity.shape[1]):
        stop = flights[k, STOP]
        if stop < dt:
            start[k, 0] = bodies[n, k, 0] + velocity[n, k, 0] * stop
            start[k, 1] = bodies[n, k, 1] + velocity[n, k, 1] * stop
            start[k, 2] = wrap(bodies[n, k, 2] + velocity[n, k, 2] * stop)
            contacts.put_body(bodies, n, k, start[k])
            for i in range(3):
                velocity[n, k, i] = 0.0


@kernel
def move_carefully(  # type: ignore[no-untyped-def]
    n, meets, near, state, history, coefficient, delay, bodies, velocity, moving, walls, grid,
    collided, pose, outlines, motion, room,
):  # fmt: skip
    """Moves the robots of one world by one period, up to their contacts.

    A robot in contact is marked and stops for the rest of the substep, and again in the next ones
    while it would come nearer; it may move away. A robot that already overlaps something gets no
    deeper. Without a contact it moves exactly as in `robot_kernels.move_freely`.

    Args:
        n: index of the world.
        meets: (M,) what each robot may meet; those that meet nothing are not moved.
        near: see `contact_kernels.find_near`.
        state, history, coefficient, delay, motion: see `robot_kernels.move_freely`.
        bodies: (N, K + M, 7) obstacles, then robots, see `lidar.shapes.BODY`; in place.
        velocity, moving: velocities of the obstacles, and whether any moves. An obstacle stopped
            by a robot is left with its mean velocity over the period.
        walls: (W, 4).
        grid: see `collision_kernels`.
        collided: (N, M) set to 1 by a contact.
        pose: (N, M, 3), in place.
        outlines: corners, and the first corner of each outline.
        room: see `worlds.arguments`.
    """
    x, dq, trial, spare, start, began, flights, events = room
    dof, factors, count, series, (dt, substeps) = motion
    first, world, touched = velocity.shape[1], bodies[n], collided[n]
    tight = (meets, near, walls, grid)
    scene = (world, flights, first, outlines, series)
    for m in range(meets.shape[0]):
        flights[first + m, :] = 0.0
        if meets[m] != contacts.FREE:
            contacts.put_body(bodies, n, first + m, pose[n, m])
            _look_within(m, tight, events, touched, scene, spare)
    for j in range(substeps):
        _begin_substep(n, j * dt, dt, velocity, moving, bodies, start, flights)
        for m in range(meets.shape[0]):
            if meets[m] != contacts.FREE:
                terms = (dof, coefficient[n, m], factors, count)
                rates_at(j, dq, x, state, history, n, m, delay[n, m], substeps, terms)
                flight = flights[first + m]
                flight[VX], flight[VY], flight[TURN], flight[STOP] = dq[0], dq[1], dq[2], dt
                for s in range(state.shape[2]):
                    state[n, m, s] += dt * dq[3 + s]
                if events[m, DEPTH] < 0.0:
                    _leave(m, dt, tight, events, scene, trial, spare)
        _settle(dt, tight, events, touched, scene)
        _arrive(meets, events, scene, trial)
        if moving:
            _hold_obstacles(n, j * dt, dt, velocity, bodies, start, flights)
    if moving:
        contacts.move_obstacles(bodies, start, velocity, n, substeps * dt)
        _tell_velocities(n, substeps * dt, velocity, bodies, start, began)
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            for i in range(3):
                pose[n, m, i] = world[first + m, i]


@kernel
def _look_within(m, tight, events, touched, scene, spare):  # type: ignore[no-untyped-def]
    """Records how deep robot m overlaps anything as the period begins; marks it if it does."""
    meets, near, walls, grid = tight
    world, _, first, outlines, _ = scene
    depth, whom = contacts.contact(
        world[first + m], m, meets[m], near, world, walls, grid, outlines, spare, 2.0 * NOTHING
    )
    events[m, DEPTH] = min(depth, -np.finfo(np.float64).tiny) if depth <= NOTHING else 0.0
    if depth < 0.0:
        touched[m] = 1
        if whom >= first:
            touched[whom - first] = 1


@kernel
def _arrive(meets, events, scene, trial):  # type: ignore[no-untyped-def]
    """Moves the robots to their poses at the end of the substep."""
    world, flights, first, _, series = scene
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            flight = flights[first + m]
            _put(trial, world[first + m], flight, flight[STOP], series)
            for i in range(5):
                world[first + m, i] = trial[i]
            if events[m, DEPTH] < 0.0:
                events[m, DEPTH] = events[m, AFTER]


@kernel
def _tell_velocities(n, period, velocity, bodies, start, began):  # type: ignore[no-untyped-def]
    """Sets the velocity of stopped obstacles to their mean over the period."""
    for k in range(velocity.shape[1]):
        stopped = start[k, 0] != began[k, 0] or start[k, 1] != began[k, 1]
        if stopped or start[k, 2] != began[k, 2]:
            for i in range(2):
                velocity[n, k, i] = (bodies[n, k, i] - began[k, i]) / period
            velocity[n, k, 2] = wrap(bodies[n, k, 2] - began[k, 2]) / period


@kernel
def drift_carefully(  # type: ignore[no-untyped-def]
    n, meets, near, state, noise, seed, step, bodies, walls, grid, collided, pose, outlines, motion,
    room,
):  # fmt: skip
    """Lets the robots of one world drift, one after the other, up to their contacts.

    Args:
        noise, seed: see `sensing_kernels.drift_of`.
        step: number of the period, from 1.
        n and others: see `move_carefully`.
    """
    flights, events = room[6], room[7]
    series, (dt, substeps) = motion[3], motion[4]
    world, robots = bodies[n], pose.shape[1]
    first = world.shape[0] - robots
    tight, scene = (meets, near, walls, grid), (world, flights, first, outlines, series)
    stood = False
    for m in range(robots):
        if collided[n, m] != 0:
            continue
        ahead, aside, turn = drift_of(state, noise, n, m, seed, step * robots + m, dt * substeps)
        if ahead == 0.0 and aside == 0.0 and turn == 0.0:
            continue
        stop = 1.0
        if meets[m] != contacts.FREE:
            flight = flights[first + m]
            if not stood:
                flights[:], stood = 0.0, True
            contacts.put_body(bodies, n, first + m, pose[n, m])
            flight[VX], flight[VY], flight[TURN], flight[STOP] = ahead, aside, turn, 1.0
            events[m, DEPTH] = 0.0
            _first_touch(m, 0.0, 1.0, tight, events, scene)
            flight[STOP] = 0.0
            if events[m, TIME] < 1.0:
                stop, collided[n, m] = events[m, TIME], 1
                if events[m, WITH] >= first:
                    collided[n, int(events[m, WITH]) - first] = 1
        x, y, _, _ = move(
            pose[n, m, 0], pose[n, m, 1], math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2]),
            ahead, aside, turn * stop, stop, series,
        )  # fmt: skip
        pose[n, m, 0], pose[n, m, 1], pose[n, m, 2] = x, y, wrap(pose[n, m, 2] + turn * stop)
        if meets[m] != contacts.FREE:
            contacts.put_body(bodies, n, first + m, pose[n, m])
