"""A world as a grid of free and occupied cells, for planners; it shows all that stands still."""

import math
from collections.abc import Sequence
from itertools import pairwise, zip_longest
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from nics_drl_bridge.geometry import Array, compose, rotate
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.maps import FREE, OCCUPIED, GridMap
from nics_drl_bridge.lidar.shapes import Circle, Shape
from nics_drl_bridge.sim.scenes import SetSampler
from nics_drl_bridge.sim.world import World

Placed = tuple[Shape, ArrayLike]  # a shape, and its pose (3,)
CELL = 0.01  # side of a cell [m]
MOST_CELLS = 1_000_000  # in fields with more cells, the cells are larger
SAMPLES = 8  # number of samples of an edge in a cell
ROUNDING = 1e-6  # fraction of a cell by which a field may exceed whole cells


def standing(sampler: SetSampler, member: int, bodies: Array) -> list[Placed]:
    """Return the obstacles that stand still, of bodies (K, 7) in a world of the sampler."""
    own = sampler.samplers[member].motions
    # bodies that are not part of the world stand still
    both = zip_longest(bodies, own[: len(bodies)])
    return [
        (sampler.shapes[int(body[SHAPE])], body[:3])
        for body, motion in both
        if motion is None and body[RADIUS] > 0.0
    ]


def occupancy(
    world: World, obstacles: Sequence[Placed] = (), cell: float = CELL
) -> GridMap:
    """Return the map of a world: its own map, walls, and the given obstacles.

    A cell is occupied if its centre is in something solid, or a wall runs through it. A field with
    walls is closed by cells around it. `cell` [m] is the maximum size: cells of the world's own map
    are divided evenly, so that none of its detail is lost. A large world gets larger cells.
    """
    grid = world.grid
    place, first, size, cell = _frame_of(world, cell)
    origin = compose(place, [*(first * cell), 0.0])
    made = GridMap(np.full(size, FREE, np.int8), cell, tuple(origin.tolist()))
    if world.size is not None:
        _enclose(made, np.array(world.size) / 2.0)
    if grid is not None:
        parts, (column, row) = round(grid.resolution / cell), -first
        own = grid.cells.repeat(parts, axis=0).repeat(parts, axis=1)
        into = made.cells[row : row + own.shape[0], column : column + own.shape[1]]
        into[:] = np.where(into == OCCUPIED, into, own)
    for wall in np.array(world.walls, np.float64).reshape(-1, 2, 2):
        at = made.world_to_cell(_along(wall, cell))
        at = at[((at >= 0) & (at < made.cells.shape)).all(axis=-1)]
        made.cells[at[:, 0], at[:, 1]] = OCCUPIED
    for shape, pose in obstacles:
        _fill(made, shape, np.asarray(pose, np.float64))
    return made


def _frame_of(
    world: World, cell: float
) -> tuple[Any, NDArray[np.int_], tuple[int, int], float]:
    """Frame (3,) of the rows, first column and row, their numbers, and the side of a cell [m]."""
    grid = world.grid
    ends = world.all_walls().reshape(-1, 2)
    if world.size is not None or world.bounds is not None:
        ends = np.concatenate([ends, np.reshape(world.extent, (2, 2))])
    place: Any = grid.origin if grid is not None else (*ends.min(axis=0), 0.0)
    corners = rotate(ends - place[:2], -place[2])
    if grid is not None:
        own = np.array([(0, 0), grid.cells.shape[::-1]]) * grid.resolution
        corners = np.concatenate([corners, own])
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    cell = max(cell, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    if grid is not None:
        cell = grid.resolution / max(1, math.ceil(grid.resolution / cell - ROUNDING))
    first = np.floor(low / cell + ROUNDING).astype(int) - 1
    columns, rows = np.ceil(high / cell - ROUNDING).astype(int) + 1 - first
    return place, first, (int(rows), int(columns)), cell


def _enclose(made: GridMap, half: Array) -> None:
    """Occupy everything outside a field, given half its size (2,) [m]."""
    rows, columns = (np.arange(count) for count in made.cells.shape)
    if not made.origin[2]:  # x is that of the column alone
        x = made.cell_to_world(np.stack([0 * columns, columns], axis=-1))[:, 0]
        y = made.cell_to_world(np.stack([rows, 0 * rows], axis=-1))[:, 1]
        made.cells[np.abs(y) > half[1]] = OCCUPIED
        made.cells[:, np.abs(x) > half[0]] = OCCUPIED
        return
    away = np.abs(made.cell_to_world(np.moveaxis(np.indices(made.cells.shape), 0, -1)))
    made.cells[(away > half).any(axis=-1)] = OCCUPIED


def _along(corners: Array, cell: float) -> Array:
    """Points (P, 2) on straight lines from corner to corner (V, 2), several in each cell."""
    parts = []
    for begin, end in pairwise(corners):
        count = max(2, math.ceil(math.dist(begin, end) / cell * SAMPLES))
        parts.append(begin + np.linspace(0.0, 1.0, count)[:, None] * (end - begin))
    return np.concatenate(parts)


def _fill(made: GridMap, shape: Shape, pose: Array) -> None:
    """Occupy the cells in a shape; of a part that is too thin to hold a centre, its outline."""
    around = made.world_to_cell(pose[:2])
    reach = math.ceil(shape.radius / made.resolution) + 1
    low = np.maximum(around - reach, 0)
    high = np.minimum(around + reach + 1, made.cells.shape)
    if (low >= high).any():
        return
    box = made.cells[low[0] : high[0], low[1] : high[1]]
    middles = made.cell_to_world(np.moveaxis(np.indices(box.shape), 0, -1) + low)
    inside = _inside(shape, rotate(middles - pose[:2], -pose[2]))
    box[inside] = OCCUPIED
    if len(shape.outline):
        edge = _along(
            np.concatenate([shape.outline, shape.outline[:1]]), made.resolution
        )
        at = made.world_to_cell(pose[:2] + rotate(edge, pose[2])) - low
        kept = ((at >= 0) & (at < box.shape)).all(axis=-1)
        thin = at[kept][
            ~ndimage.maximum_filter(inside, 3)[at[kept][:, 0], at[kept][:, 1]]
        ]
        box[thin[:, 0], thin[:, 1]] = OCCUPIED


def _inside(shape: Shape, points: Array) -> NDArray[np.bool_]:
    if isinstance(shape, Circle):
        return np.asarray(np.hypot(points[..., 0], points[..., 1]) <= shape.radius)
    within = np.zeros(points.shape[:-1], np.bool_)
    x = points[..., 0]
    y = points[..., 1]
    corners = shape.outline if len(shape.outline) > 2 else np.zeros((0, 2))
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y1 != y2:  # a ray along x crosses an odd number of edges
            within ^= ((y1 > y) != (y2 > y)) & (
                x < x1 + (y - y1) * (x2 - x1) / (y2 - y1)
            )
    return within
