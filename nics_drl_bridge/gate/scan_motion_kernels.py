"""Compiled: reduces a scan to few directions, predicts its change by a motion, and compares."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel

Ranges = NDArray[np.float32]
# Maximum number of beams in a window; in a denser lidar's the median is that of some of its beams.
LARGEST_WINDOW = 129


class Directions(NamedTuple):
    """The directions of a reduced scan, evenly spaced in the frame of the lidar."""

    first: float  # [rad]
    step: float  # between neighbours, greater than 0 [rad]
    beams: float  # of the lidar per direction
    reach: int  # beams beside the middle one whose median is taken, on each side
    full_circle: bool  # the last direction is a neighbour of the first


class Noise(NamedTuple):
    """Change of a reduced range that noise can explain, as a + b * range."""

    constant: float  # [m]
    proportional: float


class Thresholds(NamedTuple):
    """Changes of a range that count: the larger of a length and a number of deviations."""

    predicted: float  # change that the motion must cause for a comparison [m]
    predicted_deviations: float
    visible: float  # observed change that is no noise [m]
    visible_deviations: float


@kernel(allocates=True)
def reduce_scan(ranges: Ranges, directions: Directions, out: Ranges) -> None:
    """Writes the median range around each direction (K,) to `out`; NaN where few beams return."""
    beams = ranges.shape[0]
    window = np.empty(LARGEST_WINDOW)
    for k in range(out.shape[0]):
        middle = int((k + 0.5) * directions.beams)
        size = 0
        total = 0
        for offset in range(-directions.reach, directions.reach + 1):
            beam = middle + offset
            if directions.full_circle:
                beam = (beam + beams) % beams
            elif beam < 0 or beam >= beams:
                continue
            total += 1
            value = ranges[beam]
            if not math.isfinite(value):
                continue
            index = size  # sort by insertion
            while index > 0 and window[index - 1] > value:
                window[index] = window[index - 1]
                index -= 1
            window[index] = value
            size += 1
        out[k] = math.nan
        if 2 * size > total:
            out[k] = window[size // 2]


@kernel
def predict_scan(
    ranges: Ranges, directions: Directions, moved: Array, gap: float, out: Ranges
) -> None:
    """Writes the ranges (K,) that a lidar sees after a motion, from the surfaces it saw before.

    `moved` (3,) is the motion of the lidar, x, y [m] and heading [rad], in its old frame. Ends of
    neighbouring beams are one surface if their ranges differ by at most `gap`, a fraction of the
    shorter one. Directions that no surface covers are NaN.
    """
    count = ranges.shape[0]
    out[:] = math.nan
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    pairs = count - 1
    if directions.full_circle:
        pairs = count
    circle = 2.0 * math.pi / directions.step  # in directions
    for k in range(pairs):
        range_a = ranges[k]
        range_b = ranges[(k + 1) % count]
        if not abs(range_a - range_b) <= gap * min(range_a, range_b):
            continue
        bearing = directions.first + k * directions.step
        ax = range_a * math.cos(bearing) - moved[0]
        ay = range_a * math.sin(bearing) - moved[1]
        bearing += directions.step
        bx = range_b * math.cos(bearing) - moved[0]
        by = range_b * math.sin(bearing) - moved[1]
        ax, ay = cosine * ax + sine * ay, cosine * ay - sine * ax
        bx, by = cosine * bx + sine * by, cosine * by - sine * bx
        cross = ax * by - ay * bx
        if cross <= 0.0 or ax * bx + ay * by <= 0.0:
            continue  # seen from behind, or around the lidar itself
        begin = (math.atan2(ay, ax) - directions.first) / directions.step
        end = begin + math.atan2(cross, ax * bx + ay * by) / directions.step
        shift = circle * math.floor(begin / circle)
        begin -= shift
        end -= shift
        direction = math.ceil(begin)
        while direction <= end:
            wrapped = direction
            if direction >= circle - 0.5:
                wrapped = round(direction - circle)
            if wrapped < count:
                angle = directions.first + wrapped * directions.step
                ux = math.cos(angle)
                uy = math.sin(angle)
                across = ux * (by - ay) - uy * (bx - ax)
                if across > 0.0:
                    length = cross / across
                    if not out[wrapped] <= length:
                        out[wrapped] = length
            direction += 1


@kernel(allocates=True)
def compare_sectors(
    old: Ranges,
    new: Ranges,
    predicted: Ranges,
    sector: int,
    noise: Noise,
    thresholds: Thresholds,
) -> tuple[Array, Array]:
    """Compares the observed changes of ranges with the predicted ones, sector by sector.

    Ranges (K,) are those of an old scan, of a new one, and what the motion in between predicts.
    A sector of `sector` directions is undecided if at most a third of them have finite ranges in
    all three scans, or if the root mean square of its predicted changes is below the threshold.

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
        compared = 0
        visible = 0
        products = 0.0
        squares = 0.0
        needed_squares = 0.0
        for k in range(begin, end):
            predicted_change = predicted[k] - old[k]
            observed_change = new[k] - old[k]
            if not (math.isfinite(predicted_change) and math.isfinite(observed_change)):
                continue
            std = noise.constant + noise.proportional * old[k]
            needed = max(thresholds.predicted, thresholds.predicted_deviations * std)
            if abs(observed_change) > max(
                thresholds.visible, thresholds.visible_deviations * std
            ):
                visible += 1
            limit = 2.0 * abs(predicted_change)
            compared += 1
            products += predicted_change * min(max(observed_change, -limit), limit)
            squares += predicted_change * predicted_change
            needed_squares += needed * needed
        if 3 * compared > end - begin and squares > needed_squares:
            observed[index] = products / squares
            changed[index] = visible / compared
    return observed, changed
