"""Bodies sorted into square cells, so that those around a point are found without testing all.

A body lies in the cell of its centre. One that moves or is larger than a cell is in no cell and is
always found. The outermost cells reach to infinity. Bodies are either sorted all at once, so that
neighbouring cells are contiguous, or added one by one to a chain per cell. Shared arguments: n is a
world, k a body in it, places are in [m].
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, ShortIntegers
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y

LEFT, BOTTOM, PER_METRE, SIDE, LARGEST, MOVED, FRAME = range(7)
"""Columns of `BodyCells.frame`: x, y of the first cell [m], cells per metre, cells in a row,
maximum radius of the bodies in cells [m], maximum distance moved since by any of them [m]."""
PER_BODY = 1.0  # Cells


FEWEST = 20  # with fewer bodies, testing all takes less time than cells


class BodyCells(NamedTuple):
    """The bodies of N worlds in G x G cells each; without rows, all bodies are always found."""

    # (N, G^2 + 2) place in `then` of each cell's first body, those in no cell being the last; of
    # chains the first body itself, or -1
    first: ShortIntegers
    # (N, K) the bodies in the order of cells; of a chain the next, or -1. One row if the bodies
    # themselves are put into that order
    then: ShortIntegers
    ordered: bool  # True if they are
    frame: Array  # (N, FRAME)
    found: ShortIntegers  # (K,) scratch for one thread: the bodies around a point


def body_cells(worlds: int, bodies: int, ordered: bool = False) -> BodyCells:
    """Allocate cells for K bodies in each of N worlds; 0 worlds if all bodies are looked at."""
    rows = worlds
    if ordered:
        rows = min(worlds, 1)
    side = max(int(math.sqrt(PER_BODY * bodies)), 1)
    cells = BodyCells(
        np.full((worlds, side * side + 2), -1, np.int32),
        np.full((rows, bodies), -1, np.int32),
        ordered,
        np.zeros((worlds, FRAME)),
        np.arange(bodies, dtype=np.int32),
    )
    cells.frame[:, SIDE] = side
    return cells


@kernel(view=True)
def limit_found(cells: BodyCells, count: int) -> BodyCells:
    """Return cells whose list of all bodies ends after some of them."""
    c = cells
    return BodyCells(c.first, c.then, c.ordered, c.frame, c.found[:count])


@kernel(inline=True)
def _place(way: float, cells_per_metre: float, side: float) -> int:
    return int(min(max(way * cells_per_metre, 0.0), side - 1.0))


@kernel
def cover(n: int, low_x: float, low_y: float, extent: float, cells: BodyCells) -> None:
    """Place the empty cells of a world on a square with the corner (low_x, low_y)."""
    if cells.first.shape[0] > 0:
        frame = cells.frame[n]
        frame[LEFT] = low_x
        frame[BOTTOM] = low_y
        frame[PER_METRE] = 1.0
        if 0.0 < extent < np.inf:
            frame[PER_METRE] = frame[SIDE] / extent
        clear(n, cells)


@kernel
def clear(n: int, cells: BodyCells) -> None:
    """Empty the cells of a world."""
    if cells.first.shape[0] > 0:
        cells.first[n, :] = -1
        cells.frame[n, LARGEST] = cells.frame[n, MOVED] = 0.0


@kernel(inline=True)
def _cell(body: Array, stands: bool, frame: Array) -> int:
    side = int(frame[SIDE])
    if not stands or body[RADIUS] * frame[PER_METRE] > 1.0:
        return side * side
    frame[LARGEST] = max(frame[LARGEST], body[RADIUS])
    row = _place(body[Y] - frame[BOTTOM], frame[PER_METRE], side)
    return row * side + _place(body[X] - frame[LEFT], frame[PER_METRE], side)


@kernel
def add(n: int, k: int, body: Array, cells: BodyCells) -> None:
    """Add a body (7,) to the chain of its cell."""
    if cells.first.shape[0] > 0:
        cell = _cell(body, True, cells.frame[n])
        cells.then[n, k] = cells.first[n, cell]
        cells.first[n, cell] = k


@kernel
def sort(n: int, bodies: Array, standing: int, cells: BodyCells) -> None:
    """Sort the bodies (K, 7) of a world, the first `standing` of them by cells."""
    low_x = np.inf
    low_y = np.inf
    high_x = -np.inf
    high_y = -np.inf
    for k in range(standing):
        if bodies[k, RADIUS] > 0.0:
            low_x = min(low_x, bodies[k, X])
            high_x = max(high_x, bodies[k, X])
            low_y = min(low_y, bodies[k, Y])
            high_y = max(high_y, bodies[k, Y])
    cover(n, low_x, low_y, max(high_x - low_x, high_y - low_y, 1e-6), cells)
    first = cells.first[n]
    cell_of = cells.found
    frame = cells.frame[n]
    then = cells.then[0 if cells.ordered else n]
    first[:] = 0
    for k in range(bodies.shape[0]):
        if bodies[k, RADIUS] > 0.0:
            cell_of[k] = _cell(bodies[k], k < standing, frame)
            first[cell_of[k] + 1] += 1
    for cell in range(first.shape[0] - 1):
        first[cell + 1] += first[cell]
    end = first[first.shape[0] - 1]
    for k in range(bodies.shape[0] - 1, -1, -1):
        if bodies[k, RADIUS] > 0.0:
            first[cell_of[k] + 1] -= 1
            then[first[cell_of[k] + 1]] = k
    for cell in range(
        first.shape[0] - 1
    ):  # shift: each entry is the count of the cell before it
        first[cell] = first[cell + 1]
    first[first.shape[0] - 1] = end


@kernel(inline=True)
def _copy(body: Array, to: Array) -> None:
    for i in range(7):
        to[i] = body[i]


@kernel
def put_in_order(
    n: int, bodies: Array, standing: int, spare: Array, cells: BodyCells
) -> None:
    """Sort the first `standing` bodies (K, 7) themselves, absent ones last; no others may move.

    Neighbours then share cache lines, so few accesses miss the cache. `spare` (K, 7) is scratch.
    """
    sort(n, bodies[:standing], standing, cells)
    first = cells.first[n]
    end = cells.first.shape[1] - 1
    present = first[end]
    count = first[end]
    for k in range(standing):
        _copy(bodies[k], spare[k])
    for i in range(present):
        _copy(spare[cells.then[0, i]], bodies[i])
    for k in range(standing):
        if spare[k, RADIUS] <= 0.0:
            _copy(spare[k], bodies[count])
            count += 1
    first[end] = bodies.shape[0]  # the absent, and those that move, are always found


@kernel(inline=True)
def _window(
    n: int, x: float, y: float, reach: float, cells: BodyCells
) -> tuple[int, int, int, int]:
    """Return minimum and maximum row, then column, of the cells around a place."""
    frame = cells.frame[n]
    per_metre = cells.frame[n, PER_METRE]
    side = cells.frame[n, SIDE]
    far = reach + frame[LARGEST] + frame[MOVED]
    x = x - frame[LEFT]
    y = y - frame[BOTTOM]
    low = _place(y - far, per_metre, side)
    high = _place(y + far, per_metre, side)
    return low, high, _place(x - far, per_metre, side), _place(x + far, per_metre, side)


@kernel
def around(n: int, x: float, y: float, reach: float, cells: BodyCells) -> int:
    """Write the sorted bodies that may be within `reach` [m] to `cells.found`; return how many."""
    first = cells.first
    then = cells.then
    nearby = cells.found
    count = 0
    if first.shape[0] == 0:
        return nearby.shape[0]  # which lists all bodies
    low, high, left, right = _window(n, x, y, reach, cells)
    side = int(cells.frame[n, SIDE])
    for row in range(low, high + 1):
        for i in range(first[n, row * side + left], first[n, row * side + right + 1]):
            nearby[count] = i if cells.ordered else then[n, i]
            count = count + 1
    for i in range(first[n, side * side], first[n, side * side + 1]):
        nearby[count] = i if cells.ordered else then[n, i]
        count = count + 1
    return count


@kernel
def around_added(n: int, x: float, y: float, reach: float, cells: BodyCells) -> int:
    """Do the same as `around` for bodies that were added one by one."""
    first = cells.first
    then = cells.then
    nearby = cells.found
    count = 0
    if first.shape[0] == 0:
        return nearby.shape[0]
    low, high, left, right = _window(n, x, y, reach, cells)
    side = int(cells.frame[n, SIDE])
    for row in range(low, high + 2):
        begin = row * side + left
        end = row * side + right
        if row > high:  # the chain of bodies in no cell
            begin = side * side
            end = side * side
        for cell in range(begin, end + 1):
            k = first[n, cell]
            while k >= 0:
                nearby[count], k, count = k, then[n, k], count + 1
    return count
