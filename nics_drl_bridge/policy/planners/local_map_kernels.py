"""Local map of a single scan: distance to obstacles, and path length around them to the goal.

A planner builds it in `base_link` at each step and then discards it. Unobserved space counts as
free. Shapes: P parts of a scan, G cells along a side of the map, D discs of an outline.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.env.guide_kernels import update_ways
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Singles

# distance to the goal at which a robot has arrived
ARRIVED_M = 0.15
APART_M = 0.02  # hits closer than this to the previous one are left out
COARSE = 2  # side of a cell of `ways`, in cells of `distances`
BLOCKED, NEAR = 30.0, 3.0
"""Additional cost per metre where the robot does not fit, and next to such cells."""
AHEAD_M = 0.3  # distance ahead at which a heading is judged
ROUNDS, SETTLED_M = 6, 0.02
"""Maximum number of sweep rounds, and change of a path length below which it has converged [m]."""


class ScanRays(NamedTuple):
    """Rays of a scan in `base_link`; a fraction of 1 stands for `range_max`."""

    directions: Array  # (P, 2) unit vectors
    origin: Array  # (2,) [m]
    range_max: float  # [m]


class FootprintDiscs(NamedTuple):
    """Footprint of a robot in `base_link` as discs inside it, which cover nearly all of it."""

    discs: Array  # (D, 3) x, y, radius [m]
    centre: Array  # (2,) centre of the bounding circle [m]
    inner: float  # radius of the largest disc [m]
    outer: float  # radius of the bounding circle [m]


class LocalMap(NamedTuple):
    """Square map around `base_link`; the first index runs along y."""

    distances: Singles  # (G, G) distance to the nearest hit, at most `reach` [m]
    # (G / COARSE, G / COARSE) path length to the goal, weighted near obstacles [m]
    ways: Singles
    cell: float  # side of a cell of `distances` [m]
    reach: float  # maximum of `distances` [m]


class Clearance(NamedTuple):
    """Clearance to keep between an outline and all hits."""

    margin: float  # clearance below which it counts as a contact [m]
    soft: float  # additional clearance within which a cost applies [m]


class Situation(NamedTuple):
    """A robot that avoids obstacles, its goal, and the map of its latest scan."""

    rays: ScanRays
    outline: FootprintDiscs
    clearance: Clearance
    map: LocalMap
    goal: Array  # (2,) in `base_link` [m]
    hits: Array  # (P, 2) [m]
    prices: Singles  # like `LocalMap.ways`


@kernel
def map_scan(shares: Array, goal: Array, around: Situation) -> None:
    """Maps a scan of range fractions (P,) around a robot whose goal (2,) is in `base_link` [m]."""
    around.goal[0] = goal[0]
    around.goal[1] = goal[1]
    count = find_hits(around.hits, shares, around.rays)
    measure_distances(around.map, around.hits[:count])
    find_ways(around)


@kernel
def find_hits(hits: Array, shares: Array, rays: ScanRays) -> int:
    """Writes end points of range fractions (P,) into hits (P, 2) [m]; returns their number.

    Fractions of 0 are left out: they are unknown, or too close to distinguish from the
    robot itself.
    """
    count = 0
    for p in range(len(shares)):
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
def measure_distances(seen: LocalMap, hits: Array) -> None:
    """Writes the distances of a map to hits (H, 2)."""
    grid = seen.distances
    half = 0.5 * len(grid) * seen.cell
    grid[:] = np.float32(seen.reach * seen.reach)
    for h in range(len(hits)):
        _lower_squares(hits[h, 0] + half, hits[h, 1] + half, seen)
    for i in range(len(grid)):
        row = grid[i]
        for j in range(len(row)):
            row[j] = math.sqrt(row[j])


@kernel
def _lower_squares(x: float, y: float, seen: LocalMap) -> None:
    """Lowers squared distances to those from a hit, given from the map's corner [m]."""
    cell = seen.cell
    left, right = _find_span(x, seen)
    low, high = _find_span(y, seen)
    first = np.float32((left + 0.5) * cell - x)
    for i in range(low, high):
        dy = np.float32((i + 0.5) * cell - y)
        row = seen.distances[i, left:right]
        for j in range(len(row)):
            dx = np.float32(j) * np.float32(cell) + first
            away = dx * dx + dy * dy
            row[j] = away if away < row[j] else row[j]


@kernel
def _find_span(middle: float, seen: LocalMap) -> tuple[int, int]:
    """Returns the range (first, last + 1) of cells within `reach` of a coordinate [m]."""
    size = len(seen.distances)
    low = min(max(int((middle - seen.reach) / seen.cell), 0), size)
    return low, max(min(int((middle + seen.reach) / seen.cell) + 1, size), low)


@kernel
def interpolate(
    grid: Singles, cell: float, x: float, y: float, outside: float
) -> float:
    """Returns the value of a grid at a point, bilinear between cell centres."""
    size = len(grid)
    u = x / cell + 0.5 * size - 0.5
    v = y / cell + 0.5 * size - 0.5
    if not (0.0 <= u < size - 1.0 and 0.0 <= v < size - 1.0):
        return outside
    return interpolate_inside(grid, u, v)


