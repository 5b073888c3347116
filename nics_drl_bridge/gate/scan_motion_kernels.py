"""Compiled: a scan reduced to few directions, how it changes by a motion, and whether it did."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel

# beams; a direction of a denser lidar is the median of some of its beams
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
    """Changes of a range that count: the greater of a length and a number of deviations."""

    telling: float  # a predicted change that tells something [m]
    telling_deviations: float
    visible: float  # an observed change that was no noise [m]
    visible_deviations: float


@kernel(allocates=True)
def reduce_scan(ranges, directions, out):  # type: ignore[no-untyped-def]
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
            place = size
            while place > 0 and window[place - 1] > value:
                window[place] = window[place - 1]
                place -= 1
            window[place] = value
            size += 1
        out[k] = window[size // 2] if 2 * size > total else math.nan


@kernel
def predict_scan(ranges, directions, moved, gap, out):  # type: ignore[no-untyped-def]
    """Writes the ranges (K,) that a lidar sees after a motion, from the surfaces it saw before.

    `moved` (3,) is the motion of the lidar, x, y [m] and heading [rad], in its old frame. A surface
    joins neighbouring ends whose ranges differ by at most `gap` of the nearer one; directions that
    no surface covers are NaN.
    """
    count = ranges.shape[0]
    out[:] = math.nan
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    for k in range(count if directions.full_circle else count - 1):
        near = ranges[k]
        far = ranges[(k + 1) % count]
        if not abs(near - far) <= gap * min(near, far):
            continue
        bearing = directions.first + k * directions.step
        ax = near * math.cos(bearing) - moved[0]
        ay = near * math.sin(bearing) - moved[1]
        bearing += directions.step
        bx = far * math.cos(bearing) - moved[0]
        by = far * math.sin(bearing) - moved[1]
        ax, ay = cosine * ax + sine * ay, cosine * ay - sine * ax
        bx, by = cosine * bx + sine * by, cosine * by - sine * bx
        cross = ax * by - ay * bx
        if cross <= 0.0 or ax * bx + ay * by <= 0.0:
            continue  # seen from behind, or around the lidar itself
        begin = (math.atan2(ay, ax) - directions.first) / directions.step
        end = begin + math.atan2(cross, ax * bx + ay * by) / directions.step
        turn = 2.0 * math.pi / directions.step  # directions in a full turn
        shift = turn * math.floor(begin / turn)
        begin -= shift
        end -= shift
        direction = math.ceil(begin)
        while direction <= end:
            wrapped = direction if direction < turn - 0.5 else round(direction - turn)
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
def compare_sectors(old, new, predicted, sector, noise, thresholds):  # type: ignore[no-untyped-def]
    """Compares the observed changes of ranges with the predicted ones, sector by sector.

    Ranges (K,) are those of an old scan, of a new one, and what the motion in between predicts.
    A `sector` has so many directions. Its share is NaN if at most a third of them have
    finite ranges in all three scans, or if the root mean square of its predicted changes is below
    the threshold of what tells something.

    Returns:
        shares: of the predicted change that was observed (S,), by least squares, with observed
            changes cut at twice the predicted ones; NaN for a sector that is unknown.
        changed: fraction of the known directions (S,) whose ranges changed visibly.
    """
    count = old.shape[0]
    shares = np.full((count + sector - 1) // sector, math.nan)
    changed = np.zeros(shares.shape[0])
    for index in range(shares.shape[0]):
        begin = index * sector
        end = min(begin + sector, count)
        known = 0
        visible = 0
        products = 0.0
        squares = 0.0
        needed = 0.0
        for k in range(begin, end):
            predicted_change = predicted[k] - old[k]
            observed_change = new[k] - old[k]
            if not (math.isfinite(predicted_change) and math.isfinite(observed_change)):
                continue
            std = noise.constant + noise.proportional * old[k]
            telling = max(thresholds.telling, thresholds.telling_deviations * std)
            if abs(observed_change) > max(
                thresholds.visible, thresholds.visible_deviations * std
            ):
                visible += 1
            most = 2.0 * abs(predicted_change)
            known += 1
            products += predicted_change * min(max(observed_change, -most), most)
            squares += predicted_change * predicted_change
            needed += telling * telling
        if 3 * known > end - begin and squares > needed:
            shares[index] = products / squares
            changed[index] = visible / known
    return shares, changed
