"""Compiled path lengths from robots to their goals, around static obstacles.

They are arrival times of a front that starts at the goal (eikonal equation), computed
on square cells by fast sweeping (Zhao 2005). The front is slower near obstacles, so
wide paths count as shorter than narrow ones. Inside obstacles it is slow but does not
stop, so every place has a path.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers, Mask, Singles
from nics_drl_bridge.lidar.exact_kernels import COS, RADIUS, SIN, OutlineArrays, X, Y
from nics_drl_bridge.sim import collision_kernels as collision
from nics_drl_bridge.sim import scene_kernels
from nics_drl_bridge.sim.state import MapField

# clearance around the robot's circle above which a path is wide [m]
COMFORT = 0.3
# Cost of a metre; between these clearances it is interpolated.
TIGHT = 2.0  # where the robot's circle just fits
SQUEEZED = 6.0  # where only its outline fits
BLOCKED = 12.0  # where neither fits
ROUNDS = 20  # maximum number of sweeps in all four directions
SETTLED = np.float32(1e-3)  # change that ends the sweeps earlier [m]


class GuideGrid(NamedTuple):
    """Cells over the P worlds of a set, and the static parts of every scene."""

    walls: Singles  # (P, rows, columns) distance to walls and map [m]
    frames: Array  # (P, 3) minimum x, y and the cells' side [m]
    sizes: Integers  # (P, 2) rows and columns that a world has
    stands: Mask  # (P, K) obstacles that do not move
    outlines: OutlineArrays  # of the obstacles' shapes
    inner: float  # radii of the robot's inscribed and circumscribed circles [m]
    outer: float


@kernel
def sample_walls(out: Singles, extent: Array, cell: float, cells: MapField) -> None:
    """Write the distances of `cells` to walls and map for coarser cells (rows, columns).

    Everything outside the field `extent` (4,) is solid.
    """
    for i in range(len(out)):
        for j in range(out.shape[1]):
            x = extent[0] + (j + 0.5) * cell
            y = extent[1] + (i + 0.5) * cell
            row, column, _ = scene_kernels.cell_of(x, y, cells)
            inside = (
                0 <= row < cells.distances.shape[0]
                and 0 <= column < cells.distances.shape[1]
            )
            out[i, j] = cells.distances[row, column] if inside else np.float32(0.0)


@kernel(allocates=True)
def find_ways(
    out: Singles,
    worlds: Integers,
    member: Integers,
    bodies: Array,
    goals: Array,
    grid: GuideGrid,
) -> None:
    """Write path lengths [m] from each cell to out[world, m] (rows, columns) float32.

    For the worlds (n,): member (n,), bodies (n, K, 7), goals (n, M, 2).
    """
    gaps = np.empty(grid.walls.shape[1:], np.float32)
    for n in range(len(worlds)):
        p = member[n]
        height = grid.sizes[p, 0]
        width = grid.sizes[p, 1]
        space = gaps[:height, :width]
        space[...] = grid.walls[p, :height, :width]
        frame = grid.frames[p]
        for k in range(bodies.shape[1]):
            if grid.stands[p, k] and bodies[n, k, RADIUS] > 0.0:
                _lower_space(space, bodies[n, k], frame, grid)
        for i in range(height):
            for j in range(width):
                space[i, j] = np.float32(frame[2] * _find_cost(space[i, j], grid))
        for m in range(goals.shape[1]):
            field = out[worlds[n], m, :height, :width]
            _spread(field, space, goals[n, m], frame)


@kernel
def _locate(place: Array, frame: Array) -> tuple[float, float]:
    """Return column and row of a place x, y, as fractions."""
    u = (place[0] - frame[0]) / frame[2] - 0.5
    return u, (place[1] - frame[1]) / frame[2] - 0.5


@kernel
def _lower_space(
    space: Singles,
    body: Array,
    frame: Array,
    grid: GuideGrid,
) -> None:
    """Lower the clearance (rows, columns) of cells to the distance from a body [m]."""
    rows, columns = space.shape
    cell = frame[2]
    x = body[X] - frame[0]
    y = body[Y] - frame[1]
    far = body[RADIUS] + grid.outer + COMFORT
    first_row, end_row = _find_cells(y, far, cell, rows)
    first_column, end_column = _find_cells(x, far, cell, columns)
    for i in range(first_row, end_row):
        dy = (i + 0.5) * cell - y
        for j in range(first_column, end_column):
            dx = (j + 0.5) * cell - x
            gap = np.float32(_measure_gap(dx, dy, body, grid.outlines))
            space[i, j] = min(space[i, j], gap)


@kernel
def _find_cells(middle: float, far: float, cell: float, count: int) -> tuple[int, int]:
    """Return the first of `count` cells within `far` of `middle` [m], and the end of them."""
    first = max(int((middle - far) / cell), 0)
    end = min(int((middle + far) / cell) + 1, count)
    return first, end


@kernel
def _measure_gap(dx: float, dy: float, body: Array, outlines: OutlineArrays) -> float:
    """Distance from a body, negative inside, at a displacement from its origin [m]."""
    outline = collision.outline_of(body, outlines)
    if outline.begin == outline.end:
        return math.sqrt(dx * dx + dy * dy) - body[RADIUS]
    along = body[COS] * dx + body[SIN] * dy
    across = body[COS] * dy - body[SIN] * dx
    return collision.outline_point(along, across, outline)


@kernel
def _find_cost(space: float, grid: GuideGrid) -> float:
    """Cost of a metre at a place, given the clearance there [m]."""
    beside = space - grid.outer
    if beside >= COMFORT:
        return 1.0
    if beside >= 0.0:
        return TIGHT + (1.0 - TIGHT) * beside / COMFORT
    if space > grid.inner:
        more = space - grid.inner
        return SQUEEZED + (TIGHT - SQUEEZED) * more / (grid.outer - grid.inner)
    return BLOCKED


@kernel
def _spread(field: Singles, cost: Singles, start: Array, frame: Array) -> None:
    """Write the arrival times of a front that starts at x, y and takes `cost` per cell."""
    u, v = _locate(start, frame)
    rows, columns = field.shape
    field[...] = np.inf
    gi = min(max(round(v), 0), rows - 1)
    gj = min(max(round(u), 0), columns - 1)
    for i in range(max(gi - 1, 0), min(gi + 2, rows)):
        for j in range(max(gj - 1, 0), min(gj + 2, columns)):
            steps = math.sqrt((u - j) ** 2 + (v - i) ** 2)
            field[i, j] = steps * cost[i, j]
    for _ in range(ROUNDS):
        change = np.float32(0.0)
        for way in range(4):
            change = max(change, update_ways(field, cost, way >= 2, way % 2 == 1))
        if change <= SETTLED:
            return


@kernel
def update_ways(ways: Singles, prices: Singles, down: bool, left: bool) -> np.float32:
    """Update the path lengths row by row from one corner; return the maximum change [m].

    Both (rows, columns) are float32; the price of a cell is the cost of crossing it.
    """
    rows, columns = ways.shape
    most = np.float32(0.0)
    for a in range(rows):
        i = rows - 1 - a if down else a
        for b in range(columns):
            j = columns - 1 - b if left else b
            left_way = ways[i, max(j - 1, 0)]
            right_way = ways[i, min(j + 1, columns - 1)]
            lower_way = ways[max(i - 1, 0), j]
            upper_way = ways[min(i + 1, rows - 1), j]
            beside = min(left_way, right_way)
            above = min(lower_way, upper_way)
            if not min(beside, above) < ways[i, j]:
                continue
            way = _cross_cell(beside, above, prices[i, j])
            if way < ways[i, j]:
                most = max(most, min(ways[i, j] - way, np.float32(1e3)))
                ways[i, j] = way
    return most


@kernel(inline=True)
def _cross_cell(beside: np.float32, above: np.float32, price: np.float32) -> np.float32:
    """Return when the front reaches a cell, from when it reached its neighbours."""
    apart = beside - above
    if abs(apart) < price:  # it comes obliquely
        square = np.float32(2.0) * price * price - apart * apart
        return np.float32(0.5) * (beside + above + math.sqrt(square))
    return min(beside, above) + price


@kernel
def measure_lengths(
    out: Array,
    poses: Array,
    member: Integers,
    fields: Singles,
    grid: GuideGrid,
) -> None:
    """Write the path lengths (N, M) [m] from poses (N, M, 3), interpolated linearly."""
    for n in range(len(out)):
        p = member[n]
        for m in range(out.shape[1]):
            u, v = _locate(poses[n, m], grid.frames[p])
            u = min(max(u, 0.0), grid.sizes[p, 1] - 1.000001)
            v = min(max(v, 0.0), grid.sizes[p, 0] - 1.000001)
            out[n, m] = _interpolate(fields[n, m], u, v)


@kernel
def _interpolate(field: Singles, u: float, v: float) -> float:
    """Return the value at column u and row v (fractions), between the cells around it."""
    i = int(v)
    j = int(u)
    s = v - i
    t = u - j
    below = (1.0 - t) * field[i, j] + t * field[i, j + 1]
    above = (1.0 - t) * field[i + 1, j] + t * field[i + 1, j + 1]
    return (1.0 - s) * below + s * above
