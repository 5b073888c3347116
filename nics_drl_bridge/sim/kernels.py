"""Compiled inner loops of the simulator: motion, collision, and the step of all worlds.

What one robot does is a scalar function; the batched loops call it. Shapes: N worlds, M
robots, S state, C command, H periods of command history, K obstacles, W walls, B beams.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge.kinematics.kernels import delayed, move, rates, run, wrap
from nics_drl_bridge.sim import sensing_kernels as sensing
from nics_drl_bridge.sim.space_kernels import wall_distance


@njit(cache=True)
def clearance(pose, me, footprint, bodies, walls):  # type: ignore[no-untyped-def]
    """Free space [m] between the round footprint at a pose (3,) and the nearest wall or body."""
    least = wall_distance(pose[0], pose[1], walls)
    for k in range(bodies.shape[0]):
        if k != me and bodies[k, 5] > 0.0:
            away = np.hypot(pose[0] - bodies[k, 0], pose[1] - bodies[k, 1]) - bodies[k, 5]
            least = min(least, away)
    return least - footprint


@njit(cache=True)
def move_freely(pose, state, history, lanes, motion):  # type: ignore[no-untyped-def]
    """Moves the robots of some worlds for one period as if nothing were in the way.

    Args:
        pose: (n, M, 3).
        state: (n, M, S).
        history: (n, M, H, C) commands, newest first.
        lanes: pose (6, L), x (V + 1, L), dq (D, L) of `kinematics.kernels.run`, L >= n M; they
            hold the result.
        motion: terms, series, (step [s], substeps per period, delay of commands [substeps]).
    """
    where, x, dq = lanes
    terms, series, (dt, substeps, delay) = motion
    robots, size = pose.shape[1], state.shape[2]
    for n in range(pose.shape[0]):
        for m in range(robots):
            i = n * robots + m
            where[0, i], where[1, i], where[4, i] = pose[n, m]
            where[2, i], where[3, i] = math.cos(pose[n, m, 2]), math.sin(pose[n, m, 2])
            where[5, i] = 0.0
            x[:size, i] = state[n, m]
    late = delay % substeps  # the command changes once in a period, after so many substeps
    for first, last in ((0, late), (late, substeps)):
        row = delayed(first, delay, substeps, history.shape[2])
        for n in range(pose.shape[0]):
            for m in range(robots):
                x[size:-1, n * robots + m] = history[n, m, row]
        if last > first:
            run(where, x, dq, terms, series, dt, last - first)


@njit(cache=True)
def move_carefully(pose, state, history, bodies, walls, collided, footprint, motion, room):  # type: ignore[no-untyped-def]
    """Moves the robots of one world for one period, looking for touches after each substep.

    A robot that touches something is marked and gets no deeper into it; it may leave. A free
    one moves exactly as by `move_freely`.

    Args:
        pose: (M, 3), in place.
        state: (M, S), in place.
        history: (M, H, C) commands, newest first.
        bodies: (K + M, 7) obstacles, then robots, see `lidar.shapes.BODY`; robots in place.
        walls: (W, 4).
        collided: (M,) set to 1 by a touch.
        footprint: radius [m].
        motion: see `move_freely`.
        room: x (V + 1,), dq (D,), direction (M, 2): scratch.
    """
    terms, series, (dt, substeps, delay) = motion
    x, dq, direction = room
    robots, size = pose.shape[0], state.shape[1]
    first = bodies.shape[0] - robots
    trial = np.empty(3)
    for m in range(robots):
        direction[m, 0], direction[m, 1] = math.cos(pose[m, 2]), math.sin(pose[m, 2])
    for j in range(substeps):
        row = delayed(j, delay, substeps, history.shape[1])
        for m in range(robots):
            x[:size], x[size:-1] = state[m], history[m, row]
            rates(dq, x, terms)
            turn = dq[2] * dt
            trial[0], trial[1], c, s = move(
                pose[m, 0],
                pose[m, 1],
                direction[m, 0],
                direction[m, 1],
                dq[0],
                dq[1],
                turn,
                dt,
                series,
            )
            trial[2] = pose[m, 2] + turn
            for i in range(size):
                state[m, i] += dt * dq[3 + i]
            free = clearance(trial, first + m, footprint, bodies, walls)
            if free < 0.0:
                collided[m] = 1
            before = clearance(pose[m], first + m, footprint, bodies, walls)
            if before >= 0.0 or free >= before:
                pose[m] = trial
                direction[m, 0], direction[m, 1] = c, s
                bodies[first + m, 0], bodies[first + m, 1] = trial[0], trial[1]


@njit(cache=True)
def move_block(pose, state, history, bodies, walls, collided, footprint, lanes, motion, room):  # type: ignore[no-untyped-def]
    """Moves the robots of some worlds for one period: freely, and carefully where it is tight.

    The arguments are those of the two functions above, with worlds (n, ...) in front.
    """
    move_freely(pose, state, history, lanes, motion)
    where, x, _ = lanes
    robots, size = pose.shape[1], state.shape[2]
    first = bodies.shape[1] - robots
    for n in range(pose.shape[0]):
        longest = 0.0
        for m in range(robots):
            longest = max(longest, where[5, n * robots + m])
        tight = False
        for m in range(robots):
            free = clearance(pose[n, m], first + m, footprint, bodies[n], walls)
            tight = tight or free <= (2.0 if robots > 1 else 1.0) * longest
        if tight:
            move_carefully(
                pose[n],
                state[n],
                history[n],
                bodies[n],
                walls,
                collided[n],
                footprint,
                motion,
                room,
            )
        else:
            for m in range(robots):
                i = n * robots + m
                pose[n, m, 0], pose[n, m, 1], pose[n, m, 2] = where[0, i], where[1, i], where[4, i]
                state[n, m] = x[:size, i]
                bodies[n, first + m, :2] = pose[n, m, :2]
        for m in range(robots):
            pose[n, m, 2] = wrap(pose[n, m, 2])


@njit(cache=True)
def place_robot(bodies, n, k, pose):  # type: ignore[no-untyped-def]
    """Puts body k of world n to a robot's pose (3,)."""
    bodies[n, k, 0], bodies[n, k, 1], bodies[n, k, 2] = pose
    bodies[n, k, 3], bodies[n, k, 4] = math.cos(pose[2]), math.sin(pose[2])


