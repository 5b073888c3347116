"""Compiled: marks what has moved into space that an earlier scan showed to be free."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel

Ranges = NDArray[np.float32]
Flags = NDArray[np.bool_]
# Beams of the old scan within this angle of a place show whether it was free [rad].
COMPARED_ANGLE = 0.02


class MountedBeams(NamedTuple):
    """The beams of a lidar, and where it is mounted on the robot.

    Attributes:
        first: angle of beam 0 in the lidar's frame [rad].
        step: angle between neighbouring beams [rad].
        x: of the lidar in the robot's frame [m].
        y: of the lidar in the robot's frame [m].
        heading: of the lidar in the robot's frame [rad].
    """

    first: float
    step: float
    x: float
    y: float
    heading: float


class Tolerance(NamedTuple):
    """Tolerance of a range, as constant + proportional * range."""

    constant: float  # [m]
    proportional: float


@kernel(allocates=True)
def mark_entered(
    entered: Flags,
    ranges: Ranges,
    old_ranges: Ranges,
    lidar: MountedBeams,
    moved: Array,
    range_max: float,
    tolerance: Tolerance,
) -> None:
    """Marks the beams of a scan that end where an old scan saw free space.

    Beams that end in places which the old scan did not show stay as they are.

    Args:
        entered: (B,) flags, set for these beams.
        ranges: (B,) of the scan [m].
        old_ranges: (B,) of the old scan [m].
        lidar: its beams.
        moved: (3,) motion of the robot since the old scan: x, y [m], heading [rad].
        range_max: of the lidar [m].
        tolerance: by which a beam must end before the old ones.
    """
    beams = len(ranges)
    circle = 2.0 * math.pi / abs(lidar.step)  # in beams
    whole_circle = round(circle)
    neighbours = math.ceil(COMPARED_ANGLE / abs(lidar.step))
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    for b in range(beams):
        if entered[b] or not np.isfinite(ranges[b]):
            continue
        # The end of the beam, as seen from the lidar at the old scan.
        angle = lidar.first + b * lidar.step + lidar.heading
        x = lidar.x + ranges[b] * math.cos(angle)
        y = lidar.y + ranges[b] * math.sin(angle)
        dx = moved[0] + cosine * x - sine * y - lidar.x
        dy = moved[1] + sine * x + cosine * y - lidar.y
        distance = math.hypot(dx, dy)
        bearing = (math.atan2(dy, dx) - lidar.heading - lidar.first) / lidar.step
        middle = round(bearing - circle * math.floor(bearing / circle))
        free = range_max
        for i in range(middle - neighbours, middle + neighbours + 1):
            index = i % whole_circle
            old_range = old_ranges[index] if index < beams else np.nan
            free = take_shorter(free, old_range)
        if distance < free - tolerance.constant - tolerance.proportional * distance:
            entered[b] = True


@kernel
def take_shorter(length: float, other: float) -> float:
    """Returns the shorter of two ranges; NaN as soon as either of them is unknown."""
    if math.isnan(length) or other >= length:
        return length
    return other