@kernel(inline=True)
def interpolate_inside(
    grid: Singles, u: float | np.float32, v: float | np.float32
) -> float:
    """Returns the value of a grid at column u and row v (in cells), which lie within it."""
    j = np.uint32(np.int32(u))
    i = np.uint32(np.int32(v))
    u = np.float32(u) - np.float32(j)
    v = np.float32(v) - np.float32(i)
    step = np.uint32(1)
    low = grid[i, j] + (grid[i, j + step] - grid[i, j]) * u
    high = grid[i + step, j] + (grid[i + step, j + step] - grid[i + step, j]) * u
    return low + (high - low) * v


@kernel
def find_ways(around: Situation) -> None:
    """Writes a map's path lengths to the goal.

    Solves the eikonal equation by fast sweeping (Zhao 2005). Beyond the map, paths are straight.
    """
    _price_cells(around)
    _start_ways(around.map, around.goal)
    ways = around.map.ways
    for _ in range(ROUNDS):
        most = np.float32(0.0)
        for turn in range(4):
            most = max(most, update_ways(ways, around.prices, turn & 1, turn >> 1))
        if most < SETTLED_M:
            break


@kernel
def _price_cells(around: Situation) -> None:
    """Writes the cost of crossing each cell: its side, more near hits [m]."""
    seen = around.map
    soft = around.clearance.soft
    side = COARSE * seen.cell
    size = len(around.prices)
    half = 0.5 * size * side
    blocked = around.outline.inner + around.clearance.margin
    for i in range(size):
        y = (i + 0.5) * side - half
        for j in range(size):
            x = (j + 0.5) * side - half
            away = interpolate(seen.distances, seen.cell, x, y, seen.reach)
            near = min(max((blocked + soft - away) / soft, 0.0), 1.0)
            around.prices[i, j] = side * (
                BLOCKED if away < blocked else 1.0 + NEAR * near * near
            )


@kernel
def _start_ways(seen: LocalMap, goal: Array) -> None:
    """Writes the straight path lengths around the goal, or at the edge if it is beyond the map."""
    side = COARSE * seen.cell
    size = len(seen.ways)
    half = 0.5 * size * side
    inside = max(abs(goal[0]), abs(goal[1])) < half - side
    for i in range(size):
        y = (i + 0.5) * side - half
        for j in range(size):
            x = (j + 0.5) * side - half
            gap = math.hypot(goal[0] - x, goal[1] - y)
            edge = i == 0 or j == 0 or i == size - 1 or j == size - 1
            is_start = gap < 1.5 * side if inside else edge
            seen.ways[i, j] = gap if is_start else np.inf


@kernel
def find_way(x: float, y: float, around: Situation) -> float:
    """Returns the path length from a point to the goal [m]."""
    gap = math.hypot(around.goal[0] - x, around.goal[1] - y)
    seen = around.map
    way = interpolate(seen.ways, COARSE * seen.cell, x, y, gap)
    return way if way < np.inf else gap


@kernel
def find_room(x: float, y: float, c: float, s: float, around: Situation) -> float:
    """Returns the clearance at a pose [m]; c and s are the cosine and sine of its heading.

    It is negative if the footprint overlaps a hit. Far from all hits it is a lower bound.
    """
    seen = around.map
    outline = around.outline
    grid = seen.distances
    discs = outline.discs
    centre = outline.centre
    at_x = x + c * centre[0] - s * centre[1]
    at_y = y + s * centre[0] + c * centre[1]
    away = interpolate(grid, seen.cell, at_x, at_y, seen.reach)
    if len(discs) == 0 or away >= seen.reach - seen.cell:
        return away - outline.outer
    middle = 0.5 * len(grid) - 0.5
    per_cell = 1.0 / seen.cell
    if max(abs(at_x), abs(at_y)) + outline.outer > (middle - 1.0) * seen.cell:
        return away - outline.inner  # off the map
    u = middle + x * per_cell
    v = middle + y * per_cell
    c *= per_cell
    s *= per_cell
    least = seen.reach
    for d in range(len(discs)):
        px = discs[d, 0]
        py = discs[d, 1]
        away = interpolate_inside(grid, u + c * px - s * py, v + s * px + c * py)
        least = min(least, away - discs[d, 2])
    return least


@kernel
def score_heading(
    x: float, y: float, c: float, s: float, way: float, around: Situation
) -> float:
    """Returns how far a heading is off the path to the goal: 0 along it, 1 away from it."""
    ahead = find_way(x + AHEAD_M * c, y + AHEAD_M * s, around)
    return min(max(0.5 + 0.5 * (ahead - way) / AHEAD_M, 0.0), 1.0)


@kernel
def find_contact_limit(around: Situation) -> float:
    """Returns the clearance that counts as a contact [m]; lower if the robot already touches."""
    return min(around.clearance.margin, find_room(0.0, 0.0, 1.0, 0.0, around) - 1e-3)
