"""Bodies in square cells: those around a point are found without a look at all the others.

A body lies in the cell of its centre, from which a chain leads to the next one there. One larger
than a cell lies in none: it is always found, as are bodies that are said to move. The outermost
cells reach to infinity. Shared arguments: n is a world, k a body of it, a place is in [m].
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y

LEFT, BOTTOM, PER_METRE, SIDE, LARGEST, MOVED, FRAME = range(7)
"""Columns of `BodyCells.frame`: x, y of the first cell [m], cells per metre, cells in a row,
greatest radius of the bodies in cells [m], greatest distance moved since by any of them [m]."""
PER_BODY = 2.0  # Cells


FEWEST = 20  # Least number of bodies among which those in cells are found in less time


class BodyCells(NamedTuple):
    """The bodies of N worlds in G x G cells each; without rows, all bodies are always found."""

    head: NDArray[np.int32]  # (N, G^2 + 1) first body of each cell, then of those in none; or -1
    after: NDArray[np.int32]  # (N, K) the next body of the same cell, or -1
    frame: NDArray[np.float64]  # (N, FRAME)
    found: NDArray[np.int32]  # (K,) scratch for one thread: the bodies around a point


def body_cells(worlds: int, bodies: int) -> BodyCells:
    """Allocates cells for K bodies in each of N worlds; 0 worlds if all bodies are looked at."""
    side = max(int(math.sqrt(PER_BODY * bodies)), 1)
    cells = BodyCells(
        np.full((worlds, side * side + 1), -1, np.int32), np.full((worlds, bodies), -1, np.int32),
        np.zeros((worlds, FRAME)), np.arange(bodies, dtype=np.int32),
    )  # fmt: skip
    cells.frame[:, SIDE] = side
    return cells


@kernel(inline=True)
def _place(way, cells_per_metre, side):  # type: ignore[no-untyped-def]
    return int(min(max(way * cells_per_metre, 0.0), side - 1.0))


@kernel
def cover(n, low_x, low_y, extent, cells):  # type: ignore[no-untyped-def]
    """Lays the cells of a world, which are empty then, over a square from (low_x, low_y) on."""
    frame = cells.frame[n]
    frame[LEFT], frame[BOTTOM] = low_x, low_y
    frame[PER_METRE] = frame[SIDE] / extent if 0.0 < extent < np.inf else 1.0
    clear(n, cells)


@kernel
def clear(n, cells):  # type: ignore[no-untyped-def]
    """Empties the cells of a world."""
    if cells.head.shape[0] > 0:
        cells.head[n, :] = -1
        cells.frame[n, LARGEST] = cells.frame[n, MOVED] = 0.0


@kernel
def add(n, k, body, stands, cells):  # type: ignore[no-untyped-def]
    """Adds a body (7,) that is in no cell yet, to a cell if it stands."""
    if cells.head.shape[0] == 0:
        return
    frame, cell = cells.frame[n], cells.head.shape[1] - 1
    if stands and body[RADIUS] * frame[PER_METRE] <= 1.0:
        side = frame[SIDE]
        row = _place(body[Y] - frame[BOTTOM], frame[PER_METRE], side)
        cell = row * int(side) + _place(body[X] - frame[LEFT], frame[PER_METRE], side)
        frame[LARGEST] = max(frame[LARGEST], body[RADIUS])
    cells.after[n, k], cells.head[n, cell] = cells.head[n, cell], k


@kernel
def sort(n, bodies, standing, cells):  # type: ignore[no-untyped-def]
    """Sorts the bodies (K, 7) of a world, the first `standing` of them into cells."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for k in range(standing):
        if bodies[k, RADIUS] > 0.0:
            low_x, high_x = min(low_x, bodies[k, X]), max(high_x, bodies[k, X])
            low_y, high_y = min(low_y, bodies[k, Y]), max(high_y, bodies[k, Y])
    cover(n, low_x, low_y, max(high_x - low_x, high_y - low_y, 1e-6), cells)
    for k in range(bodies.shape[0] - 1, -1, -1):
        if bodies[k, RADIUS] > 0.0:
            add(n, k, bodies[k], k < standing, cells)


@kernel
def around(n, x, y, reach, cells):  # type: ignore[no-untyped-def]
    """Writes to `found` the bodies that may be within `reach` [m] of a place; their number."""
    head, found, count = cells.head, cells.found, 0
    if head.shape[0] == 0:
        return found.shape[0]  # which lists all bodies
    frame, per_metre, last = cells.frame[n], cells.frame[n, PER_METRE], head.shape[1] - 1
    reach, side = reach + frame[LARGEST] + frame[MOVED], frame[SIDE]
    left = _place(x - reach - frame[LEFT], per_metre, side)
    right = _place(x + reach - frame[LEFT], per_metre, side)
    low = _place(y - reach - frame[BOTTOM], per_metre, side)
    high = _place(y + reach - frame[BOTTOM], per_metre, side)
    for row in range(low, high + 1):
        for cell in range(row * int(side) + left, row * int(side) + right + 1):
            k = head[n, cell]
            while k >= 0:
                found[count], k, count = k, cells.after[n, k], count + 1
    k = head[n, last]
    while k >= 0:
        found[count], k, count = k, cells.after[n, k], count + 1
    return count
