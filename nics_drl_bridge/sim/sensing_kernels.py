"""Compiled inner loops of the simulator: what moves and measures wrongly, and the scans.

Shapes: N worlds, M robots, S state, W walls, B beams, G slices of a sweep.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kinematics.kernels import advance
from nics_drl_bridge.lidar import fault_kernels, scan_kernels


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
            noise[i] = std[i // 2] * random.normal(seed, random.ODOMETRY_STREAM, 3 * counter + i)
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
            share = random.uniform(seed, random.DRIFT_STREAM, counter * count + i) - 0.5
            draw = scale * std[i] * share
            if i < 3:
                aside[i] = draw
            else:
                state[i - 3] += draw
    advance(pose, aside, 1.0, series)


@njit(cache=True)
def sense(arrays, chosen, walls, sensor, room, sweep):  # type: ignore[no-untyped-def]
    """Scans of the worlds `chosen` (n,) as they stand, with the faults of each robot's device.

    Args:
        arrays: the fields of `simulator.Worlds`, in order.
        chosen: (n,).
        walls: (W, 4).
        sensor: see `lidar.scanner.Scanner.arguments`.
        room: see `lidar.scanner.Scanner.room`.
        sweep: time of a sweep [s], (N, M, 3) true twists, and scratch for skewed scans: poses
            (N, M, 3), slices (G, 3), ranges (N, M, B); G is 0 where no device skews.
    """
    pose, _, _, bodies, _, _, ranges, _, steps, seeds, faults = arrays
    robots = pose.shape[1]
    first = bodies.shape[1] - robots
    if sweep[3].shape[0] == 0:
        scan_kernels.scan_worlds(ranges, pose, chosen, bodies, first, walls, sensor, room)
    else:
        _sweep(ranges, pose, chosen, bodies, first, walls, sensor, room, sweep, faults)
    for n in chosen:
        for m in range(robots):
            counter = steps[n] * robots + m
            fault_kernels.distort(ranges[n, m], sensor[3], faults[n, m], seeds[n], counter)


@njit(cache=True)
def _sweep(ranges, pose, chosen, bodies, first, walls, sensor, room, sweep, faults):  # type: ignore[no-untyped-def]
    """Scans group by group of beams, each from where its robot was at that time; see `sense`."""
    time, twists, poses, slices, part = sweep
    groups, beams = slices.shape[0], ranges.shape[2]
    for g in range(groups):
        for n in chosen:
            for m in range(pose.shape[1]):
                turns = faults[n, m, fault_kernels.SKEW]
                fault_kernels.slice_poses(slices, pose[n, m], twists[n, m], time, turns)
                poses[n, m] = slices[g]
        scan_kernels.scan_worlds(part, poses, chosen, bodies, first, walls, sensor, room)
        low, high = g * beams // groups, (g + 1) * beams // groups
        for n in chosen:
            for m in range(pose.shape[1]):
                ranges[n, m, low:high] = part[n, m, low:high]
