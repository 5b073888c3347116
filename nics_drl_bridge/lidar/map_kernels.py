"""Compiled static maps: the ranges of one scan in a grid of solid squares.

`walk` goes from cell to cell in float64 (Amanatides and Woo, 1987). `jump` crosses free
squares: for each free cell and quadrant of directions, the bake stores the side of the
largest free square in that quadrant (an anisotropic chessboard distance; Sramek and
Kaufman, 2000). A beam can leave it only through its two far sides, which are grid
lines, so no range is blended or rounded to a cell. `jump` works in float32 relative to
the lidar's cell: the relative error of a range is at most 3e-7, and a beam within 1e-6
cells of a corner may pass on the other side.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import (
    Array,
    Integers,
    Mask,
    ShortIntegers,
    Singles,
)
from nics_drl_bridge.lidar.beam_kernels import Beams, LidarPose, lower

LANES = 48  # beams that jump together; several vector registers hide the latency of look-ups
SINGLES = 7
INTEGERS = 6
DU, DV, PER_U, PER_V, U, V, T = (np.uintp(k * LANES) for k in range(SINGLES))
COLUMN, ROW, ASIDE, ABOVE, QUADRANT, SIDE = (
    np.uintp(k * LANES) for k in range(INTEGERS)
)
"""Offsets of the quantities of a lane: direction, its inverses, place in the lidar's cell and
distance [cells]; column and row relative to the lidar, index increments of one column and one row,
the quadrant's bit shift, and the side of the free square."""
LONGEST = 255  # side of the largest square that fits in a byte [cells]
PARALLEL = np.float32(
    1e-12
)  # minimum component of a direction: its inverse stays finite
# a return at exactly range_max must not be lost to rounding; `scan_robot` decides
SLACK = 1.0 + 1e-6


class GridArrays(NamedTuple):
    """A static map for the kernels; empty if there is none."""

    # (rows + 2, columns + 2), a byte per quadrant: 0 in solid cells and the border around the map
    squares: NDArray[np.uint32]
    # (5,) x, y [m], cosine, sine of its origin, resolution [m]
    frame: Array


class Fixtures(NamedTuple):
    """Walls and maps of P worlds, stored one after the other, for N simulated copies."""

    member: Integers  # (N,) world of each copy
    walls: Array  # (W, 4) x1, y1, x2, y2 of all worlds [m]
    first: Integers  # (P + 1,) first wall of each world
    squares: NDArray[np.uint32]  # of all maps, see `GridArrays`
    maps: Integers  # (P, 3) first square, rows and columns of each map
    frames: Array  # (P, 5) of each map


@kernel(view=True)
def walls_of(n: int, fixtures: Fixtures) -> Array:
    """Walls (W, 4) of one copy."""
    p = fixtures.member[n]
    return fixtures.walls[fixtures.first[p] : fixtures.first[p + 1]]


@kernel(view=True)
def grid_of(n: int, fixtures: Fixtures) -> GridArrays:
    """Map of one copy, without squares if there is none."""
    p = fixtures.member[n]
    return GridArrays(cells_of(fixtures.squares, fixtures.maps[p]), fixtures.frames[p])


@kernel(view=True)
def cells_of(cells: NDArray[np.uint32], place: Integers) -> NDArray[np.uint32]:
    """Cells (rows, columns) of one map among those of many: first cell, rows, columns."""
    first = place[0]
    rows = place[1]
    columns = place[2]
    return cells[first : first + rows * columns].reshape((rows, columns))


@kernel(allocates=True)
def find_free_squares(blocked: Mask) -> NDArray[np.uint32]:
    """Bake the squares (rows + 2, columns + 2) of a map (rows, columns), see `GridArrays`."""
    rows, columns = blocked.shape
    side = np.zeros((rows + 2, columns + 2), np.int32)
    squares = np.zeros((rows + 2, columns + 2), np.uint32)
    for quadrant in range(4):
        right = 1 - 2 * (quadrant & 1)
        up = 1 - (quadrant & 2)
        side[:] = 0
        for i in range(rows):
            row = rows - i if up > 0 else i + 1
            for j in range(columns):
                column = columns - j if right > 0 else j + 1
                if not blocked[row - 1, column - 1]:
                    least = min(
                        side[row + up, column],
                        side[row, column + right],
                        side[row + up, column + right],
                    )
                    side[row, column] = min(least + 1, LONGEST)
                    squares[row, column] |= np.uint32(side[row, column]) << np.uint32(
                        8 * quadrant
                    )
    return squares


