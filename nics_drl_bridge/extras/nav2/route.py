"""Shortest paths on a map for a disc-shaped robot: Dijkstra's search over cells.

The search runs on a coarser map. Its cells are the nodes of a graph; links connect each free cell
with its free neighbours, also diagonally. The cost of a link is its length in cells; next to
obstacles, it is up to 1 + `DEARER` times as high.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import ArrayLike

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Mask
from nics_drl_bridge.lidar.maps import FREE, OCCUPIED, GridMap

CELL = 0.1  # minimum side of a cell [m]
COMFORT = 0.4  # distance of the disc from obstacles below which a path costs more [m]
DEARER = 3.0  # maximum additional cost, as a multiple of the length
# four of the eight neighbours of a cell, the others by symmetry: rows, columns, length [cells]
NEIGHBOURS = (
    (0, 1, 1.0),
    (1, 0, 1.0),
    (1, 1, math.sqrt(2.0)),
    (1, -1, math.sqrt(2.0)),
)
Cell = tuple[int, int]  # row, column


def route(grid: GridMap, start: ArrayLike, goal: ArrayLike, radius: float) -> Array:
    """Returns a path (P, 2) [m] from start to goal, a radius [m] away from occupied cells.

    It keeps a greater distance where there is space. The cells of start and goal count as free.
    Unknown cells also count as free, unless the map treats them as solid. A cell of the
    coarser map is occupied if any part of it is, so a gap must be wider than the disc
    by up to two cells. Raises ConfigError if start or goal is off the map, or if there
    is no path.
    """
    coarse = _coarsen(grid, max(1, math.ceil(CELL / grid.resolution - 1e-6)))
    start_cell = _find_cell(coarse, "start", start)
    goal_cell = _find_cell(coarse, "goal", goal)
    clearance = coarse.distance_field
    passable = clearance > radius
    # At both ends, the robot may be nearer to an obstacle than the map allows.
    passable[start_cell] = True
    passable[goal_cell] = True
    closeness = np.clip(1.0 - (clearance - radius) / COMFORT, 0.0, 1.0)
    cells = _search(passable, 1.0 + DEARER * closeness, start_cell, goal_cell)
    if not cells:
        raise ConfigError(
            f"for a robot of radius {radius:g} m there is no path to the goal on the map; give "
            "a goal that it can reach."
        )
    between = coarse.cell_to_world(np.reshape(cells[1:-1], (-1, 2)))
    first = np.asarray(start, np.float64)[:2]
    last = np.asarray(goal, np.float64)[:2]
    return np.array([first, *between, last])


def warm_up() -> None:
    """Loads the libraries that `route` uses; a robot may be driving when its first goal comes."""
    cells = np.array([[FREE, FREE, OCCUPIED]], np.int8)
    route(GridMap(cells, 1.0), (0.5, 0.5), (1.5, 0.5), 0.0)


def _coarsen(grid: GridMap, parts: int) -> GridMap:
    """Returns the map with cells `parts` times as large; each is occupied if any part of it is."""
    rows, columns = grid.cells.shape
    large_rows = math.ceil(rows / parts)
    large_columns = math.ceil(columns / parts)
    padded = np.full((large_rows * parts, large_columns * parts), FREE, np.int8)
    padded[:rows, :columns] = np.where(grid.blocked, OCCUPIED, FREE)
    blocks = padded.reshape(large_rows, parts, large_columns, parts)
    return GridMap(blocks.max(axis=(1, 3)), grid.resolution * parts, grid.origin)


def _find_cell(grid: GridMap, name: str, point: ArrayLike) -> Cell:
    """Returns the cell of a point x, y [m]. Raises ConfigError if it is off the map."""
    row, column = grid.world_to_cell(point).tolist()
    rows, columns = grid.cells.shape
    if not (0 <= row < rows and 0 <= column < columns):
        raise ConfigError(f"the {name} of the path is off the map; give one on it.")
    return row, column


def _search(passable: Mask, cell_costs: Array, start: Cell, goal: Cell) -> list[Cell]:
    """Returns the cells of the cheapest path, or [] if there is none."""
    shape = passable.shape
    first = int(np.ravel_multi_index(start, shape))
    last = int(np.ravel_multi_index(goal, shape))
    # Searching backwards from the goal, the predecessor of a cell is the next one to drive to.
    costs, following = scipy.sparse.csgraph.dijkstra(
        _link_cells(passable, cell_costs),
        directed=False,
        indices=last,
        return_predecessors=True,
    )
    if not np.isfinite(costs[first]):
        return []
    nodes = [first]
    while nodes[-1] != last:
        nodes.append(int(following[nodes[-1]]))
    return [divmod(node, shape[1]) for node in nodes]


def _link_cells(passable: Mask, cell_costs: Array) -> Any:
    """Returns the sparse matrix (rows * columns)^2 of the costs of all links."""
    links = zip(*_list_links(passable, cell_costs), strict=True)
    ends, other_ends, costs = map(np.concatenate, links)
    shape = (passable.size, passable.size)
    return scipy.sparse.coo_array((costs, (ends, other_ends)), shape=shape).tocsr()


def _list_links(passable: Mask, cell_costs: Array) -> Iterator[tuple[AnyArray, ...]]:
    """Yields cells (n,), their neighbours and the costs of the links, for each of `NEIGHBOURS`."""
    rows, columns = passable.shape
    nodes = np.arange(passable.size).reshape(passable.shape)
    for down, right, length in NEIGHBOURS:
        # Two views of the grid, in which the same index is a cell and its neighbour.
        cell = np.s_[: rows - down, max(0, -right) : columns - max(0, right)]
        neighbour = np.s_[down:, max(0, right) : columns - max(0, -right)]
        linked = passable[cell] & passable[neighbour]
        link_costs = length * 0.5 * (cell_costs[cell] + cell_costs[neighbour])
        yield nodes[cell][linked], nodes[neighbour][linked], link_costs[linked]
