"""Compiled sweep of a round footprint along arcs."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def place(twist, time):  # type: ignore[no-untyped-def]
    """Where the exact arc of a body twist (3,) leads to in a time: x, y."""
    turn = twist[2] * time
    if abs(turn) < 1e-6:
        a, b = 1.0, turn / 2.0
    else:
        a, b = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    return (a * twist[0] - b * twist[1]) * time, (b * twist[0] + a * twist[1]) * time


@njit(cache=True)
def free(points, twists, duration, room, step):  # type: ignore[no-untyped-def]
    """Whether no point comes within `room` of any of the arcs.

    A point that is as near already must not come nearer; so the robot can leave it.

    Args:
        points: (P, 2) [m].
        twists: (K, 3).
        duration: (K,) of each [s].
        room: [m].
        step: between places that are looked at [m].
    """
    longest = 0.0
    for k in range(twists.shape[0]):
        longest = max(longest, math.hypot(twists[k, 0], twists[k, 1]) * duration[k])
    near = np.empty((points.shape[0], 3))
    count = 0
    for p in range(points.shape[0]):
        away = math.hypot(points[p, 0], points[p, 1])
        if away < room + longest:
            near[count, 0], near[count, 1] = points[p, 0], points[p, 1]
            least = min(room, away * (1.0 - 1e-9))
            near[count, 2] = least * least
            count += 1
    if count == 0:
        return True
    for k in range(twists.shape[0]):
        length = math.hypot(twists[k, 0], twists[k, 1]) * duration[k]
        steps = math.ceil(length / step)
        for s in range(1, steps + 1):
            x, y = place(twists[k], duration[k] * s / steps)
            for p in range(count):
                dx, dy = near[p, 0] - x, near[p, 1] - y
                if dx * dx + dy * dy < near[p, 2]:
                    return False
    return True
