"""Compiled motion of robots for one period: freely, and carefully where it is tight.

Shapes are those of `kernels`.
"""

from __future__ import annotations

import math

from numba import njit

from nics_drl_bridge.kinematics.kernels import delayed, move, rates, run, wrap
from nics_drl_bridge.sim import cell_kernels as crowd
from nics_drl_bridge.sim import contact_kernels as contacts


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def move_freely(begin, end, pose, state, history, coefficient, delay, lanes, motion):  # type: ignore[no-untyped-def]
    """Moves the robots of the worlds [begin, end) for one period as if nothing were in the way.

    Args:
        begin, end: which worlds.
        pose: (N, M, 3).
        state: (N, M, S).
        history: (N, M, H, C) commands, newest first.
        coefficient: (N, M, T) of the kinematic terms.
        delay: (N, M) of the commands [substeps].
        lanes: pose (6, L), x (V + 1, L), dq (D, L) of `kinematics.kernels.run`, coefficient
            (T, L) and late (L,), L >= n M; they hold the result.
        motion: dof, factors, count of the terms, series, (step [s], substeps per period).
    """
    where, x, dq, own, late = lanes
    dof, factors, count, series, (dt, substeps) = motion
    robots, size = pose.shape[1], state.shape[2]
    for n in range(begin, end):
        for m in range(robots):
            i = (n - begin) * robots + m
            where[0, i], where[1, i], where[4, i] = pose[n, m, 0], pose[n, m, 1], pose[n, m, 2]
            where[2, i], where[3, i] = math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2])
            where[5, i] = 0.0
            for s in range(size):
                x[s, i] = state[n, m, s]
            for t in range(own.shape[0]):
                own[t, i] = coefficient[n, m, t]
            late[i] = delay[n, m] % substeps  # its command changes once, after so many substeps
    at, used = 0, (end - begin) * robots
    while at < substeps:
        until = substeps
        for i in range(used):
            if late[i] > at:
                until = min(until, late[i])
            if late[i] == at or at == 0:
                n, m = begin + i // robots, i % robots
                row = delayed(at, delay[n, m], substeps, history.shape[2])
                for c in range(history.shape[3]):
                    x[size + c, i] = history[n, m, row, c]
        run(where, x, dq, (dof, own, factors, count), series, dt, until - at)
        at = until


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def move_carefully(  # type: ignore[no-untyped-def]
    n, meets, near, state, history, coefficient, delay, bodies, velocity, moving, walls, grid,
    collided, pose, outlines, motion, room,
):  # fmt: skip
    """Moves robots of one world for one period, looking for touches after each substep.

    A robot that touches something is marked and gets no deeper into it; it may leave. A free
    one moves exactly as by `move_freely`.

    Args:
        n: which world.
        meets: (M,) what each robot may meet; those that meet nothing are left alone.
        near: see `contact_kernels.find_near`.
        state, history, coefficient, delay, motion: see `move_freely`.
        bodies: (N, K + M, 7) obstacles, then robots, see `lidar.shapes.BODY`; in place.
        velocity, moving: of the obstacles, and whether any has one.
        walls: (W, 4).
        grid: see `collision_kernels`.
        collided: (N, M) set to 1 by a touch.
        pose: (N, M, 3), in place.
        outlines: corners and where each outline begins.
        room: x (V + 1,), dq (D,), trial (7,), spare (F, 2), start (K, 3): scratch.
    """
    x, dq, trial, spare, start = room
    dof, factors, count, series, (dt, substeps) = motion
    first, world = velocity.shape[1], bodies[n]
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            place_robot(bodies, n, first + m, pose[n, m])
    for j in range(substeps):
        if moving:
            contacts.move_obstacles(bodies, start, velocity, n, (j + 1) * dt)
        for m in range(meets.shape[0]):
            if meets[m] == contacts.FREE:
                continue
            me, terms = first + m, (dof, coefficient[n, m], factors, count)
            rates_at(j, dq, x, state, history, n, m, delay[n, m], substeps, terms)
            _advance(trial, world[me], dq, dt, series)
            for s in range(state.shape[2]):
                state[n, m, s] += dt * dq[3 + s]
            free, whom = contacts.contact(
                trial, m, meets[m], near, world, walls, grid, outlines, spare
            )
            if free < 0.0:
                collided[n, m] = 1
                before, _ = contacts.contact(
                    world[me], m, meets[m], near, world, walls, grid, outlines, spare
                )
                if before < 0.0 and free < before:
                    continue
                if whom >= first:
                    collided[n, whom - first] = 1
            for i in range(5):
                world[me, i] = trial[i]
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            for i in range(3):
                pose[n, m, i] = world[first + m, i]


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False, forceinline=True)
def _advance(trial, body, dq, dt, series):  # type: ignore[no-untyped-def]
    """Puts into `trial` (7,) where a body (7,) of rates dq is after a substep."""
    turn = dq[2] * dt
    trial[0], trial[1], trial[3], trial[4] = move(
        body[0], body[1], body[3], body[4], dq[0], dq[1], turn, dt, series
    )
    trial[2] = body[2] + turn
    trial[5], trial[6] = body[5], body[6]


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False, forceinline=True)
def rates_at(j, dq, x, state, history, n, m, delay, substeps, terms):  # type: ignore[no-untyped-def]
    """Rates dq in substep j of a period, under the command that is then in effect."""
    row = delayed(j, delay, substeps, history.shape[2])
    size = state.shape[2]
    for s in range(size):
        x[s] = state[n, m, s]
    for c in range(history.shape[3]):
        x[size + c] = history[n, m, row, c]
    rates(dq, x, terms)


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def move_world(  # type: ignore[no-untyped-def]
    n, skip, pose, state, history, coefficient, delay, bodies, velocity, walls, grid, collided,
    crowded, outlines, lanes, motion, cells, found, robot, room,
):  # fmt: skip
    """Moves obstacles and robots of one world: freely, and carefully where it is tight.

    Args:
        n: which world.
        skip: the lane of its first robot.
        crowded: whether its bodies are to be sorted into cells.
        cells, found: see `cell_kernels`.
        robot: near (M, 1 + SEVERAL), meets (M,), way (M,), reach (K + M,), and one more: scratch.
        pose and others: see the functions above.
    """
    where, x = lanes[0], lanes[1]
    near, meets, way, reach, _ = robot
    start = room[4]
    dt, substeps = motion[4]
    robots, size, first = pose.shape[1], state.shape[2], velocity.shape[1]
    for m in range(robots):
        way[m] = where[5, skip + m]
    longest, moving = contacts.reaches(reach, bodies, velocity, way, n, dt * substeps)
    if crowded:
        crowd.sort_bodies(bodies, n, cells)
        cells[3][crowd.MOVED] = longest
    tight = False
    for m in range(robots):
        meets[m] = contacts.find_near(near, m, reach, bodies, n, walls, grid, crowded, cells, found)
        tight = tight or meets[m] != contacts.FREE
    for m in range(robots):
        if meets[m] == contacts.FREE:
            i = skip + m
            pose[n, m, 0], pose[n, m, 1], pose[n, m, 2] = where[0, i], where[1, i], where[4, i]
            for s in range(size):
                state[n, m, s] = x[s, i]
    if moving:
        for k in range(first):
            for i in range(3):
                start[k, i] = bodies[n, k, i]
    if tight:
        move_carefully(
            n, meets, near, state, history, coefficient, delay, bodies, velocity, moving, walls,
            grid, collided, pose, outlines, motion, room,
        )  # fmt: skip
    elif moving:
        contacts.move_obstacles(bodies, start, velocity, n, substeps * dt)
    for m in range(robots):
        pose[n, m, 2] = wrap(pose[n, m, 2])


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def place_robot(bodies, n, k, pose):  # type: ignore[no-untyped-def]
    """Puts body k of world n to a robot's pose (3,)."""
    bodies[n, k, 0], bodies[n, k, 1], bodies[n, k, 2] = pose[0], pose[1], pose[2]
    bodies[n, k, 3], bodies[n, k, 4] = math.cos(pose[2]), math.sin(pose[2])