@kernel
def _find_line(at: float, step: float, cell: int) -> float:
    if step == 0.0:
        return np.inf
    return (cell + (1 if step > 0.0 else 0) - at) / step


@kernel
def _find_entry(at: float, step: float, size: int) -> tuple[float, float]:
    """Distances along a beam at which it enters and leaves [0, size] on one axis [cells]."""
    if step == 0.0:
        if 0.0 <= at < size:
            return -np.inf, np.inf
        return np.inf, -np.inf
    to_start = -at / step
    to_end = (size - at) / step
    return min(to_start, to_end), max(to_start, to_end)


@kernel
def walk(
    squares: NDArray[np.uint32], u: float, v: float, du: float, dv: float, limit: float
) -> float:
    """Exact distance [cells] from (u, v) to the border of solid cells, `inf` beyond `limit`.

    This is where the beam enters a solid cell, or leaves it if it starts inside. The
    outside is free.
    """
    rows = len(squares) - 2
    columns = squares.shape[1] - 2
    x = math.floor(u)
    y = math.floor(v)
    t = 0.0
    solid = False
    if 0 <= x < columns and 0 <= y < rows:
        solid = squares[y + 1, x + 1] == 0
    else:
        x_in, x_out = _find_entry(u, du, columns)
        y_in, y_out = _find_entry(v, dv, rows)
        t = max(x_in, y_in)
        if t < 0.0 or t > min(x_out, y_out) or t > limit:
            return np.inf
        x = min(max(math.floor(u + du * t), 0), columns - 1)
        y = min(max(math.floor(v + dv * t), 0), rows - 1)
        if squares[y + 1, x + 1] == 0:
            return t
    x_line = _find_line(u, du, x)
    y_line = _find_line(v, dv, y)
    while True:
        if x_line < y_line:
            t = x_line
            x += 1 if du > 0.0 else -1
            x_line = _find_line(u, du, x)
        else:
            t = y_line
            y += 1 if dv > 0.0 else -1
            y_line = _find_line(v, dv, y)
        if t > limit:
            return np.inf
        if not (0 <= x < columns and 0 <= y < rows):
            return t if solid else np.inf
        if (squares[y + 1, x + 1] == 0) != solid:
            return t


