"""Compiled faults of a lidar: deviations of a real device from the exact ranges.

The order is that of the device: skew (beams are measured from different poses), geometry (the
scanner), then too close, noise, quantisation and dropouts, by `distort`. The faults of one robot
are a row (P,) of numbers; one whose numbers are 0 takes no time and draws nothing.
"""

import math

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel

# Columns of a row of faults; `faults.LidarFaults` explains them.
NOISE_STD, NOISE_PROPORTIONAL, DROPOUT, DROPOUT_FAR, TOO_CLOSE, QUANTISATION, SKEW = range(7)
PARAMETERS = 7
AS_MINUS_INF, AS_RANGE_MIN, AS_NO_RETURN, AS_GHOST = range(4)  # values of TOO_CLOSE
CLOCKWISE, AT_ONCE, COUNTER_CLOCKWISE = -1, 0, 1  # values of SKEW
ROUNDING = 1e-9  # rounding error of a multiple of the quantisation step [m]


@kernel(allocates=True)
def distort(ranges, limits, faults, seed, counter):  # type: ignore[no-untyped-def]
    """Applies faults (P,) of the device to one exact scan (B,) float32, REP-117, in place [m].

    A return stays within the limits, range_min and range_max [m]; `counter` is that of the scan.
    """
    if faults[TOO_CLOSE] != AS_MINUS_INF:
        _too_close(ranges, limits, faults[TOO_CLOSE], seed, counter)
    if faults[NOISE_STD] > 0.0 or faults[NOISE_PROPORTIONAL] > 0.0:
        _noise(ranges, limits, faults[NOISE_STD], faults[NOISE_PROPORTIONAL], seed, counter)
    if faults[QUANTISATION] > 0.0:
        _quantise(ranges, limits, faults[QUANTISATION])
    if faults[DROPOUT] > 0.0 or faults[DROPOUT_FAR] > 0.0:
        _drop(ranges, limits, faults[DROPOUT], faults[DROPOUT_FAR], seed, counter)


@kernel(allocates=True)
def _too_close(ranges, limits, behaviour, seed, counter):  # type: ignore[no-untyped-def]
    count = ranges.shape[0]
    for i in range(count):
        if ranges[i] != -np.inf:
            continue
        if behaviour == AS_RANGE_MIN:
            ranges[i] = limits[0]
        elif behaviour == AS_NO_RETURN:
            ranges[i] = np.inf
        else:
            draw = random.uniform(seed, random.GHOST_STREAM, counter * count + i)
            ranges[i] = limits[0] + draw * (limits[1] - limits[0])


@kernel(allocates=True)
def _noise(ranges, limits, std, proportional, seed, counter):  # type: ignore[no-untyped-def]
    count = ranges.shape[0]
    for i in range(count):
        if np.isfinite(ranges[i]):
            draw = random.normal(seed, random.RANGE_STREAM, counter * count + i)
            noisy = ranges[i] + (std + proportional * ranges[i]) * draw
            ranges[i] = min(max(noisy, limits[0]), limits[1])


@kernel(allocates=True)
def _quantise(ranges, limits, step):  # type: ignore[no-untyped-def]
    for i in range(ranges.shape[0]):
        if np.isfinite(ranges[i]):
            value = math.floor(ranges[i] / step + 0.5) * step
            if value > limits[1] + ROUNDING:
                value -= step
            elif value < limits[0] - ROUNDING:
                value += step
            ranges[i] = value


@kernel(allocates=True)
def _drop(ranges, limits, share, far, seed, counter):  # type: ignore[no-untyped-def]
    count = ranges.shape[0]
    for i in range(count):
        if ranges[i] < np.inf:
            reach = max(ranges[i], 0.0) / limits[1]
            draw = random.uniform(seed, random.DROPOUT_STREAM, counter * count + i)
            if draw < share + far * reach * reach:
                ranges[i] = np.inf


@kernel(allocates=True)
def slice_pose(out, pose, twist, ago):  # type: ignore[no-untyped-def]
    """Writes the pose (3,) `ago` [s] before, along the arc of a twist (3,); heading unwrapped."""
    turn = -twist[2] * ago
    half = 0.5 * turn
    # The chord of the arc is rotated by half the turn: |chord| = arc * sin(half) / half.
    chord = 1.0 - half * half / 6.0 if abs(half) < 1e-4 else math.sin(half) / half
    c, s = math.cos(pose[2] + half), math.sin(pose[2] + half)
    x, y = -twist[0] * ago * chord, -twist[1] * ago * chord
    out[0] = pose[0] + c * x - s * y
    out[1] = pose[1] + s * x + c * y
    out[2] = pose[2] + turn


@kernel(allocates=True)
def slice_poses(out, pose, twist, sweep, direction):  # type: ignore[no-untyped-def]
    """Writes the poses (G, 3) of the robot at which G equal groups of beams were measured.

    Group g has the beams from `g * B // G` to `(g + 1) * B // G`, and the pose of its interval's
    middle, heading unwrapped. The `sweep` [s] ends at `pose`: the newest beam is the last, or beam
    0 for one that turns clockwise. `direction` is a value of SKEW, `twist` (3,) that of the body.
    """
    count = out.shape[0]
    for g in range(count):
        ago = 0.0
        if direction != AT_ONCE:
            later = count - 1 - g if direction > AT_ONCE else g
            ago = sweep * (later + 0.5) / count
        slice_pose(out[g], pose, twist, ago)


@kernel(allocates=True)
def distort_worlds(ranges, chosen, limits, faults, seeds, steps):  # type: ignore[no-untyped-def]
    """Applies the same faults to the scans (N, M, B) of some worlds (n,), see `distort`."""
    robots = ranges.shape[1]
    for n in chosen:
        for m in range(robots):
            distort(ranges[n, m], limits, faults, seeds[n], steps[n] * robots + m)
