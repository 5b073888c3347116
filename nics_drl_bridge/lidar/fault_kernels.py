"""Compiled faults of a lidar: deviations of a real device from the exact ranges.

They are applied in the order in which they arise in a device: skew (beams are measured
from different poses), geometry (the scanner), then too close, noise, quantisation and
dropouts (`distort`). The faults of one robot are a row (P,) of parameters; a fault
whose parameters are 0 takes no time and draws no numbers.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers, Singles

# Columns of a row of faults; `faults.LidarFaults` explains them.
NOISE_STD, NOISE_PROPORTIONAL, DROPOUT, DROPOUT_FAR, TOO_CLOSE, QUANTISATION, SKEW = (
    range(7)
)
AS_MINUS_INF, AS_RANGE_MIN, AS_NO_RETURN, AS_GHOST = range(4)  # values of TOO_CLOSE
# values of SKEW
CLOCKWISE = -1
AT_ONCE = 0
COUNTER_CLOCKWISE = 1
ROUNDING = 1e-9  # rounding error of a multiple of the quantisation step [m]
# Ranges are raised as integers, which have the same order, by the maximum of two
# numbers: if a range might stay unchanged, LLVM would mask the store, which is slower
# than everything else here.
INF_BITS, MINUS_INF, NONE = np.array([np.inf, -np.inf, -2.0], np.float32).view(np.int32)


class Distortion(NamedTuple):
    """Faults of a device, prepared for use on a return; a missing fault has no effect."""

    least: np.float32  # [m]
    most: np.float32
    close: np.float32  # value of a return that is too close
    std: np.float32  # standard deviation at a range of 0 [m]
    grows: np.float32  # increase of `std` with the range [1]
    per_step: np.float32  # 1 / step of the quantisation [1/m]
    step: np.float32  # [m]
    rest: np.float32  # remainder of the step beyond float32
    first: np.float32  # smallest multiple of the step within the limits, in steps
    last: np.float32


@kernel
def distort(
    ranges: Singles,
    limits: Array | tuple[float, float],
    faults: Array,
    seed: int,
    counter: int,
) -> None:
    """Apply faults (P,) of the device to one exact scan (B,) float32, REP-117, in place [m].

    A return stays within the limits, range_min and range_max [m]; `counter` is that of the scan.
    """
    device = _prepare_device(limits, faults)
    whole = ranges.view(np.int32)
    noisy = device.std > 0.0 or device.grows > 0.0
    coarse = device.step > 0.0 and device.first <= device.last
    if faults[TOO_CLOSE] == AS_GHOST:
        by = random.key(seed, random.GHOST_STREAM, counter)
        width = device.most - device.least
        for i in range(len(ranges)):
            ghost = device.least + random.share_of(random.bits(by, i)) * width
            value = np.float32(ghost).view(np.int32)
            whole[i] = max(whole[i], value if whole[i] == MINUS_INF else NONE)
    if faults[TOO_CLOSE] == AS_RANGE_MIN or not (
        noisy or coarse or device.close == -np.inf
    ):
        close = np.float32(device.close).view(np.int32)
        for i in range(len(ranges)):
            whole[i] = max(whole[i], close if whole[i] == MINUS_INF else NONE)
    if noisy and coarse:
        _add_noise(ranges, device, random.key(seed, random.RANGE_STREAM, counter), True)
    elif noisy:
        _add_noise(
            ranges, device, random.key(seed, random.RANGE_STREAM, counter), False
        )
    elif coarse:
        for i in range(len(ranges)):
            ranges[i] = _report(ranges[i], _quantize(ranges[i], device), device)
    if faults[DROPOUT] > 0.0 or faults[DROPOUT_FAR] > 0.0:
        by = random.key(seed, random.DROPOUT_STREAM, counter)
        _drop_returns(ranges, limits[1], faults, by)


@kernel(inline=True)
def _drop_returns(ranges: Singles, range_max: float, faults: Array, by: int) -> None:
    """Lose returns at random; far ones are lost more often."""
    whole = ranges.view(np.int32)
    share = np.float32(faults[DROPOUT])
    far = np.float32(faults[DROPOUT_FAR] / (range_max * range_max))
    for i in range(len(ranges)):
        reach = ranges[i] if ranges[i] > np.float32(0.0) else np.float32(0.0)
        lost = random.share_of(random.bits(by, i)) < share + far * reach * reach
        whole[i] = max(whole[i], INF_BITS if lost else NONE)


@kernel(inline=True)
def _prepare_device(limits: tuple[float, float], faults: Array) -> Distortion:
    single = np.float32
    step = faults[QUANTISATION]
    close = np.inf
    if faults[TOO_CLOSE] == AS_RANGE_MIN:
        close = limits[0]
    elif faults[TOO_CLOSE] == AS_MINUS_INF:
        close = -np.inf
    per_step = 0.0
    if step > 0.0:
        per_step = 1.0 / step
    rest = single(step - single(step))
    least = single(limits[0])
    most = single(limits[1])
    first = single(math.ceil((limits[0] - ROUNDING) * per_step))
    last = single(math.floor((limits[1] + ROUNDING) * per_step))
    first += single(_multiply_step(first, single(step), rest) < least)
    last -= single(_multiply_step(last, single(step), rest) > most)
    return Distortion(
        least,
        most,
        single(close),
        single(faults[NOISE_STD] * random.PER_STD),
        single(faults[NOISE_PROPORTIONAL] * random.PER_STD),
        single(per_step),
        single(step),
        rest,
        first,
        last,
    )


@kernel(inline=True)
def _add_noise(ranges: Singles, device: Distortion, by: int, coarse: bool) -> None:
    runs = len(ranges) // random.RUN
    for k in range(runs):
        _add_noise_run(ranges, random.RUN, device, by, k, coarse)
    _add_noise_run(ranges, len(ranges) - runs * random.RUN, device, by, runs, coarse)


@kernel(contracts=True, inline=True)
def _add_noise_run(
    ranges: Singles,
    count: int,
    device: Distortion,
    by: int,
    k: int,
    coarse: bool,
) -> None:
    run = random.run(by, k)
    begin = np.uintp(k * random.RUN)
    for j in range(count):
        i = begin + np.uintp(j)
        value = ranges[i]
        noisy = value + (device.std + device.grows * value) * random.normal_of(run, j)
        if coarse:
            noisy = _quantize(noisy, device)
        else:
            noisy = device.least if noisy < device.least else noisy
            noisy = device.most if noisy > device.most else noisy
        ranges[i] = _report(value, noisy, device)


@kernel(inline=True)
def _report(value: np.float32, measured: np.float32, device: Distortion) -> np.float32:
    """Return the measured range, or the value reported for too close or no return."""
    replacement = device.close if value < device.close else value
    return (
        measured
        if np.float32(value).view(np.uint32) < np.uint32(INF_BITS)
        else replacement
    )


@kernel(contracts=True, inline=True)
def _quantize(value: np.float32, device: Distortion) -> np.float32:
    """Return the nearest multiple of the step within the limits."""
    count = np.floor(value * device.per_step + np.float32(0.5))
    count = device.first if count < device.first else count
    count = device.last if count > device.last else count
    return _multiply_step(count, device.step, device.rest)


@kernel(contracts=True, inline=True)
def _multiply_step(count: np.float32, step: np.float32, rest: np.float32) -> np.float32:
    return count * step + count * rest  # rounded once


@kernel
def slice_poses(
    out: Array,
    pose: Array,
    twist: Array,
    sweep: float,
    direction: float,
    moving: float,
) -> None:
    """Write the poses (G, 3) of the robot at which G equal groups of beams were measured.

    Group g has the beams from `g * B // G` to `(g + 1) * B // G`, and the pose at the middle of its
    interval.

    Args:
        out: (G, 3) the poses, headings unwrapped.
        pose: (3,) at the end of the sweep, when the newest beam is measured.
        twist: (3,) of the body during the sweep.
        sweep: duration of the sweep [s].
        direction: a value of SKEW; the newest beam is the last, or beam 0 if it turns clockwise.
        moving: time since the robot began to move [s]; before that it was at rest.
    """
    count = len(out)
    for g in range(count):
        ago = 0.0
        if direction != AT_ONCE:
            later = g
            if direction > AT_ONCE:
                later = count - 1 - g
            ago = min(sweep * (later + 0.5) / count, moving)
        # Back on the arc of the twist, whose chord is rotated by half the turn:
        # |chord| = arc * sin(half) / half.
        turn = -twist[2] * ago
        half = 0.5 * turn
        if abs(half) < 1e-4:
            chord = 1.0 - half * half / 6.0
        else:
            chord = math.sin(half) / half
        c = math.cos(pose[2] + half)
        s = math.sin(pose[2] + half)
        x = -twist[0] * ago * chord
        y = -twist[1] * ago * chord
        out[g, 0] = pose[0] + c * x - s * y
        out[g, 1] = pose[1] + s * x + c * y
        out[g, 2] = pose[2] + turn


@kernel
def distort_worlds(
    ranges: Singles,
    chosen: Integers,
    limits: tuple[float, float],
    faults: Array,
    seeds: Integers,
    steps: Integers,
) -> None:
    """Apply the same faults to the scans (N, M, B) of some worlds (n,), see `distort`."""
    robots = ranges.shape[1]
    for n in chosen:
        for m in range(robots):
            distort(ranges[n, m], limits, faults, seeds[n], steps[n] * robots + m)
