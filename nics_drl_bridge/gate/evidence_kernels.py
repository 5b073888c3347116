"""Compiled: compares the ends of a scan's beams with an earlier scan.

- `mark_agreeing` marks the beams that end where the old scan ended.
- `mark_entered` marks those that end in space that the old scan showed to be free.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import Array
from nics_drl_bridge.kernels import kernel

Ranges = NDArray[np.float32]
Flags = NDArray[np.bool_]
# Beams of the old scan within this angle of a point show whether it was free [rad].
COMPARED_ANGLE = 0.02


class MountedBeams(NamedTuple):
    """The beams of a lidar, and its mount on the robot.

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

    Beams that end outside the view of the old scan stay unmarked.

    Args:
        entered: (B,) flags, set for these beams.
        ranges: (B,) of the scan [m].
        old_ranges: (B,) of the old scan [m].
        lidar: its beams.
        moved: (3,) motion since the old scan, in the robot's frame then: x, y [m], heading [rad].
        range_max: of the lidar [m].
        tolerance: by which a beam must end before the free space of the old scan does.
    """
    beams = len(ranges)
    whole_circle = round(2.0 * math.pi / abs(lidar.step))
    neighbours = math.ceil(COMPARED_ANGLE / abs(lidar.step))
    for b in range(beams):
        if entered[b] or not np.isfinite(ranges[b]):
            continue
        distance, middle = find_in_old_scan(ranges[b], b, lidar, moved)
        free_range = range_max
        for i in range(middle - neighbours, middle + neighbours + 1):
            index = i % whole_circle
            old_range = old_ranges[index] if index < beams else np.nan
            free_range = np.minimum(free_range, old_range)  # NaN if either is
        if (
            distance
            < free_range - tolerance.constant - tolerance.proportional * distance
        ):
            entered[b] = True


@kernel
def mark_agreeing(
    agreeing: Flags,
    ranges: Ranges,
    old_ranges: Ranges,
    lidar: MountedBeams,
    motions: Array,
    tolerance: Tolerance,
    stride: int,
) -> None:
    """Takes every `stride`-th beam, and marks those that end where the old scan ended.

    Args:
        agreeing: (n, ceil(B / stride)) flags, set or cleared, for each motion.
        ranges: (B,) of the scan [m].
        old_ranges: (B,) of the old scan [m].
        lidar: its beams.
        motions: (n, 3) possible motions since the old scan, in the robot's frame then:
            x, y [m], heading [rad].
        tolerance: by which the ends may differ.
        stride: number of beams from one that is compared to the next.
    """
    beams = len(ranges)
    whole_circle = round(2.0 * math.pi / abs(lidar.step))
    agreeing[:] = False
    for k in range(agreeing.shape[1]):
        beam = k * stride
        if not np.isfinite(ranges[beam]):
            continue
        for i in range(len(motions)):
            distance, middle = find_in_old_scan(ranges[beam], beam, lidar, motions[i])
            index = middle % whole_circle
            if index < beams:
                allowed = tolerance.constant + tolerance.proportional * distance
                agreeing[i, k] = abs(distance - old_ranges[index]) <= allowed


@kernel
def find_in_old_scan(
    length: float, beam: int, lidar: MountedBeams, moved: Array
) -> tuple[float, int]:
    """Returns the end of a beam, as seen from the lidar at the old scan.

    Args:
        length: range of the beam [m].
        beam: its index.
        lidar: its beams.
        moved: (3,) motion since the old scan, in the robot's frame then: x, y [m], heading [rad].

    Returns:
        distance: from the lidar at the old scan [m].
        index: of the beam that points there, see `find_beam`.
    """
    angle = lidar.first + beam * lidar.step + lidar.heading
    x = lidar.x + length * math.cos(angle)
    y = lidar.y + length * math.sin(angle)
    cosine = math.cos(moved[2])
    sine = math.sin(moved[2])
    old_x = moved[0] + cosine * x - sine * y
    old_y = moved[1] + sine * x + cosine * y
    distance = math.hypot(old_x - lidar.x, old_y - lidar.y)
    return distance, find_beam(old_x, old_y, lidar)


@kernel
def find_beam(x: float, y: float, lidar: MountedBeams) -> int:
    """Returns the index of the beam towards a point, as if the beams covered the full circle."""
    circle = 2.0 * math.pi / abs(lidar.step)  # in beams
    angle = math.atan2(y - lidar.y, x - lidar.x)
    bearing = (angle - lidar.heading - lidar.first) / lidar.step
    return math.floor(bearing - circle * math.floor((bearing + 0.5) / circle) + 0.5)
