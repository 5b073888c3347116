"""Compiled map of what one scan shows: distances to it, and the way left to the goal around it.

A planner makes it anew at each step, in `base_link`, and forgets it. What was not seen counts as
free. Shapes: P parts of a scan, G cells along a side of the map, D discs of an outline.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.guide_kernels import sweep

Grid = NDArray[np.float32]
ARRIVED_M = 0.15  # at which a robot is at its goal: nothing behind it matters
APART_M = 0.02  # hits nearer to the one before are left out
COARSE = 2  # cells of distances along a side of a cell of ways
BLOCKED, NEAR = 30.0, 3.0
"""Price of a metre where the robot can't stand, and of one beside that, less the usual 1."""
AHEAD_M = 0.3  # at which a heading is judged
ROUNDS, SETTLED_M = 6, 0.02
"""Greatest number of rounds of sweeps, and change of a way by which one may be the last [m]."""


class ScanRays(NamedTuple):
    """Rays of a scan in `base_link`; a share of 1 stands for `range_max`."""

    directions: Array  # (P, 2) unit vectors
    origin: Array  # (2,) [m]
    range_max: float  # [m]


class FootprintDiscs(NamedTuple):
    """Footprint of a robot in `base_link`, as discs within it that leave hardly anything out."""

    discs: Array  # (D, 3) x, y, radius [m]
    centre: Array  # (2,) of a circle around [m]
    inner: float  # radius of the greatest disc [m]
    outer: float  # of the circle around [m]


class LocalMap(NamedTuple):
    """Square map around `base_link`, its first index along y."""

    distances: Grid  # (G, G) to the nearest hit, at most `reach` [m]
    ways: Grid  # (G / COARSE, G / COARSE) to the goal, at a price near obstacles [m]
    cell: float  # side of a cell of `distances` [m]
    reach: float  # [m]


class Clearance(NamedTuple):
    """Distances to be kept between an outline and all hits."""

    margin: float  # below which it counts as a touch [m]
    soft: float  # beyond that, within which it costs [m]


class MapScratch(NamedTuple):
    """Memory of a map in the making."""

    hits: Array  # (P, 2) [m]
    map: LocalMap
    prices: Grid  # as `ways`


class Situation(NamedTuple):
    """The map, the goal, and the robot that is to keep clear."""

    map: LocalMap
    goal: Array  # (2,) [m]
    outline: FootprintDiscs
    clearance: Clearance


@kernel(allocates=True)
def look(shares, goal, rays, outline, clearance, scratch):  # type: ignore[no-untyped-def]
    """Maps a scan of range shares (P,) around a robot whose goal (2,) is in `base_link` [m]."""
    count = hits_of(scratch.hits, shares, rays)
    put_distances(scratch.map, scratch.hits[:count])
    around = Situation(scratch.map, goal, outline, clearance)
    put_ways(around, scratch.prices)
    return around


@kernel
def hits_of(hits, shares, rays):  # type: ignore[no-untyped-def]
    """Writes a scan's end points, by range shares (P,), into hits (P, 2) [m]; returns the count.

    Shares of 0 are left out: they are unknown, or too near to tell from the robot itself.
    """
    count = 0
    for p in range(shares.shape[0]):
        if 0.0 < shares[p] < 1.0:
            share = shares[p] * rays.range_max
            x = rays.origin[0] + share * rays.directions[p, 0]
            y = rays.origin[1] + share * rays.directions[p, 1]
            if count > 0:
                dx = x - hits[count - 1, 0]
                dy = y - hits[count - 1, 1]
                if dx * dx + dy * dy < APART_M * APART_M:
                    continue
            hits[count, 0] = x
            hits[count, 1] = y
            count += 1
    return count


@kernel
def put_distances(seen, hits):  # type: ignore[no-untyped-def]
    """Writes the distances of a map to hits (H, 2)."""
    grid = seen.distances
    cell = seen.cell
    size = grid.shape[0]
    half = 0.5 * size * cell
    far = np.float32(seen.reach * seen.reach)
    grid[:] = far
    step = np.float32(cell)
    for h in range(hits.shape[0]):
        x = hits[h, 0] + half
        y = hits[h, 1] + half
        left, right = _span(x, seen.reach, cell, size)
        low, high = _span(y, seen.reach, cell, size)
        first = np.float32((left + 0.5) * cell - x)
        for i in range(low, high):
            dy = np.float32((i + 0.5) * cell - y)
            row = grid[i, left:right]
            dy2 = dy * dy
            for j in range(row.shape[0]):
                dx = np.float32(j) * step + first
                away = dx * dx + dy2
                row[j] = away if away < row[j] else row[j]
    for i in range(size):
        row = grid[i]
        for j in range(size):
            row[j] = math.sqrt(row[j])


@kernel
def _span(middle, reach, cell, size):  # type: ignore[no-untyped-def]
    """Returns the first and the last but one of the cells within `reach` of a place [m]."""
    low = min(max(int((middle - reach) / cell), 0), size)
    return low, max(min(int((middle + reach) / cell) + 1, size), low)


