"""Compiled inner loops of static maps: the ranges of one scan in a grid of solid squares.

Both methods below find the same ranges. `ray` walks from cell to cell in float64 (Amanatides and
Woo, 1987). `map_into` jumps over free squares: for each free cell and each of the four quadrants
of directions, the bake stores the side of the largest free square that begins at the cell and
opens towards the quadrant (an anisotropic chessboard distance; Sramek and Kaufman, 2000). A beam
within its quadrant can only leave the square through its two far sides, which lie on grid lines.
So a jump ends where a walk would, and no range is blended or rounded to a cell.

`map_into` moves `LANES` beams at once in float32 and relative to the cell of the lidar: the
relative error of a range is at most 3e-7. A beam that passes the corner of a cell within 1e-6 of a
cell may pass on its other side.

`map_arrays`, of `maps_grid.GridMap.arrays`: squares (rows + 2, columns + 2) uint32, one byte per
quadrant, 0 in cells that stop a beam and in the border of one cell around the map; frame (5,):
x, y [m], cosine and sine of the origin in the world, resolution [m].

Reads and writes that declare to LLVM that lanes never overlap the map.

The map is any array that is only read: a grid map, or a lidar table. With plain indexing, LLVM must
assume that writing to a lane may change the map that another lane is about to read, and does not
vectorise the loops over lanes in `map_kernels` and `baked_kernels`. The instructions carry scoped
alias metadata: reads of the map belong to one scope, and accesses to lanes declare that they are
not in it. All indices must be within the array and not negative.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from nics_drl_bridge.kernels import kernel

LANES = 48
"""Beams that move together: several vector registers wide, to hide the latency of the look-ups."""
LONGEST = 255
"""Side of the largest square that fits in a byte [cells]."""
FLOATS, INTS = 7, 6
PARALLEL = np.float32(1e-12)
"""Least component of a direction: its inverse stays finite."""
SLACK = 1.0 + 1e-6
"""A return at exactly range_max must not be lost to rounding; `finish` decides."""


@kernel(allocates=True)
def free_squares(blocked):  # type: ignore[no-untyped-def]
    """Bakes the squares (rows + 2, columns + 2) of a map (rows, columns), see the module."""
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
                    beyond = min(side[row + up, column], side[row, column + right])
                    least = min(beyond, side[row + up, column + right]) + 1
                    side[row, column] = min(least, LONGEST)
                    squares[row, column] |= np.uint32(side[row, column]) << np.uint32(8 * quadrant)
    return squares


@kernel(allocates=True)
def _line(at, step, cell):  # type: ignore[no-untyped-def]
    """Distance along a beam to where it leaves `cell` along one axis [cells]."""
    if step == 0.0:
        return np.inf
    return (cell + (1 if step > 0.0 else 0) - at) / step


@kernel(allocates=True)
def _entry(at, step, size):  # type: ignore[no-untyped-def]
    """Distances along a beam to where it enters and leaves [0, size] along one axis [cells]."""
    if step == 0.0:
        return (-np.inf, np.inf) if 0.0 <= at < size else (np.inf, -np.inf)
    one, other = -at / step, (size - at) / step
    return min(one, other), max(one, other)


@kernel(allocates=True)
def ray(squares, u, v, du, dv, limit):  # type: ignore[no-untyped-def]
    """Exact distance [cells] from (u, v) to the boundary of the solid cells, `inf` beyond `limit`.

    From a free place this is where the beam enters a solid cell, from within a solid cell where it
    leaves it. Everything outside the map is free.
    """
    rows, columns = squares.shape[0] - 2, squares.shape[1] - 2
    x, y, t = math.floor(u), math.floor(v), 0.0
    solid = False
    if 0 <= x < columns and 0 <= y < rows:
        solid = squares[y + 1, x + 1] == 0
    else:
        x_in, x_out = _entry(u, du, columns)
        y_in, y_out = _entry(v, dv, rows)
        t = max(x_in, y_in)
        if t < 0.0 or t > min(x_out, y_out) or t > limit:
            return np.inf
        x = min(max(math.floor(u + du * t), 0), columns - 1)
        y = min(max(math.floor(v + dv * t), 0), rows - 1)
        if squares[y + 1, x + 1] == 0:
            return t
    x_line, y_line = _line(u, du, x), _line(v, dv, y)
    while True:
        if x_line < y_line:
            t, x = x_line, x + (1 if du > 0.0 else -1)
            x_line = _line(u, du, x)
        else:
            t, y = y_line, y + (1 if dv > 0.0 else -1)
            y_line = _line(v, dv, y)
        if t > limit:
            return np.inf
        if not (0 <= x < columns and 0 <= y < rows):
            return t if solid else np.inf
        if (squares[y + 1, x + 1] == 0) != solid:
            return t


@kernel(allocates=True)
def to_grid(sx, sy, c, s, frame):  # type: ignore[no-untyped-def]
    """Returns position [cells] and cosine, sine of the lidar in the grid."""
    dx, dy = sx - frame[0], sy - frame[1]
    u = (frame[2] * dx + frame[3] * dy) / frame[4]
    v = (frame[2] * dy - frame[3] * dx) / frame[4]
    return u, v, c * frame[2] + s * frame[3], s * frame[2] - c * frame[3]


@kernel(allocates=True)
def exact_map_into(out, directions, beams, sx, sy, c, s, range_max, map_arrays, room):  # type: ignore[no-untyped-def]
    """Fuses a map into a scan (B,) from (sx, sy, c, s), cell by cell in float64; see `ray`."""
    squares, frame = map_arrays
    if squares.size == 0:
        return
    u, v, c, s = to_grid(sx, sy, c, s, frame)
    limit = range_max / frame[4] * SLACK
    for i in range(out.shape[0]):
        du = c * directions[i, 0] - s * directions[i, 1]
        dv = s * directions[i, 0] + c * directions[i, 1]
        value = frame[4] * ray(squares, u, v, du, dv, limit)
        if value < out[i]:
            out[i] = value


@kernel
def map_into(out, directions, beams, sx, sy, c, s, range_max, map_arrays, room):  # type: ignore[no-untyped-def]
    """Fuses a map into a scan (B,) float32 from (sx, sy, c, s), by jumps; see the module.

    Args:
        out: (B,) ranges [m]; each becomes the lesser of itself and the range to the map.
        directions: (B, 2) cosine and sine of each beam, in the frame of the lidar.
        beams: see `kernels`; unused, for a uniform signature.
        sx, sy: position of the lidar in the world [m].
        c, s: cosine and sine of its heading.
        range_max: end of the search [m].
        map_arrays: see the module; arrays of size 0 are no map.
        room: see `scanner.Scanner.room`.
    """
    squares, frame = map_arrays
    if squares.size == 0:
        return
    u, v, gc, gs = to_grid(sx, sy, c, s, frame)
    rows, columns = squares.shape
    x, y = math.floor(u), math.floor(v)
    inside = 0.0 <= x < columns - 2 and 0.0 <= y < rows - 2
    if not inside or squares[int(y) + 1, int(x) + 1] == 0:
        exact_map_into(out, directions, beams, sx, sy, c, s, range_max, map_arrays, room)
        return
    flat = squares.reshape(-1)
    here = (int(y) + 1) * columns + int(x) + 1
    limit = np.float32(range_max / frame[4] * SLACK)
    _, floats, ints = room
    for first in range(0, out.shape[0], LANES):
        last = min(first + LANES, out.shape[0])
        _start(floats, ints, directions[first:last], u - x, v - y, gc, gs, columns)
        while _jump(floats, ints, flat, here, limit):
            pass
        _finish(out[first:last], floats, ints, x, y, columns - 2, rows - 2, limit, frame[4])


@kernel(allocates=True)
def _start(floats, ints, directions, u, v, c, s, columns):  # type: ignore[no-untyped-def]
    """Puts beams into the lanes, each mirrored so that it points right and up.

    `floats` has LANES places for each of: direction x, y, its inverses, position in the cell of the
    lidar x, y, and distance [cells]. `ints`: column and row relative to the lidar, index increments
    of one column and one row, the quadrant's bit shift, and 1 while the lane is moving.
    """
    c, s, u, v = np.float32(c), np.float32(s), np.float32(u), np.float32(v)
    one, none = np.float32(1.0), np.float32(0.0)
    columns = np.int32(columns)
    count = directions.shape[0]
    for k in range(count):
        a, b = np.float32(directions[k, 0]), np.float32(directions[k, 1])
        du, dv = c * a - s * b, s * a + c * b
        right, up = du > none, dv > none
        du, dv = max(abs(du), PARALLEL), max(abs(dv), PARALLEL)
        floats[k] = du
        floats[LANES + k] = dv
        floats[2 * LANES + k] = one / du
        floats[3 * LANES + k] = one / dv
        floats[4 * LANES + k] = u if right else one - u
        floats[5 * LANES + k] = v if up else one - v
        floats[6 * LANES + k] = none
        ints[k] = 0
        ints[LANES + k] = 0
        ints[2 * LANES + k] = np.int32(1) if right else np.int32(-1)
        ints[3 * LANES + k] = columns if up else -columns
        ints[4 * LANES + k] = (np.int32(0) if right else np.int32(8)) + (
            np.int32(0) if up else np.int32(16)
        )
    for k in range(count, LANES):  # lanes without a beam repeat the last one
        for n in range(FLOATS):
            floats[n * LANES + k] = floats[n * LANES + count - 1]
        for n in range(INTS):
            ints[n * LANES + k] = ints[n * LANES + count - 1]


@kernel(allocates=True)
def _jump(floats, ints, flat, here, limit):  # type: ignore[no-untyped-def]
    """Moves each lane to the end of its free square; True if any moved."""
    here = np.int32(here)
    for k in range(LANES):
        x, y = get(ints, k), get(ints, LANES + k)
        cell = here + x * get(ints, 2 * LANES + k) + y * get(ints, 3 * LANES + k)
        bits = np.int32(peek(flat, cell) >> np.uint32(get(ints, 4 * LANES + k)))
        side = bits & np.int32(LONGEST)
        u, v, t = (
            get(floats, 4 * LANES + k),
            get(floats, 5 * LANES + k),
            get(floats, 6 * LANES + k),
        )
        x_side, y_side = x + side, y + side
        x_line = (np.float32(x_side) - u) * get(floats, 2 * LANES + k)
        y_line = (np.float32(y_side) - v) * get(floats, 3 * LANES + k)
        sideways = x_line < y_line
        ahead = x_line if sideways else y_line
        # Never back across a line: rounding might move a lane back and forth forever.
        x_new = max(np.int32(u + get(floats, k) * ahead), x)
        y_new = max(np.int32(v + get(floats, LANES + k) * ahead), y)
        goes = (side > np.int32(0)) & (t < limit)
        put(ints, k, (x_side if sideways else x_new) if goes else x)
        put(ints, LANES + k, (y_new if sideways else y_side) if goes else y)
        put(floats, 6 * LANES + k, ahead if goes else t)
        put(ints, 5 * LANES + k, np.int32(goes))
    moved = np.int32(0)
    for k in range(LANES):
        moved += get(ints, 5 * LANES + k)
    return moved > 0


@kernel(allocates=True)
def _finish(out, floats, ints, x, y, columns, rows, limit, resolution):  # type: ignore[no-untyped-def]
    """Fuses the lanes that ended at a solid cell, not in the border around the map."""
    x, y, columns, rows = np.int32(x), np.int32(y), np.int32(columns), np.int32(rows)
    resolution = np.float32(resolution)
    for k in range(out.shape[0]):
        column = x + ints[k] * ints[2 * LANES + k]
        row = y + (ints[LANES + k] if ints[3 * LANES + k] > 0 else -ints[LANES + k])
        hit = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        t = floats[6 * LANES + k]
        value = resolution * t if hit & (t < limit) else np.float32(np.inf)
        out[k] = min(out[k], value)


def _scope(builder: Any) -> Any:
    """Returns the alias scope of the map, as metadata of the module being compiled."""
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "nics.map.domain")])
    scope = module.add_metadata([ir.MetaDataString(module, "nics.map"), domain])
    return module.add_metadata([scope])


def _address(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.gep(array.data, [args[1]])


def _load(belonging: str) -> Callable[..., Any]:
    """Returns a function that generates a read; `belonging` is its relation to the map's scope."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_address(context, builder, signature, args))
        value.set_metadata(belonging, _scope(builder))
        return value

    return generate


@intrinsic
def peek(typing, array, index):  # type: ignore[no-untyped-def]
    """Reads array[index] of the map (C-contiguous, 1-d), which is not written meanwhile."""
    return array.dtype(array, types.int64), _load("alias.scope")


@intrinsic
def get(typing, array, index):  # type: ignore[no-untyped-def]
    """Reads array[index] of lanes (C-contiguous, 1-d), which do not overlap the map."""
    return array.dtype(array, types.int64), _load("noalias")


@intrinsic
def put(typing, array, index, value):  # type: ignore[no-untyped-def]
    """Sets array[index] = value in lanes (C-contiguous, 1-d), which do not overlap the map."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        store = builder.store(args[2], _address(context, builder, signature, args))
        store.set_metadata("noalias", _scope(builder))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), generate
