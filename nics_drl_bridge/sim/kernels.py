"""Compiled inner loops of the simulator: motion, and the step of some worlds.

What one robot does is a scalar function; the batched loops call it. Shapes: N worlds, n of them
in one part, M robots, S state, C command, T kinematic terms, H periods of command history, K
obstacles, W walls, B beams, L lanes.

A world comes to the same bits in whatever batch, part or thread it is: nothing is summed over
worlds, and what is drawn at random is drawn by the world's own seed and counter.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numba.experimental import structref

from nics_drl_bridge.kinematics.kernels import delayed, move, rates, run, wrap
from nics_drl_bridge.sim import cell_kernels as crowd
from nics_drl_bridge.sim import contact_kernels as contacts
from nics_drl_bridge.sim import motion_kernels as obstacles
from nics_drl_bridge.sim import sensing_kernels as sensing


@structref.register
class PackedType(types.StructRef):  # type: ignore[misc]
    """The type of `Packed`."""


class Packed(structref.StructRefProxy):  # type: ignore[misc]
    """All arrays of a part as one argument: to hand over a hundred took longer than a step."""


structref.define_proxy(Packed, PackedType, ["content"])


@njit(cache=True)
def pack(content):  # type: ignore[no-untyped-def]
    """Makes one argument of nested tuples of arrays."""
    return Packed(content)


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
    size, first = state.shape[2], velocity.shape[1]
    world = bodies[n]
    for m in range(meets.shape[0]):
        if meets[m] != contacts.FREE:
            place_robot(bodies, n, first + m, pose[n, m])
    for j in range(substeps):
        if moving:
            contacts.move_obstacles(bodies, start, velocity, n, (j + 1) * dt)
        for m in range(meets.shape[0]):
            if meets[m] == contacts.FREE:
                continue
            me = first + m
            row = delayed(j, delay[n, m], substeps, history.shape[2])
            for s in range(size):
                x[s] = state[n, m, s]
            for c in range(history.shape[3]):
                x[size + c] = history[n, m, row, c]
            rates(dq, x, (dof, coefficient[n, m], factors, count))
            turn = dq[2] * dt
            trial[0], trial[1], trial[3], trial[4] = move(
                world[me, 0], world[me, 1], world[me, 3], world[me, 4], dq[0], dq[1], turn, dt,
                series,
            )  # fmt: skip
            trial[2] = world[me, 2] + turn
            trial[5], trial[6] = world[me, 5], world[me, 6]
            for s in range(size):
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


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def _send(history, commands, begin):  # type: ignore[no-untyped-def]
    """Puts the commands (n, M, C) of the worlds from `begin` on in front of those sent before."""
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            for h in range(history.shape[2] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    history[begin + i, m, h, c] = history[begin + i, m, h - 1, c]
            for c in range(commands.shape[2]):
                history[begin + i, m, 0, c] = commands[i, m, c]


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def _note_ways(cells, before, skip, pose, n):  # type: ignore[no-untyped-def]
    """Tells the cells how far the robots of world n came, drift included."""
    for m in range(pose.shape[1]):
        dx, dy = pose[n, m, 0] - before[skip + m, 0], pose[n, m, 1] - before[skip + m, 1]
        cells[3][crowd.MOVED] = max(cells[3][crowd.MOVED], math.sqrt(dx * dx + dy * dy))


@njit(cache=True, nogil=True)
def step_worlds(packed, commands, begin):  # type: ignore[no-untyped-def]
    """One control period of the worlds of a part.

    Args:
        packed: holds the fields of `worlds.Worlds` in order, updated in place, and what
            `worlds.arguments` says.
        commands: (n, M, C).
        begin: the first world.
    """
    fields, scene, view, motion, room = packed.content
    _step(fields, scene, view, motion, room, commands, begin)


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def _step(fields, scene, view, motion, room, commands, begin):  # type: ignore[no-untyped-def]
    """See `step_worlds`; no counting of references, which took longer than the step."""
    (
        pose, state, history, bodies, odom, twist, ranges, collided, steps, seeds, faults,
        coefficient, delay, age, noise, velocity, past, marks,
    ) = fields  # fmt: skip
    walls, grid, outlines, crowded, scattered, movers = scene
    lanes, single, robot, crowding, sensors = room
    cells, found = crowding
    dof, factors, count, series, (dt, substeps) = motion
    x, dq, before = single[0], single[1], sensors[0]
    robots, first, end = pose.shape[1], velocity.shape[1], begin + commands.shape[0]
    _send(history, commands, begin)
    block = lanes[0].shape[1] // robots
    for low in range(begin, end, block):
        high = min(low + block, end)
        for n in range(low, high):
            if movers[0]:
                steer_world(
                    n, velocity, marks, bodies, pose, past, steps[n], walls, movers, seeds[n],
                    dt * substeps, robot[4],
                )  # fmt: skip
            for m in range(robots):
                i = (n - low) * robots + m
                before[i, 0], before[i, 1], before[i, 2] = (
                    pose[n, m, 0],
                    pose[n, m, 1],
                    pose[n, m, 2],
                )
                if steps[n] == 0:
                    sensing.begin(past, n, m, pose, odom, twist)
        move_freely(low, high, pose, state, history, coefficient, delay, lanes, motion)
        together = np.int64(0)
        for n in range(low, high):
            steps[n] += 1
            move_world(
                n, (n - low) * robots, pose, state, history, coefficient, delay, bodies, velocity,
                walls, grid, collided, crowded, outlines, lanes, motion, cells, found, robot,
                single,
            )  # fmt: skip
            for m in range(robots):
                counter = steps[n] * robots + m
                if collided[n, m] == 0:
                    sensing.disturb(
                        pose, state, noise, n, m, seeds[n], counter, dt * substeps, series
                    )
                place_robot(bodies, n, first + m, pose[n, m])
                _rates_now(
                    dq, x, state, history, n, m, delay[n, m], substeps,
                    (dof, coefficient[n, m], factors, count),
                )  # fmt: skip
                sensing.measure(
                    odom, twist, past, before[(n - low) * robots + m], pose, n, m, dq, noise,
                    steps[n], seeds[n], counter, age[n, m], dt, substeps, series,
                )  # fmt: skip
            if crowded:
                _note_ways(cells, before, (n - low) * robots, pose, n)
            if scattered or sensing.needs_own(n, age, faults):
                sensing.look_alone(
                    n, pose, bodies, ranges, steps, faults, age, velocity, past, walls, scattered,
                    view, sensors, crowding, dt, substeps,
                )  # fmt: skip
            else:
                sensors[1][together] = n
                together += 1
        sensing.look_together(together, pose, bodies, ranges, first, walls, view, sensors)
        sensing.distort(low, high, ranges, faults, steps, seeds, view)


@njit(cache=True, nogil=True)
def steer_world(n, velocity, marks, bodies, pose, past, step, walls, movers, seed, period, speeds):  # type: ignore[no-untyped-def]
    """Sets the velocities of the obstacles of world n for the period that begins.

    Args:
        movers: see `worlds.arguments`.
        speeds: (M, 2) scratch.
        velocity and others: the fields of `worlds.Worlds`.
    """
    _, plans, half, distances = movers
    row = step % past.shape[2]
    for m in range(pose.shape[1]):
        vx = vy = 0.0
        if step > 0:
            vx, vy = past[n, m, row, sensing.TWIST], past[n, m, row, sensing.TWIST + 1]
        c, s = math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2])
        speeds[m, 0], speeds[m, 1] = c * vx - s * vy, s * vx + c * vy
    obstacles.steer(
        velocity, marks, n, bodies, velocity.shape[1], speeds, plans, walls, half, seed, step,
        period, distances,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def begin(packed, chosen):  # type: ignore[no-untyped-def]
    """Begins episodes in the worlds `chosen` (n,), whose robots and obstacles are in place.

    Their moving obstacles draw what they need, and the robots take their first scans.
    """
    fields, scene, view, _, room = packed.content
    bodies, seeds, marks = fields[3], fields[9], fields[17]
    moves, plans, half, _ = scene[5]
    if moves:
        for n in chosen:
            obstacles.begin(marks, n, bodies, plans, half, seeds[n])
    _look(fields, scene, view, room, chosen)


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def _look(fields, scene, view, room, chosen):  # type: ignore[no-untyped-def]
    """Scans as the episodes begin: all stands still, so that no scan is older or skewed."""
    pose, bodies, ranges, steps, seeds, faults, velocity = (
        fields[0], fields[3], fields[6], fields[8], fields[9], fields[10], fields[15],
    )  # fmt: skip
    sensors = room[4]
    for i in range(chosen.shape[0]):
        sensors[1][i] = chosen[i]
    sensing.look_together(
        chosen.shape[0], pose, bodies, ranges, velocity.shape[1], scene[0], view, sensors
    )
    for n in chosen:
        sensing.distort(n, n + 1, ranges, faults, steps, seeds, view)


@njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
def _rates_now(dq, x, state, history, n, m, delay, substeps, terms):  # type: ignore[no-untyped-def]
    """Rates at the end of a period, under the command that was in effect last."""
    row = delayed(substeps - 1, delay, substeps, history.shape[2])
    size = state.shape[2]
    for s in range(size):
        x[s] = state[n, m, s]
    for c in range(history.shape[3]):
        x[size + c] = history[n, m, row, c]
    rates(dq, x, terms)
