"""Compiled broad phase: the bodies of one crowded world sorted into square cells.

Rebuilt each period, by counting, so that a robot looks at the bodies around it only and the cost
per robot stays the same however many share the world. Bodies larger than a cell are in none and
are always looked at.

`cells` are scratch: begin (C^2 + 2,) where each cell begins in `order` (K,); the last is of the
large ones; cell_of (K,); frame (5,): x, y [m] of the first cell, cells per metre, greatest radius
of those in cells [m], and how far any body can have come since [m].
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel

X, Y, PER_METRE, RADIUS, MOVED = range(5)


@kernel
def _clamp(place, side):  # type: ignore[no-untyped-def]
    return int(min(max(place, 0.0), side - 1.0))


@kernel
def sort_bodies(bodies, n, cells):  # type: ignore[no-untyped-def]
    """Sorts the bodies of world n into cells; about two cells for a body."""
    begin, order, cell_of, frame = cells
    count, side = bodies.shape[1], int(math.sqrt(begin.shape[0] - 2))
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for k in range(count):
        if bodies[n, k, 5] > 0.0:
            low_x, high_x = min(low_x, bodies[n, k, 0]), max(high_x, bodies[n, k, 0])
            low_y, high_y = min(low_y, bodies[n, k, 1]), max(high_y, bodies[n, k, 1])
    extent = max(high_x - low_x, high_y - low_y, 1e-6)
    per_metre = side / extent if extent < np.inf else 1.0
    frame[X], frame[Y], frame[PER_METRE], frame[RADIUS], frame[MOVED] = (
        low_x, low_y, per_metre, 0.0, 0.0,
    )  # fmt: skip
    for cell in range(begin.shape[0]):
        begin[cell] = 0
    for k in range(count):
        radius, cell = bodies[n, k, 5], side * side
        if radius * per_metre <= 1.0:
            i = _clamp((bodies[n, k, 1] - low_y) * per_metre, side)
            cell = i * side + _clamp((bodies[n, k, 0] - low_x) * per_metre, side)
            frame[RADIUS] = max(frame[RADIUS], radius)
        cell_of[k] = cell
        begin[cell + 1] += 1
    for cell in range(begin.shape[0] - 1):
        begin[cell + 1] += begin[cell]
    for k in range(count - 1, -1, -1):
        cell = cell_of[k] + 1
        begin[cell] -= 1
        order[begin[cell]] = k
    # Each entry now tells where the cell before it begins, and the last one where all end.
    for cell in range(begin.shape[0] - 1):
        begin[cell] = begin[cell + 1]
    begin[begin.shape[0] - 1] = count


@kernel
def bodies_around(x, y, reach, cells, found):  # type: ignore[no-untyped-def]
    """Writes to `found` (K,) the bodies that may come within `reach` [m] of (x, y); how many."""
    begin, order, _, frame = cells
    side = int(math.sqrt(begin.shape[0] - 2))
    reach += frame[RADIUS] + frame[MOVED]
    left = _clamp((x - reach - frame[X]) * frame[PER_METRE], side)
    right = _clamp((x + reach - frame[X]) * frame[PER_METRE], side)
    low = _clamp((y - reach - frame[Y]) * frame[PER_METRE], side)
    high = _clamp((y + reach - frame[Y]) * frame[PER_METRE], side)
    count = 0
    for i in range(low, high + 1):
        for k in range(begin[i * side + left], begin[i * side + right + 1]):
            found[count] = order[k]
            count += 1
    for k in range(begin[side * side], begin[side * side + 1]):
        found[count] = order[k]
        count += 1
    return count
