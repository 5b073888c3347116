"""Shortest paths on a map for a disc-shaped robot: Dijkstra's search over cells."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.maps import FREE, OCCUPIED, GridMap

CELL = 0.1  # minimum side of a cell [m]
COMFORT = 0.4  # distance from obstacles below which a path costs more [m]
DEARER = 3.0  # maximum additional cost, as a fraction of the length
STEPS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, math.sqrt(2.0)), (1, -1, math.sqrt(2.0)))


def route(grid: GridMap, start: ArrayLike, goal: ArrayLike, radius: float) -> Array:
    """Returns a path (P, 2) [m] from start to goal that keeps a radius [m] off occupied cells.

    It keeps a greater distance where there is space. Unknown cells count as free. Raises
    ConfigError if start or goal is off the map, or if there is no path.
    """
    coarse = _coarse(grid, max(1, math.ceil(CELL / grid.resolution - 1e-6)))
    room = coarse.distance_field
    ends = [tuple(coarse.world_to_cell(each).tolist()) for each in (start, goal)]
    for name, cell in zip(("start", "goal"), ends, strict=True):
        if not all(0 <= i < n for i, n in zip(cell, room.shape, strict=True)):
            raise ConfigError(f"the {name} of the path is off the map; give one on it.")
    passable = room > radius
    for cell in ends:  # free by assumption: the robot is or will be there
        passable[cell] = True
    dear = 1.0 + DEARER * np.clip(1.0 - (room - radius) / COMFORT, 0.0, 1.0)
    number = np.arange(room.size).reshape(room.shape)
    links = []
    for down, right, far in STEPS:
        a = (
            slice(0, room.shape[0] - down),
            slice(max(0, -right), room.shape[1] - max(0, right)),
        )
        b = (slice(down, None), slice(max(0, right), room.shape[1] - max(0, -right)))
        both = passable[a] & passable[b]
        cost = far * 0.5 * (dear[a] + dear[b])
        links.append((number[a][both], number[b][both], cost[both]))
    first, second, cost = (np.concatenate(each) for each in zip(*links, strict=True))
    graph = coo_array((cost, (first, second)), shape=(room.size, room.size)).tocsr()
    begin, end = (int(number[cell]) for cell in ends)
    far, before = dijkstra(graph, directed=False, indices=end, return_predecessors=True)
    if not np.isfinite(far[begin]):
        reason = f"for a robot of radius {radius:g} m there is no path to the goal on the map"
        raise ConfigError(f"{reason}; give a goal that it can reach.")
    cells = [begin]
    while cells[-1] != end:
        cells.append(int(before[cells[-1]]))
    middles = coarse.cell_to_world(
        np.stack(np.divmod(cells[1:-1], room.shape[1]), axis=-1)
    )
    return np.array(
        [np.asarray(start, np.float64)[:2], *middles, np.asarray(goal, np.float64)[:2]]
    )


def _coarse(grid: GridMap, parts: int) -> GridMap:
    """Returns the map with cells `parts` times as large; they are occupied if any part is."""
    rows, columns = (math.ceil(count / parts) * parts for count in grid.cells.shape)
    cells = np.full((rows, columns), FREE, np.int8)
    cells[: grid.cells.shape[0], : grid.cells.shape[1]] = np.where(
        grid.blocked, OCCUPIED, FREE
    )
    large = cells.reshape(rows // parts, parts, columns // parts, parts).max(
        axis=(1, 3)
    )
    return GridMap(large, grid.resolution * parts, grid.origin)