@njit(cache=True)
def step_worlds(arrays, commands, walls, footprint, noise, sensor, lanes, motion, rooms):  # type: ignore[no-untyped-def]
    """One control period of every world.

    Args:
        arrays: the fields of `simulator.Worlds`, in order; updated in place.
        commands: (N, M, C).
        walls: (W, 4).
        footprint: radius [m].
        noise: standard deviations of the odometry, linear [m/s] and angular [rad/s], and (3 + S)
            of the drift after a second.
        sensor: see `lidar.scanner.Scanner.arguments`.
        lanes, motion: see the functions above.
        rooms: scratch of the motion, see `move_carefully`, of the scans, see
            `lidar.scanner.Scanner.room`, and of skewed ones, see `sensing_kernels.sense`.
    """
    pose, state, history, bodies, odom, twist, _, collided, steps, seeds, _ = arrays
    room, scan_room, sweep = rooms
    worlds, robots = pose.shape[0], pose.shape[1]
    before = pose.copy()
    for h in range(history.shape[2] - 1, 0, -1):
        history[:, :, h] = history[:, :, h - 1]
    history[:, :, 0] = commands
    block = lanes[0].shape[1] // robots
    for begin in range(0, worlds, block):
        part = slice(begin, min(begin + block, worlds))
        move_block(
            pose[part], state[part], history[part], bodies[part], walls, collided[part],
            footprint, lanes, motion, room,
        )  # fmt: skip
    x, dq, _ = room
    terms, series, timing = motion
    period = timing[0] * timing[1]
    first, drifts, now = bodies.shape[1] - robots, noise[2:].any(), sweep[1]
    for n in range(worlds):
        steps[n] += 1
        for m in range(robots):
            counter = steps[n] * robots + m
            if drifts and collided[n, m] == 0:
                sensing.disturb(
                    pose[n, m], state[n, m], noise[2:], seeds[n], counter, period, series
                )
            place_robot(bodies, n, first + m, pose[n, m])
            _rates_now(dq, x, state[n, m], history[n, m], terms, timing)
            now[n, m] = dq[:3]
            sensing.measure(
                odom[n, m], twist[n, m], before[n, m], pose[n, m], dq,
                seeds[n], counter, noise[:2], period, series,
            )  # fmt: skip
    sensing.sense(arrays, np.arange(worlds), walls, sensor, scan_room, sweep)


@njit(cache=True)
def _rates_now(dq, x, state, history, terms, timing):  # type: ignore[no-untyped-def]
    """Rates at the end of a period, under the command that was in effect last."""
    row = delayed(timing[1] - 1, timing[2], timing[1], history.shape[0])
    size = state.shape[0]
    x[:size], x[size:-1] = state, history[row]
    rates(dq, x, terms)
