"""Compiled inner loops of the simulator: motion, collision, odometry and scans.

What one robot does is a scalar function; the batched loops call it. Shapes: N worlds, M
robots, S state, C command, H periods of command history, K obstacles, W walls, B beams.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge.kinematics.kernels import advance, delayed, move, rates, run, wrap
from nics_drl_bridge.lidar import kernels as lidar
from nics_drl_bridge.sim import random
from nics_drl_bridge.sim.world import wall_distance

ODOMETRY_STREAM = 2
RANGE_STREAM = 3
DRIFT_STREAM = 4


@njit(cache=True)
def clearance(pose, me, footprint, bodies, walls):  # type: ignore[no-untyped-def]
    """Free space [m] between the round footprint at a pose (3,) and the nearest wall or body."""
    least = wall_distance(pose[0], pose[1], walls)
    for k in range(bodies.shape[0]):
        if k != me and bodies[k, 2] > 0.0:
            away = np.hypot(pose[0] - bodies[k, 0], pose[1] - bodies[k, 1]) - bodies[k, 2]
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
        bodies: (K + M, 4) obstacles and robots: x, y, radius, shape; robots in place.
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
def measure(odom, twist, before, after, now, seed, counter, std, period, series):  # type: ignore[no-untyped-def]
    """What the wheels' odometry says of one period: a drifting pose and a noisy twist.

    Args:
        odom: (3,) odometry pose, in place.
        twist: (3,) measured twist, result.
        before, after: (3,) true poses around the period.
        now: (3,) true twist at its end.
        seed, counter: of the random draws.
        std: (2,) standard deviation of the linear [m/s] and the angular twist [rad/s].
        period: [s].
        series: see `kinematics.kernels`.
    """
    noise = np.zeros(3)
    for i in range(3):
        if std[i // 2] > 0.0:
            noise[i] = std[i // 2] * random.normal(seed, ODOMETRY_STREAM, 3 * counter + i)
        twist[i] = now[i] + noise[i]
    c, s = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    turned = after[2] - before[2]
    c, s = math.cos(odom[2]), math.sin(odom[2])
    odom[0] += c * x - s * y
    odom[1] += s * x + c * y
    odom[2] += turned
    advance(odom, noise, period, series)


@njit(cache=True)
def disturb(pose, state, std, seed, counter, period, series):  # type: ignore[no-untyped-def]
    """Moves a robot by what its model does not explain, growing with the root of the time.

    Args:
        pose: (3,), in place.
        state: (S,), in place.
        std: (3 + S,) along x, y and heading of the body, and of the state, after a second.
        seed, counter: of the random draws.
        period: [s].
        series: see `kinematics.kernels`.
    """
    # Uniform draws of this variance are cheap, and over some periods they add up to a normal one.
    count, scale = std.shape[0], math.sqrt(12.0 * period)
    aside = np.zeros(3)
    for i in range(count):
        if std[i] > 0.0:
            share = random.uniform(seed, DRIFT_STREAM, counter * count + i) - 0.5
            draw = scale * std[i] * share
            if i < 3:
                aside[i] = draw
            else:
                state[i - 3] += draw
    advance(pose, aside, 1.0, series)


@njit(cache=True)
def scan_robot(ranges, pose, me, bodies, walls, sensor, noise_std, seed, counter):  # type: ignore[no-untyped-def]
    """One scan (B,) of everything but the robot itself, with Gaussian noise.

    Args:
        me: row of the robot in `bodies`.
        sensor: see `lidar.scanner.Scanner.arguments`.
        noise_std: of a range [m].
    """
    own = bodies[me, 2]
    bodies[me, 2] = 0.0
    lidar.scan(ranges, pose, bodies, walls, sensor)
    bodies[me, 2] = own
    if noise_std > 0.0:
        count, limits = ranges.shape[0], sensor[3]
        for i in range(count):
            if np.isfinite(ranges[i]):
                draw = random.normal(seed, RANGE_STREAM, counter * count + i)
                ranges[i] = min(max(ranges[i] + noise_std * draw, limits[0]), limits[1])


@njit(cache=True)
def step_worlds(arrays, commands, walls, footprint, noise, sensor, lanes, motion, room):  # type: ignore[no-untyped-def]
    """One control period of every world.

    Args:
        arrays: the fields of `simulator.Worlds`, in order; updated in place.
        commands: (N, M, C).
        walls: (W, 4).
        footprint: radius [m].
        noise: standard deviations of the odometry, linear and angular, of a range, and (3 + S)
            of the drift after a second.
        sensor: see `lidar.scanner.Scanner.arguments`.
        lanes, motion, room: see the functions above.
    """
    pose, state, history, bodies, odom, twist, ranges, collided, steps, seeds = arrays
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
    terms, _, timing = motion
    period = timing[0] * timing[1]
    first, drifts = bodies.shape[1] - robots, noise[3:].any()
    for n in range(worlds):
        steps[n] += 1
        for m in range(robots):
            if drifts and collided[n, m] == 0:
                counter = steps[n] * robots + m
                disturb(pose[n, m], state[n, m], noise[3:], seeds[n], counter, period, motion[1])
                bodies[n, first + m, 0], bodies[n, first + m, 1] = pose[n, m, 0], pose[n, m, 1]
        for m in range(robots):
            counter = steps[n] * robots + m
            _rates_now(dq, x, state[n, m], history[n, m], terms, timing)
            measure(
                odom[n, m], twist[n, m], before[n, m], pose[n, m], dq,
                seeds[n], counter, noise[:2], period, motion[1],
            )  # fmt: skip
            scan_robot(
                ranges[n, m], pose[n, m], bodies.shape[1] - robots + m, bodies[n], walls, sensor,
                noise[2], seeds[n], counter,
            )  # fmt: skip


@njit(cache=True)
def _rates_now(dq, x, state, history, terms, timing):  # type: ignore[no-untyped-def]
    """Rates at the end of a period, under the command that was in effect last."""
    row = delayed(timing[1] - 1, timing[2], timing[1], history.shape[0])
    size = state.shape[0]
    x[:size], x[size:-1] = state, history[row]
    rates(dq, x, terms)


@njit(cache=True)
def scan_worlds(arrays, chosen, walls, noise, sensor):  # type: ignore[no-untyped-def]
    """Scans of the worlds `chosen` (n,) as they stand, after a reset."""
    pose, _, _, bodies, _, _, ranges, _, steps, seeds = arrays
    for n in chosen:
        robots = pose.shape[1]
        for m in range(robots):
            scan_robot(
                ranges[n, m], pose[n, m], bodies.shape[1] - robots + m, bodies[n], walls, sensor,
                noise[2], seeds[n], steps[n] * robots + m,
            )  # fmt: skip
