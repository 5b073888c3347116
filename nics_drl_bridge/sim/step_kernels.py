"""Compiled inner loops of the simulator: motion, and the step of a batch of worlds.

The motion of one robot is a scalar function, which the batched loops call. Shapes: N worlds, n of
them in one part, M robots, S state, C command, T kinematic terms, H periods of command history, K
obstacles, W walls, B beams, L lanes.

A world is bit-identical in any batch, part or thread: nothing is summed over worlds, and random
numbers are drawn from the world's own seed and counter.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numba.experimental import structref

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim import contact_kernels as crowd
from nics_drl_bridge.sim import obstacle_kernels as obstacles
from nics_drl_bridge.sim import robot_kernels as robots
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim import sensing_kernels as sight
from nics_drl_bridge.sim.careful_kernels import rates_at
from nics_drl_bridge.sim.contact_kernels import put_body


@structref.register
class PackedType(types.StructRef):  # type: ignore[misc]
    """The type of `Packed`."""


class Packed(structref.StructRefProxy):  # type: ignore[misc]
    """All arrays of a part as one argument: passing a hundred took longer than a step."""


structref.define_proxy(Packed, PackedType, ["content"])


@kernel(allocates=True)
def pack(content):  # type: ignore[no-untyped-def]
    """Packs nested tuples of arrays into one argument."""
    return Packed(content)


@kernel
def _send(history, commands, begin):  # type: ignore[no-untyped-def]
    """Puts the commands (n, M, C) of the worlds from `begin` on at the front of the history."""
    for i in range(commands.shape[0]):
        for m in range(commands.shape[1]):
            for h in range(history.shape[2] - 1, 0, -1):
                for c in range(commands.shape[2]):
                    history[begin + i, m, h, c] = history[begin + i, m, h - 1, c]
            for c in range(commands.shape[2]):
                history[begin + i, m, 0, c] = commands[i, m, c]


@kernel
def _note_ways(cells, before, skip, pose, n):  # type: ignore[no-untyped-def]
    """Records in the cells how far the robots of world n moved, drift included."""
    for m in range(pose.shape[1]):
        dx, dy = pose[n, m, 0] - before[skip + m, 0], pose[n, m, 1] - before[skip + m, 1]
        cells[3][crowd.MOVED] = max(cells[3][crowd.MOVED], math.sqrt(dx * dx + dy * dy))


@kernel(allocates=True)
def step_worlds(packed, commands, begin):  # type: ignore[no-untyped-def]
    """Advances the worlds of a part by one control period.

    Args:
        packed: the fields of `worlds.Worlds` in order, updated in place, and the others that
            `worlds.arguments` returns.
        commands: (n, M, C).
        begin: index of the first world.
    """
    fields, scene, view, motion, room = packed.content
    _step(fields, scene, view, motion, room, commands, begin)


@kernel
def _step(fields, scene, view, motion, room, commands, begin):  # type: ignore[no-untyped-def]
    """See `step_worlds`; without reference counting, which took longer than the step."""
    (
        pose, state, history, bodies, _, _, ranges, collided, steps, seeds, faults, coefficient,
        delay, age, noise, velocity, past, _,
    ) = fields  # fmt: skip
    walls, grid, outlines, crowded, scattered, _ = scene
    lanes, single, robot, crowding, sensors = room
    cells, found = crowding
    dt, substeps = motion[4]
    many, end = pose.shape[1], begin + commands.shape[0]
    _send(history, commands, begin)
    block = lanes[0].shape[1] // many
    for low in range(begin, end, block):
        high = min(low + block, end)
        _begin_period(low, high, fields, scene, motion, room)
        robots.move_freely(low, high, pose, state, history, coefficient, delay, lanes, motion)
        together = np.int64(0)
        for n in range(low, high):
            steps[n] += 1
            skip = (n - low) * many
            robots.move_world(
                n, skip, pose, state, history, coefficient, delay, bodies, velocity, walls, grid,
                collided, crowded, outlines, lanes, motion, cells, found, robot, single, noise,
                seeds[n], steps[n],
            )  # fmt: skip
            _measure(n, skip, fields, motion, single, sensors[0])
            if crowded:
                _note_ways(cells, sensors[0], skip, pose, n)
            together = sight.look_or_wait(
                n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls,
                scattered, view, sensors, crowding, dt, substeps,
            )  # fmt: skip
        sight.look_together(together, pose, bodies, ranges, velocity.shape[1], walls, view, sensors)
        sight.distort(low, high, ranges, faults, steps, seeds, view)


@kernel(inline=True)
def _begin_period(low, high, fields, scene, motion, room):  # type: ignore[no-untyped-def]
    """Sets the velocities of the obstacles of the worlds [low, high) and records the poses."""
    pose, bodies, odom, twist = fields[0], fields[3], fields[4], fields[5]
    steps, seeds, velocity, past, marks = fields[8], fields[9], fields[15], fields[16], fields[17]
    walls, movers, (dt, substeps), before = scene[0], scene[5], motion[4], room[4][0]
    for n in range(low, high):
        if movers[0]:
            steer_world(
                n, velocity, marks, bodies, pose, past, steps[n], walls, movers, seeds[n],
                dt * substeps, room[2][4],
            )  # fmt: skip
        for m in range(pose.shape[1]):
            i = (n - low) * pose.shape[1] + m
            before[i, 0], before[i, 1], before[i, 2] = pose[n, m, 0], pose[n, m, 1], pose[n, m, 2]
            if steps[n] == 0:
                sensing.begin(past, n, m, pose, odom, twist)


@kernel(inline=True)
def _measure(n, skip, fields, motion, single, before):  # type: ignore[no-untyped-def]
    """Moves the bodies of the robots of world n to their poses and measures their odometry."""
    (
        pose, state, history, bodies, odom, twist, _, _, steps, seeds, _, coefficient,
        delay, age, noise, velocity, past, _,
    ) = fields  # fmt: skip
    dof, factors, count, series, (dt, substeps) = motion
    x, dq = single[0], single[1]
    for m in range(pose.shape[1]):
        counter, terms = steps[n] * pose.shape[1] + m, (dof, coefficient[n, m], factors, count)
        put_body(bodies, n, velocity.shape[1] + m, pose[n, m])
        rates_at(substeps - 1, dq, x, state, history, n, m, delay[n, m], substeps, terms)
        sensing.measure(
            odom, twist, past, before[skip + m], pose, n, m, dq, noise, steps[n], seeds[n],
            counter, age[n, m], dt, substeps, series,
        )  # fmt: skip


@kernel(allocates=True)
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


@kernel(allocates=True)
def begin(packed, chosen):  # type: ignore[no-untyped-def]
    """Begins episodes in the worlds `chosen` (n,), whose robots and obstacles are in place.

    Draws the speeds and directions of moving obstacles and takes the first scans.
    """
    fields, scene, view, _, room = packed.content
    bodies, seeds, marks = fields[3], fields[9], fields[17]
    moves, plans, half, _ = scene[5]
    if moves:
        for n in chosen:
            obstacles.begin(marks, n, bodies, plans, half, seeds[n])
    _look(fields, scene, view, room, chosen)


@kernel
def _look(fields, scene, view, room, chosen):  # type: ignore[no-untyped-def]
    """Scans as the episodes begin: everything is at rest, so no scan is delayed or skewed."""
    pose, bodies, ranges, steps, seeds, faults, velocity = (
        fields[0], fields[3], fields[6], fields[8], fields[9], fields[10], fields[15],
    )  # fmt: skip
    sensors = room[4]
    for i in range(chosen.shape[0]):
        sensors[1][i] = chosen[i]
    sight.look_together(
        chosen.shape[0], pose, bodies, ranges, velocity.shape[1], scene[0], view, sensors
    )
    for n in chosen:
        sight.distort(n, n + 1, ranges, faults, steps, seeds, view)


@kernel(allocates=True)
def begin_period(packed):  # type: ignore[no-untyped-def]
    """Sets the velocities of the obstacles for the period that begins.

    Args:
        packed: see `kernels.step_worlds`; robots are at their poses as the period begins.
    """
    fields, scene, _, motion, room = packed.content
    pose, bodies, odom, twist = fields[0], fields[3], fields[4], fields[5]
    steps, seeds, velocity, past, marks = fields[8], fields[9], fields[15], fields[16], fields[17]
    walls, movers, (dt, substeps) = scene[0], scene[5], motion[4]
    for n in range(pose.shape[0]):
        if movers[0]:
            steer_world(
                n, velocity, marks, bodies, pose, past, steps[n], walls, movers, seeds[n],
                dt * substeps, room[2][4],
            )  # fmt: skip
        for m in range(pose.shape[1]):
            if steps[n] == 0:
                sensing.begin(past, n, m, pose, odom, twist)


@kernel(allocates=True)
def end_period(packed, true, before, wheels, counted):  # type: ignore[no-untyped-def]
    """Measures what the robots sense at the end of a period.

    Args:
        packed: see `kernels.step_worlds`; all bodies are at their poses as the period ends.
        true: (N, M, 3) true twist at its end.
        before: (N, M, 3) pose by wheel odometry alone at its beginning.
        wheels: (N, M, 3) pose by wheel odometry alone at its end.
        counted: (N, M, 3) twist by wheel odometry at its end.
    """
    fields, scene, view, motion, room = packed.content
    (
        pose, _, _, bodies, odom, twist, ranges, _, steps, seeds, faults, _, _, age, noise,
        velocity, past, _,
    ) = fields  # fmt: skip
    walls, crowded, scattered = scene[0], scene[3], scene[4]
    series, (dt, substeps) = motion[3], motion[4]
    sensors, crowding = room[4], room[3]
    robots, first, together = pose.shape[1], velocity.shape[1], 0
    for n in range(pose.shape[0]):
        steps[n] += 1
        row = past[n, :, steps[n] % past.shape[2]]
        for m in range(robots):
            put_body(bodies, n, first + m, pose[n, m])
            sensing.measure(
                odom, twist, past, before[n, m], wheels, n, m, counted[n, m], noise, steps[n],
                seeds[n], steps[n] * robots + m, age[n, m], dt, substeps, series,
            )  # fmt: skip
            for i in range(3):  # the lidar scans from the true pose, not from wheel odometry
                row[m, sensing.POSE + i] = pose[n, m, i]
                row[m, sensing.TWIST + i] = true[n, m, i]
        if crowded:
            crowd.sort_bodies(bodies, n, crowding[0])
        together = sight.look_or_wait(
            n, together, pose, bodies, ranges, steps, faults, age, velocity, past, walls,
            scattered, view, sensors, crowding, dt, substeps,
        )  # fmt: skip
    sight.look_together(together, pose, bodies, ranges, first, walls, view, sensors)
    sight.distort(0, pose.shape[0], ranges, faults, steps, seeds, view)
