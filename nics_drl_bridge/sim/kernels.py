"""Compiled inner loops of the simulator: motion, collision, odometry and scans.

What one robot does is a scalar function; the batched loops call it. Shapes: N worlds, M
robots, S state, C command, H periods of command history, K obstacles, W walls, B beams.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge.kinematics.motion import advance, delayed, rates
from nics_drl_bridge.lidar import kernels as lidar
from nics_drl_bridge.sim import random
from nics_drl_bridge.sim.world import wall_distance

ODOMETRY_STREAM = 2
RANGE_STREAM = 3


@njit(cache=True)
def touches(pose, me, footprint, bodies, walls):  # type: ignore[no-untyped-def]
    """Whether the round footprint of body `me` at a pose (3,) meets a wall or another body."""
    if wall_distance(pose[0], pose[1], walls) < footprint:
        return True
    for k in range(bodies.shape[0]):
        if k != me:
            dx, dy, room = pose[0] - bodies[k, 0], pose[1] - bodies[k, 1], footprint + bodies[k, 2]
            if bodies[k, 2] > 0.0 and dx * dx + dy * dy < room * room:
                return True
    return False


@njit(cache=True)
def move_world(pose, state, history, bodies, walls, collided, terms, timing, footprint, x, dq):  # type: ignore[no-untyped-def]
    """Moves the robots of one world for one control period.

    A robot that would touch something stays where it is, and is marked.

    Args:
        pose: (M, 3), in place.
        state: (M, S), in place.
        history: (M, H, C) commands, newest first.
        bodies: (K + M, 4) obstacles and robots: x, y, radius, shape; robots in place.
        walls: (W, 4).
        collided: (M,) set to 1 by a touch.
        terms: see `rates`.
        timing: substep [s], substeps per period, delay of commands [substeps].
        footprint: radius [m].
        x, dq: scratch, see `rates`.
    """
    robots, size, width = pose.shape[0], state.shape[1], history.shape[2]
    dt, substeps, delay = timing
    first = bodies.shape[0] - robots
    trial = np.empty(3)
    for j in range(substeps):
        for m in range(robots):
            row = delayed(history[m], j, delay, substeps)
            for i in range(size):
                x[i] = state[m, i]
            for i in range(width):
                x[size + i] = history[m, row, i]
            rates(dq, x, terms)
            trial[:] = pose[m]
            advance(trial, dq, dt)
            for i in range(size):
                state[m, i] += dt * dq[3 + i]
            if touches(trial, first + m, footprint, bodies, walls):
                collided[m] = 1
            else:
                pose[m] = trial
                bodies[first + m, 0], bodies[first + m, 1] = trial[0], trial[1]


@njit(cache=True)
def measure(odom, twist, before, after, now, seed, counter, std, period):  # type: ignore[no-untyped-def]
    """What the wheels' odometry says of one period: a drifting pose and a noisy twist.

    Args:
        odom: (3,) odometry pose, in place.
        twist: (3,) measured twist, result.
        before, after: (3,) true poses around the period.
        now: (3,) true twist at its end.
        seed, counter: of the random draws.
        std: (2,) standard deviation of the linear [m/s] and the angular twist [rad/s].
        period: [s].
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
    advance(odom, noise, period)


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
def step_worlds(arrays, commands, walls, terms, timing, footprint, noise, sensor, x, dq):  # type: ignore[no-untyped-def]
    """One control period of every world.

    Args:
        arrays: the fields of `simulator.Worlds`, in order; updated in place.
        commands: (N, M, C).
        noise: odometry linear and angular, range: standard deviations.
        (others): see the functions above.
    """
    pose, state, history, bodies, odom, twist, ranges, collided, steps, seeds = arrays
    before = np.empty(3)
    std = noise[:2]
    for n in range(pose.shape[0]):
        robots = pose.shape[1]
        first = bodies.shape[1] - robots
        start = pose[n].copy()
        for m in range(robots):
            for h in range(history.shape[2] - 1, 0, -1):
                history[n, m, h] = history[n, m, h - 1]
            history[n, m, 0] = commands[n, m]
        move_world(
            pose[n], state[n], history[n], bodies[n], walls, collided[n],
            terms, timing, footprint, x, dq,
        )  # fmt: skip
        steps[n] += 1
        for m in range(robots):
            _twist_now(dq, x, state[n, m], history[n, m], terms, timing)
            before[:] = start[m]
            counter = steps[n] * robots + m
            period = timing[0] * timing[1]
            measure(odom[n, m], twist[n, m], before, pose[n, m], dq, seeds[n], counter, std, period)
            scan_robot(
                ranges[n, m], pose[n, m], first + m, bodies[n], walls, sensor,
                noise[2], seeds[n], counter,
            )  # fmt: skip


@njit(cache=True)
def _twist_now(dq, x, state, history, terms, timing):  # type: ignore[no-untyped-def]
    """Rates at the end of a period, under the command that was in effect last."""
    size = state.shape[0]
    row = delayed(history, timing[1] - 1, timing[2], timing[1])
    for i in range(size):
        x[i] = state[i]
    for i in range(history.shape[1]):
        x[size + i] = history[row, i]
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
