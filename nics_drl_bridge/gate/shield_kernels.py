"""Compiled: sweep of a round footprint along arcs, and obstacles where the view was free before."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel

WIDTH = 0.02  # old beams within this angle of a bearing are compared [rad]


@kernel(allocates=True)
def place(twist, time):  # type: ignore[no-untyped-def]
    """Returns the position x, y after a time on the exact arc of a body twist (3,)."""
    turn = twist[2] * time
    if abs(turn) < 1e-6:
        a, b = 1.0, turn / 2.0
    else:
        a, b = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    return (a * twist[0] - b * twist[1]) * time, (b * twist[0] + a * twist[1]) * time


@kernel(allocates=True)
def free(points, twists, blind, deceleration, room, step):  # type: ignore[no-untyped-def]
    """True if no point (P, 3) comes within `room` [m] of twists (K, 3) until the robot rests."""
    # One that is already that near must not come nearer. Points are x, y [m] and greatest speed
    # [m/s]; the robot keeps its twist for `blind` [s], then brakes; places are a `step` [m] apart.
    longest, rest = 0.0, 0.0
    for k in range(twists.shape[0]):
        speed = math.hypot(twists[k, 0], twists[k, 1])
        longest = max(longest, speed * (blind + speed / (2.0 * deceleration)))
        rest = max(rest, blind + speed / deceleration)
    near = np.empty((points.shape[0], 4))
    count = 0
    for p in range(points.shape[0]):
        away = math.hypot(points[p, 0], points[p, 1])
        if away < room + longest + points[p, 2] * rest:
            near[count, 0], near[count, 1] = points[p, 0], points[p, 1]
            near[count, 2], near[count, 3] = points[p, 2], away * (1.0 - 1e-9)
            count += 1
    if count == 0:
        return True
    for k in range(twists.shape[0]):
        speed = math.hypot(twists[k, 0], twists[k, 1])
        duration = blind + speed / (2.0 * deceleration)
        steps = math.ceil(speed * duration / step)
        for s in range(1, steps + 1):
            part = duration * s / steps
            x, y = place(twists[k], part)
            time = _reached(part, speed, blind, deceleration)
            for p in range(count):
                dx, dy = near[p, 0] - x, near[p, 1] - y
                least = min(room, near[p, 3]) + near[p, 2] * time
                if dx * dx + dy * dy < least * least:
                    return False
    return True


@kernel(allocates=True)
def _reached(part, speed, blind, deceleration):  # type: ignore[no-untyped-def]
    """Returns when a braking robot is where it would be at `part` at its initial speed [s]."""
    if part <= blind:
        return part
    left = speed * speed - 2.0 * deceleration * speed * (part - blind)
    return blind + (speed - math.sqrt(max(left, 0.0))) / deceleration


class MountedBeams(NamedTuple):
    """Angle of beam 0 and between beams [rad], and the mount: x, y [m], heading [rad]."""

    first: float
    step: float
    x: float
    y: float
    heading: float


@kernel(allocates=True)
def entered(out, ranges, old, lidar, moved, far, tolerance):  # type: ignore[no-untyped-def]
    """Marks in `out` (B,) the beams of a scan (B,) that end where an old one saw free space."""
    # The robot's own motion, `moved` (3,), is compensated; hidden or unknown places, and other
    # flags, stay. `far` is the greatest range [m]; the tolerance is in metres and of the range.
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
