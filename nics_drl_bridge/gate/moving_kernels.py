"""Compiled comparison of two scans: obstacles where the view was free before."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel

WIDTH = 0.02
"""Old beams within this angle of a bearing are compared [rad]."""


class MountedBeams(NamedTuple):
    """Angle of beam 0 and between beams [rad], and the mount: x, y [m], heading [rad]."""

    first: float
    step: float
    x: float
    y: float
    heading: float


@kernel(allocates=True)
def entered(out, ranges, old, lidar, moved, far, tolerance):  # type: ignore[no-untyped-def]
    """Marks the beams that end where an older scan saw free space.

    The robot's own motion in between is compensated. Places hidden or unknown then are not marked.

    Args:
        out: (B,) bool, set where a beam is marked; otherwise left as it is.
        ranges, old: (B,) the newer and the older scan, REP-117 [m].
        lidar: that both scans are from.
        moved: (3,) present pose of the robot relative to that of the older scan.
        far: greatest range [m].
        tolerance: for noise, in metres and as a share of the range.
    """
    beams, circle = len(ranges), 2.0 * math.pi / abs(lidar.step)
    whole, wide = round(circle), math.ceil(WIDTH / abs(lidar.step))
    cosine, sine = math.cos(moved[2]), math.sin(moved[2])
    for b in range(beams):
        if out[b] or not np.isfinite(ranges[b]):
            continue
        angle = lidar.first + b * lidar.step + lidar.heading
        x, y = lidar.x + ranges[b] * math.cos(angle), lidar.y + ranges[b] * math.sin(angle)
        dx = moved[0] + cosine * x - sine * y - lidar.x
        dy = moved[1] + sine * x + cosine * y - lidar.y
        away = math.hypot(dx, dy)
        at = (math.atan2(dy, dx) - lidar.heading - lidar.first) / lidar.step
        middle, seen = round(at - circle * math.floor(at / circle)), far
        for i in range(middle - wide, middle + wide + 1):
            index = i % whole
            beyond = old[index] if index < beams else np.nan
            # Not `min`: with NaN, or an old beam that was too close, the beam must stay unmarked.
            seen = beyond if not beyond >= seen else seen
        if away < seen - tolerance[0] - tolerance[1] * away:
            out[b] = True