@kernel
def value_at(grid, cell, x, y, outside):  # type: ignore[no-untyped-def]
    """Returns a value of a grid at a point, bilinear between the centres of cells."""
    size = grid.shape[0]
    u = x / cell + 0.5 * size - 0.5
    v = y / cell + 0.5 * size - 0.5
    if not (0.0 <= u < size - 1.0 and 0.0 <= v < size - 1.0):
        return outside
    return between(grid, u, v)


@kernel(inline=True)
def between(grid, u, v):  # type: ignore[no-untyped-def]
    """Returns a value of a grid at a place in cells, column u and row v, which lies within it."""
    j = np.uint32(np.int32(u))
    i = np.uint32(np.int32(v))
    u = np.float32(u) - np.float32(j)
    v = np.float32(v) - np.float32(i)
    one = np.uint32(1)
    low = grid[i, j] + (grid[i, j + one] - grid[i, j]) * u
    high = grid[i + one, j] + (grid[i + one, j + one] - grid[i + one, j]) * u
    return low + (high - low) * v


@kernel
def put_ways(around, prices):  # type: ignore[no-untyped-def]
    """Writes the ways of a map to the goal, with prices (G / COARSE, G / COARSE) as scratch.

    They solve the eikonal equation by fast sweeping (Zhao 2005); beyond the map they are straight.
    """
    seen = around.map
    goal = around.goal
    soft = around.clearance.soft
    ways = seen.ways
    side = COARSE * seen.cell
    size = ways.shape[0]
    half = 0.5 * size * side
    blocked = around.outline.inner + around.clearance.margin
    inside = max(abs(goal[0]), abs(goal[1])) < half - side
    for i in range(size):
        y = (i + 0.5) * side - half
        for j in range(size):
            x = (j + 0.5) * side - half
            away = value_at(seen.distances, seen.cell, x, y, seen.reach)
            near = min(max((blocked + soft - away) / soft, 0.0), 1.0)
            price = BLOCKED if away < blocked else 1.0 + NEAR * near * near
            prices[i, j] = price * side
            edge = i == 0 or j == 0 or i == size - 1 or j == size - 1
            gap = math.hypot(goal[0] - x, goal[1] - y)
            known = gap < 1.5 * side if inside else edge
            ways[i, j] = gap if known else np.inf
    for _ in range(ROUNDS):
        most = np.float32(0.0)
        for turn in range(4):
            most = max(most, sweep(ways, prices, turn & 1, turn >> 1))
        if most < SETTLED_M:
            break


@kernel
def way_at(x, y, around):  # type: ignore[no-untyped-def]
    """Returns the way from a point to the goal [m]."""
    gap = math.hypot(around.goal[0] - x, around.goal[1] - y)
    seen = around.map
    way = value_at(seen.ways, COARSE * seen.cell, x, y, gap)
    return way if way < np.inf else gap


@kernel
def room_at(x, y, c, s, around):  # type: ignore[no-untyped-def]
    """Returns how far the robot is from all hits at a pose [m], with its heading's cosine and sine.

    It is below 0 if it overlaps; far away it is what is certain.
    """
    seen = around.map
    outline = around.outline
    grid = seen.distances
    discs = outline.discs
    centre = outline.centre
    at_x = x + c * centre[0] - s * centre[1]
    at_y = y + s * centre[0] + c * centre[1]
    away = value_at(grid, seen.cell, at_x, at_y, seen.reach)
    if discs.shape[0] == 0 or away >= seen.reach - seen.cell:
        return away - outline.outer
    middle = 0.5 * grid.shape[0] - 0.5
    per_cell = 1.0 / seen.cell
    if max(abs(at_x), abs(at_y)) + outline.outer > (middle - 1.0) * seen.cell:
        return away - outline.inner  # at the border of the map
    u = middle + x * per_cell
    v = middle + y * per_cell
    c = c * per_cell
    s = s * per_cell
    least = seen.reach
    for d in range(discs.shape[0]):
        px = discs[d, 0]
        py = discs[d, 1]
        away = between(grid, u + c * px - s * py, v + s * px + c * py)
        least = min(least, away - discs[d, 2])
    return least


@kernel
def astray(x, y, c, s, way, around):  # type: ignore[no-untyped-def]
    """Returns by how much a heading misses the way to the goal: 0 along it, 1 the other way."""
    ahead = way_at(x + AHEAD_M * c, y + AHEAD_M * s, around)
    return min(max(0.5 + 0.5 * (ahead - way) / AHEAD_M, 0.0), 1.0)


@kernel
def touching(around):  # type: ignore[no-untyped-def]
    """Returns the room below which the robot touches something [m]; nearer already, only away."""
    return min(around.clearance.margin, room_at(0.0, 0.0, 1.0, 0.0, around) - 1e-3)
