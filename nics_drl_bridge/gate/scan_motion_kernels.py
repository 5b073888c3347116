"""Compiled: reduces scans, predicts their change by a motion, and compares it with theirs.

A reduced scan has one range (K,) for each of a few evenly spaced directions, NaN where few beams
return. `scan_motion` calls these kernels in order:

1. `reduce_scan`: the median of the beams around each direction.
2. `predict_scan`: the reduced scan after a motion, if nothing but the lidar moves.
3. `compare_sectors`: the fraction of the predicted change that was observed, sector by sector.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel

Ranges = NDArray[np.float32]
Point = tuple[float, float]  # x, y [m]
# Maximum number of beams in a window. For a denser lidar, only the middle ones are
# used.
LARGEST_WINDOW = 129
# Neighbours are on two surfaces if their ranges differ by more than this fraction of the shorter.
GAP = 0.25
# Root mean square of the predicted changes of a sector that is compared: the larger of a length
# [m] and a number of standard deviations of the noise.
MIN_CHANGE = 0.03
MIN_DEVIATIONS = 1.8
# The same for a change of a range that is more than noise.
VISIBLE_CHANGE = 0.05
VISIBLE_DEVIATIONS = 3.0


class Directions(NamedTuple):
    """The directions of a reduced scan, evenly spaced in the frame of the lidar.

    Attributes:
        size: number of directions, K.
        first: angle of the first one [rad].
        step: angle between neighbours, greater than 0 [rad].
        beams_per_direction: beams of the lidar for each direction.
        half_window: beams on each side of the middle one that enter the median.
        full_circle: the last direction is a neighbour of the first.
    """

    size: int
    first: float
    step: float
    beams_per_direction: float
    half_window: int
    full_circle: bool


class Noise(NamedTuple):
    """Standard deviation of the change of a reduced range, as constant + proportional * range."""

    constant: float  # [m]
    proportional: float


@kernel(allocates=True)
def reduce_scan(ranges: Ranges, directions: Directions, out: Ranges) -> None:
    """Writes the median range around each direction (K,) to `out`.

    It is NaN unless more than half of the beams in the window of a direction return.
    """
    beams = ranges.shape[0]
    returns = np.empty(LARGEST_WINDOW)  # of a window, in ascending order
    for k in range(out.shape[0]):
        middle = int((k + 0.5) * directions.beams_per_direction)
        returned = 0
        total = 0
        for offset in range(-directions.half_window, directions.half_window + 1):
            beam = middle + offset
            if directions.full_circle:
                beam = (beam + beams) % beams
            elif beam < 0 or beam >= beams:
                continue
            total += 1
            value = ranges[beam]
            if not math.isfinite(value):
                continue
            index = returned
            while index > 0 and returns[index - 1] > value:
                returns[index] = returns[index - 1]
                index -= 1
            returns[index] = value
            returned += 1
        out[k] = math.nan
        if 2 * returned > total:
            out[k] = returns[returned // 2]


@kernel
def predict_scan(
    ranges: Ranges, directions: Directions, moved: Array, out: Ranges
) -> None:
    """Writes the ranges (K,) of a lidar after a motion, from the surfaces it saw before.

    Neighbouring end points a and b of the old scan form one straight surface, unless
    there is a gap between them. The surface is moved into the new frame, and
    intersected with all directions that it covers.

    Args:
        ranges: (K,) of the old scan [m].
        directions: of both scans.
        moved: (3,) motion of the lidar in its old frame: x, y [m], heading [rad].
        out: (K,) ranges to the nearest surface [m]; NaN in directions that none covers.
    """
    count = ranges.shape[0]
    out.fill(math.nan)
    pairs = count - 1
    if directions.full_circle:
        pairs = count
    for k in range(pairs):
        range_a = ranges[k]
        range_b = ranges[(k + 1) % count]
        if abs(range_a - range_b) <= GAP * min(range_a, range_b):
            bearing = directions.first + k * directions.step
            a = _move_point(range_a, bearing, moved)
            b = _move_point(range_b, bearing + directions.step, moved)
            _draw_surface(out, a, b, directions)


@kernel
def _move_point(length: float, bearing: float, moved: Array) -> Point:
    """Returns the end of a range [m] at a bearing [rad], in the frame after a motion (3,)."""
    x = length * math.cos(bearing) - moved[0]
    y = length * math.sin(bearing) - moved[1]
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    return cosine * x + sine * y, cosine * y - sine * x


@kernel
def _draw_surface(out: Ranges, a: Point, b: Point, directions: Directions) -> None:
    """Shortens the ranges (K,) in the directions that a surface from a to b covers."""
    cross = a[0] * b[1] - a[1] * b[0]
    dot = a[0] * b[0] + a[1] * b[1]
    if cross <= 0.0 or dot <= 0.0:
        return  # seen from behind, or around the lidar itself
    circle = 2.0 * math.pi / directions.step  # in directions
    # The directions that the surface covers, in spacings from the first one.
    begin = (math.atan2(a[1], a[0]) - directions.first) / directions.step
    end = begin + math.atan2(cross, dot) / directions.step
    shift = circle * math.floor(begin / circle)
    for direction in range(math.ceil(begin - shift), math.floor(end - shift) + 1):
        index = direction
        if direction >= circle - 0.5:
            index = round(direction - circle)
        if index < out.shape[0]:
            angle = directions.first + index * directions.step
            across = math.cos(angle) * (b[1] - a[1]) - math.sin(angle) * (b[0] - a[0])
            # also if it is NaN
            if across > 0.0 and not out[index] <= cross / across:
                out[index] = cross / across


@kernel(allocates=True)
def compare_sectors(
    old: Ranges, new: Ranges, predicted: Ranges, sector: int, noise: Noise
) -> tuple[Array, Array]:
    """Compares the observed changes of ranges with the predicted ones, sector by sector.

    A sector is undecided if at most a third of its directions have finite ranges in all three
    scans, or if the root mean square of its predicted changes is below the threshold.

    Args:
        old: ranges (K,) of the old scan [m].
        new: ranges (K,) of the new one [m].
        predicted: ranges (K,) that the motion in between predicts for the new one [m].
        sector: number of directions in a sector.
        noise: of the ranges.

    Returns:
        observed: fraction of the predicted change that was observed (S,), by least squares, with
            observed changes clipped to twice the predicted ones; NaN for undecided sectors.
        changed: fraction of the compared directions (S,) whose ranges changed visibly.
    """
    count = old.shape[0]
    observed = np.full((count + sector - 1) // sector, math.nan)
    changed = np.zeros(observed.shape[0])
    for index in range(observed.shape[0]):
        begin = index * sector
        end = min(begin + sector, count)
        observed[index], changed[index] = _compare_sector(
            old[begin:end], new[begin:end], predicted[begin:end], noise
        )
    return observed, changed


@kernel
def _compare_sector(
    old: Ranges, new: Ranges, predicted: Ranges, noise: Noise
) -> tuple[float, float]:
    """Returns the observed and the changed fraction of one sector; NaN and 0 if undecided."""
    compared = 0
    visible = 0
    products = 0.0
    squares = 0.0
    needed_squares = 0.0
    for k in range(old.shape[0]):
        predicted_change = predicted[k] - old[k]
        observed_change = new[k] - old[k]
        if not (math.isfinite(predicted_change) and math.isfinite(observed_change)):
            continue
        std = noise.constant + noise.proportional * old[k]
        needed = max(MIN_CHANGE, MIN_DEVIATIONS * std)
        if abs(observed_change) > max(VISIBLE_CHANGE, VISIBLE_DEVIATIONS * std):
            visible += 1
        limit = 2.0 * abs(predicted_change)
        compared += 1
        products += predicted_change * min(max(observed_change, -limit), limit)
        squares += predicted_change * predicted_change
        needed_squares += needed * needed
    if 3 * compared > old.shape[0] and squares > needed_squares:
        return products / squares, visible / compared
    return math.nan, 0.0
