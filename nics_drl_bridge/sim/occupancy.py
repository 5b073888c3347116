"""Occupancy grid of everything static in a world, for planners.

`occupancy` makes the grid in five steps, each of which only turns free cells into occupied ones:

1. `_frame_of`: choose the cells. They are aligned with the world's own map, if any,
   cover the field, its walls and the map, and add a border of one cell.
2. Occupy every cell whose centre lies outside a walled field.
3. Copy the world's own map.
4. Occupy the cells along each wall, found by points much closer than a cell.
5. `_fill`: occupy the cells whose centre lies in an obstacle. A part thinner than a
   cell may contain no centre; the cells along its outline are then occupied, or for a
   disc, the cell at its centre.

Cells are indexed by row (along y of the grid) and column (along x).
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.geometry import compose, compute_depths, rotate
from nics_drl_bridge.lidar.arrays import Array, Mask
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.maps import FREE, OCCUPIED, GridMap
from nics_drl_bridge.lidar.shapes import Circle, Shape
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.world import World

Placed = tuple[Shape, ArrayLike]  # a shape, and its pose (3,)
CELL = 0.01  # side of a cell [m]
MOST_CELLS = 1_000_000  # in larger fields, the cells grow
SAMPLES = 8  # number of samples per cell along an edge
ROUNDING = 1e-6  # allowance for rounding errors [cells]


def standing(sampler: SceneSampler, member: int, bodies: Array) -> list[Placed]:
    """Return the static obstacles among bodies (K, 7) of one of the worlds."""
    motions = sampler.samplers[member].motions
    placed: list[Placed] = []
    for k, body in enumerate(bodies):
        # Bodies after the world's own were added later and never move.
        stands = k >= len(motions) or motions[k] is None
        is_present = body[RADIUS] > 0.0
        if stands and is_present:
            placed.append((sampler.shapes[int(body[SHAPE])], body[:3]))
    return placed


def occupancy(
    world: World, obstacles: Sequence[Placed] = (), cell: float = CELL
) -> GridMap:
    """Return the occupancy grid of a world: its own map, its walls, and obstacles.

    A cell is occupied if its centre is inside a solid, or if a wall crosses it. A
    walled field is surrounded by occupied cells. `cell` [m] is the desired size. Cells
    of the world's own map are divided evenly, so that no detail is lost. Without a map,
    a world of more than `MOST_CELLS` gets larger cells.
    """
    frame = _frame_of(world, cell)
    origin = compose(frame.pose, [*(frame.first * frame.cell), 0.0])
    cells = np.full(frame.size, FREE, np.int8)
    made = GridMap(cells, frame.cell, tuple(origin.tolist()))
    if world.size is not None:  # occupy everything around the field
        centres = made.cell_to_world(_cell_indices(cells))
        cells[(np.abs(centres) > np.array(world.size) / 2.0).any(axis=-1)] = OCCUPIED
    if world.grid is not None:
        _copy_map(made, world.grid, frame)
    for wall in np.array(world.walls, np.float64).reshape(-1, 2, 2):
        index = made.world_to_cell(_along(wall, made.resolution))
        index = index[_is_within(index, cells)]
        cells[index[:, 0], index[:, 1]] = OCCUPIED
    for shape, pose in obstacles:
        _fill(made, shape, np.asarray(pose, np.float64))
    return made


def _copy_map(made: GridMap, grid: GridMap, frame: "_Frame") -> None:
    """Copy a map: each of its cells becomes a square of smaller cells."""
    parts = round(grid.resolution / made.resolution)
    copied = grid.cells.repeat(parts, axis=0).repeat(parts, axis=1)
    column, row = -frame.first
    into = made.cells[row : row + copied.shape[0], column : column + copied.shape[1]]
    into[:] = np.where(into == OCCUPIED, into, copied)


class _Frame(NamedTuple):
    """Position, size and number of the cells of a grid."""

    # (3,) pose in the world; columns and rows are counted from it along its axes
    pose: Any
    first: NDArray[np.int_]  # (2,) first column and first row, often negative
    size: tuple[int, int]  # numbers of rows and columns
    cell: float  # side of a cell [m]


def _frame_of(world: World, cell: float) -> _Frame:
    """Choose the cells of a world, given the maximum side of a cell [m]."""
    grid = world.grid
    ends = _find_ends(world)
    pose: Any = grid.origin if grid is not None else (*ends.min(axis=0), 0.0)
    corners = rotate(ends - pose[:2], -pose[2])
    if grid is not None:
        map_corners = np.array([(0, 0), grid.cells.shape[::-1]]) * grid.resolution
        corners = np.concatenate([corners, map_corners])
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    cell = max(cell, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    if grid is not None:  # its cells are divided evenly
        cell = grid.resolution / max(1, math.ceil(grid.resolution / cell - ROUNDING))
    first = np.floor(low / cell + ROUNDING).astype(int) - 1
    end = np.ceil(high / cell - ROUNDING).astype(int) + 1
    columns, rows = end - first
    return _Frame(pose, first, (int(rows), int(columns)), cell)


def _find_ends(world: World) -> Array:
    """Return the ends of the walls and the corners of the field, if any (P, 2)."""
    ends = world.all_walls().reshape(-1, 2)
    if world.size is None and world.bounds is None:
        return ends
    x1, y1, x2, y2 = world.extent
    return np.concatenate([ends, [(x1, y1), (x2, y1), (x2, y2), (x1, y2)]])


def _cell_indices(cells: NDArray[Any]) -> NDArray[np.int_]:
    """Row and column (rows, columns, 2) of every cell of a grid (rows, columns)."""
    return np.moveaxis(np.indices(cells.shape), 0, -1)


def _is_within(index: NDArray[np.int_], cells: NDArray[Any]) -> Mask:
    """Return True (P,) for cell indices (P, 2) inside a grid."""
    is_within = (index >= 0) & (index < cells.shape)
    return np.asarray(is_within.all(axis=-1))


def _along(corners: Array, cell: float) -> Array:
    """Points (P, 2) on straight lines from corner to corner (V, 2), several in each cell."""
    parts = []
    for begin, end in pairwise(corners):
        count = max(2, math.ceil(math.dist(begin, end) / cell * SAMPLES))
        fractions = np.linspace(0.0, 1.0, count)[:, None]
        parts.append(begin + fractions * (end - begin))
    return np.concatenate(parts)


def _fill(made: GridMap, shape: Shape, pose: Array) -> None:
    """Occupy the cells in a shape, or those along its outline where it is thin."""
    # only the cells in the square around the shape's circle
    middle = made.world_to_cell(pose[:2])
    reach = math.ceil(shape.radius / made.resolution) + 1
    low = np.maximum(middle - reach, 0)
    high = np.minimum(middle + reach + 1, made.cells.shape)
    if (low >= high).any():
        return
    box = made.cells[low[0] : high[0], low[1] : high[1]]
    centres = made.cell_to_world(_cell_indices(box) + low)
    inside = _inside(shape, rotate(centres - pose[:2], -pose[2]))
    box[inside] = OCCUPIED
    if isinstance(shape, Circle):
        if not inside.any() and _is_within(middle, made.cells):
            made.cells[middle[0], middle[1]] = OCCUPIED
        return
    closed_outline = np.concatenate([shape.outline, shape.outline[:1]])
    edge = _along(closed_outline, made.resolution)
    index = made.world_to_cell(pose[:2] + rotate(edge, pose[2])) - low
    index = index[_is_within(index, box)]
    near_inside = scipy.ndimage.maximum_filter(inside, 3)
    thin = index[~near_inside[index[:, 0], index[:, 1]]]
    box[thin[:, 0], thin[:, 1]] = OCCUPIED


def _inside(shape: Shape, points: Array) -> Mask:
    """Return True (rows, columns) for points (rows, columns, 2) inside a shape."""
    if isinstance(shape, Circle):
        return np.hypot(points[..., 0], points[..., 1]) <= shape.radius
    if len(shape.outline) < 3:  # a segment has no inside
        return np.zeros(points.shape[:2], np.bool_)
    # Row by row, because the depths of all points at once would take too much memory.
    return np.array([compute_depths(row, shape.outline) > 0.0 for row in points])
