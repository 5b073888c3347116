"""Compiled sweep of a round footprint along arcs."""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel


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
    """True if no point comes within `room` of any of the arcs before the robot rests on it.

    A point that is already that near must not come nearer, so that the robot can leave it. A moving
    point may be nearer by all that it can have moved, even one that the robot drives away from.

    Args:
        points: (P, 3) x, y [m], and greatest speed of each [m/s].
        twists: (K, 3) body twists of the arcs.
        blind: time for which the robot keeps its twist before it brakes [s].
        deceleration: of the braking [m/s^2].
        room: distance to keep [m].
        step: distance between the places that are checked [m].
    """
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