@kernel
def scan_map(
    scan: ShortIntegers,
    beams: Beams,
    lidar: LidarPose,
    range_max: float,
    grid: GridArrays,
    exact: bool,
    singles: Singles,
    integers: ShortIntegers,
) -> None:
    """Fuse a map into a scan (B + LANES,), see `beam_kernels`: walks if `exact`, else jumps.

    `singles` (SINGLES * LANES,) and `integers` (INTEGERS * LANES,) are scratch memory.
    """
    squares = grid.squares
    frame = grid.frame
    if squares.size == 0:
        return
    dx = lidar.x - frame[0]
    dy = lidar.y - frame[1]
    cell = frame[4]
    u = (frame[2] * dx + frame[3] * dy) / cell
    v = (frame[2] * dy - frame[3] * dx) / cell
    c = lidar.c * frame[2] + lidar.s * frame[3]
    s = lidar.s * frame[2] - lidar.c * frame[3]
    x = math.floor(u)
    y = math.floor(v)
    count = beams.directions.shape[1]
    limit = range_max / cell * SLACK
    inside = 0.0 <= x < squares.shape[1] - 2 and 0.0 <= y < squares.shape[0] - 2
    if exact or not inside or squares[int(y) + 1, int(x) + 1] == 0:
        for i in range(count):
            ahead = beams.directions[0, i]
            left = beams.directions[1, i]
            du = c * ahead - s * left
            dv = s * ahead + c * left
            steps = walk(squares, u, v, du, dv, limit)
            lower(scan, i, cell * steps)
        return
    columns = squares.shape[1]
    start = (int(y) + 1) * columns + int(x) + 1
    cosine = np.float32(c)
    sine = np.float32(s)
    beyond_u = np.float32(u - x)
    beyond_v = np.float32(v - y)
    most = np.float32(limit)
    unit = np.float32(1.0)
    zero = np.float32(0.0)
    for first in range(0, count, LANES):
        # Put the beams into lanes, each mirrored so that it points right and up.
        for j in range(LANES):
            k = np.uintp(j)
            # idle lanes repeat the last beam
            beam = np.uintp(min(first + j, count - 1))
            ahead = np.float32(beams.directions[0, beam])
            left = np.float32(beams.directions[1, beam])
            du = cosine * ahead - sine * left
            dv = sine * ahead + cosine * left
            right = du > zero
            up = dv > zero
            du = max(abs(du), PARALLEL)
            dv = max(abs(dv), PARALLEL)
            singles[k + DU] = du
            singles[k + DV] = dv
            singles[k + PER_U] = unit / du
            singles[k + PER_V] = unit / dv
            singles[k + U] = beyond_u if right else unit - beyond_u
            singles[k + V] = beyond_v if up else unit - beyond_v
            singles[k + T] = zero
            integers[k + COLUMN] = 0
            integers[k + ROW] = 0
            integers[k + ASIDE] = 1 if right else -1
            integers[k + ABOVE] = columns if up else -columns
            integers[k + QUADRANT] = (0 if right else 8) + (0 if up else 16)
        while _jump(squares.reshape(-1), start, most, singles, integers):
            pass
        # Fuse the lanes that ended at a solid cell, not in the border around the map.
        for j in range(LANES):
            k = np.uintp(j)
            column = int(x) + integers[k + COLUMN] * integers[k + ASIDE]
            above = integers[k + ROW] if integers[k + ABOVE] > 0 else -integers[k + ROW]
            row = int(y) + above
            hit = (column >= 0) & (column < columns - 2)
            hit &= (row >= 0) & (row < len(squares) - 2)
            hit &= singles[k + T] < most
            distance = np.float32(cell) * singles[k + T]
            lower(scan, first + j, distance if hit else np.float32(np.inf))


@kernel
def _jump(
    flat: NDArray[np.uint32],
    start: int,
    limit: np.float32,
    singles: Singles,
    integers: ShortIntegers,
) -> np.bool_:
    """Move each lane to the end of its free square; True if any moved."""
    # separate from the loop below, so that LLVM can vectorise that loop
    for j in range(LANES):
        k = np.uintp(j)
        cell = (
            start
            + integers[k + COLUMN] * integers[k + ASIDE]
            + integers[k + ROW] * integers[k + ABOVE]
        )
        square = flat[np.uintp(cell)] >> np.uint32(integers[k + QUADRANT])
        integers[k + SIDE] = np.int32(square) & np.int32(LONGEST)
    moved = np.int32(0)
    for j in range(LANES):
        k = np.uintp(j)
        x = integers[k + COLUMN]
        y = integers[k + ROW]
        side = integers[k + SIDE]
        t = singles[k + T]
        x_side = np.int32(x + side)
        y_side = np.int32(y + side)
        x_line = (np.float32(x_side) - singles[k + U]) * singles[k + PER_U]
        y_line = (np.float32(y_side) - singles[k + V]) * singles[k + PER_V]
        sideways = x_line < y_line
        ahead = x_line if sideways else y_line
        # Never cross a line backwards: rounding might move a lane back and forth
        # forever.
        x_new = max(np.int32(singles[k + U] + singles[k + DU] * ahead), x)
        y_new = max(np.int32(singles[k + V] + singles[k + DV] * ahead), y)
        goes = (side > np.int32(0)) & (t < limit)
        column = x_side if sideways else x_new
        row = y_new if sideways else y_side
        integers[k + COLUMN] = column if goes else x
        integers[k + ROW] = row if goes else y
        singles[k + T] = ahead if goes else t
        moved |= np.int32(goes)
    return moved > 0
