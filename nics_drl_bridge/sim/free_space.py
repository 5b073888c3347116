"""Connected free space of a world, before obstacles are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import OCCUPIED, GridMap
from nics_drl_bridge.sim import space_kernels as kernels
from nics_drl_bridge.sim.world import Goals, Starts, World, check_places

CELL = 0.1
"""Side of the cells of a field without a map [m]; larger in large fields, smaller in small ones."""
FEWEST_CELLS = 20
MOST_CELLS = 4_000_000
NO_MAP = (np.zeros((0, 0), np.float32), np.array([0.0, 0.0, 1.0, 0.0, 1.0]))


@dataclass(frozen=True)
class Areas:
    """The free space of a world for one size of robot.

    Attributes:
        static: everything that stands in every scene, see `space_kernels`.
        room: free space required around the centre of a cell, so that a disc of footprint and
            clearance can move between the centres of neighbouring cells [m].
        for_robots: (C,) row-major indices of the cells where a robot may start.
        for_anything: (C,) row-major indices of the cells with free space.
    """

    static: tuple[Any, ...]
    room: float
    for_robots: NDArray[np.int64]
    for_anything: NDArray[np.int64]


def areas_of(world: World, footprint: float) -> Areas:
    """Finds the free space and the areas within which a robot can move.

    A robot moves between the centres of neighbouring cells, with the clearance of the world around
    it. Areas too small for a start and a goal are dropped.

    Args:
        world: the field and its static map.
        footprint: radius of a robot [m].

    Raises:
        ConfigError: no room for a start and a goal; the message names the key.
    """
    check_places(world)
    cells, frame, solid = _grid_of(world)
    walls, bounds = world.all_walls(), np.array([-np.inf, -np.inf, np.inf, np.inf])
    distance = cells.copy()
    kernels.wall_distances(distance, frame, walls)
    if world.size is not None:
        bounds = np.array(world.extent)
        distance[~_inside(distance.shape, frame, bounds)] = 0.0
    need = footprint + world.clearance
    # Between two cell centres the path is nearer to a corner than at either end.
    room = math.hypot(need, frame[4] / 2.0)
    label, _ = ndimage.label(distance >= room)
    if not label.any():
        raise ConfigError(
            f"{world.source}: key 'clearance': no free space for a robot of radius {footprint:g} m "
            f"with {world.clearance:g} m around it; lower `clearance`, or enlarge the world."
        )
    label = _large_enough(label, frame[4], world.goal_distance[0]).astype(np.int32)
    if not label.any():
        raise ConfigError(
            f"{world.source}: key 'goal_distance': nowhere can a robot of radius {footprint:g} m "
            f"with {world.clearance:g} m around it reach a goal {world.goal_distance[0]:g} m away; "
            "lower `goal_distance` or `clearance`, or enlarge the world."
        )
    static = (distance, label, frame, bounds, walls, solid)
    for key, places in (("starts", world.starts), ("goals", world.goals)):
        _check(world, key, places, label, frame)
    return Areas(static, room, np.flatnonzero(label), np.flatnonzero(distance > 0.0))


def _grid_of(world: World) -> tuple[NDArray[np.float32], NDArray[np.float64], Any]:
    """Returns distances to the map (rows, columns), frame of the cells, map for the kernels.

    With a map the cells are the map's plus a solid border: unknown cells and everything outside
    the map count as occupied.
    """
    if world.grid is not None:
        closed = np.pad(world.grid.cells, 1, constant_values=OCCUPIED)
        size = world.grid.resolution
        x, y = world.grid.cell_to_world([-1.5, -1.5])
        heading = world.grid.origin[2]
        whole = GridMap(closed, size, (x, y, heading), unknown_stops=True)
        distance = whole.distance_field
        frame = np.array([x, y, math.cos(heading), math.sin(heading), size])
        return distance, frame, (distance, frame)
    x1, y1, x2, y2 = world.extent
    size = min(CELL, min(x2 - x1, y2 - y1) / FEWEST_CELLS)
    size = max(size, math.sqrt((x2 - x1) * (y2 - y1) / MOST_CELLS))
    shape = max(1, math.ceil((y2 - y1) / size)), max(1, math.ceil((x2 - x1) / size))
    frame = np.array([x1, y1, 1.0, 0.0, size])
    return np.full(shape, np.inf, np.float32), frame, NO_MAP


def _centres(shape: tuple[int, ...], frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns x, y of the centres of the cells (2, rows, columns) [m]."""
    rows, columns = np.indices(shape) + 0.5
    return np.array(kernels.place_in.py_func(rows, columns, frame))


def _inside(
    shape: tuple[int, ...], frame: NDArray[np.float64], bounds: NDArray[np.float64]
) -> NDArray[np.bool_]:
    x, y = _centres(shape, frame)
    return np.asarray((x > bounds[0]) & (x < bounds[2]) & (y > bounds[1]) & (y < bounds[3]))


def _large_enough(label: NDArray[np.int32], cell: float, least: float) -> NDArray[np.int32]:
    """Keeps labels of areas whose bounding box has a diagonal >= `least` [m]; zeroes the others."""
    spans = [
        cell * math.hypot(*(part.stop - part.start for part in parts))
        for parts in ndimage.find_objects(label)
    ]
    keep = np.array([0, *(i + 1 if span >= least else 0 for i, span in enumerate(spans))])
    return np.asarray(keep[label])


def _check(
    world: World,
    key: str,
    places: Starts | Goals | None,
    label: NDArray[np.int32],
    frame: NDArray[np.float64],
) -> None:
    """Raises ConfigError for a region or a place where no robot fits."""
    if places is None:
        return
    free = np.zeros((2, 0)) if places.at else _centres(label.shape, frame)[:, label > 0]
    for number, (x1, y1, x2, y2) in enumerate(places.regions):
        within = (free[0] >= min(x1, x2)) & (free[0] <= max(x1, x2))
        within &= (free[1] >= min(y1, y2)) & (free[1] <= max(y1, y2))
        if not within.any():
            raise ConfigError(_nowhere(world, f"{key}.regions.{number}", places.regions[number]))
    for number, at in enumerate(places.at):
        i, j, _ = kernels.cell_of(at[0], at[1], frame)
        inside = 0 <= i < label.shape[0] and 0 <= j < label.shape[1]
        if not inside or label[i, j] == 0:
            raise ConfigError(_nowhere(world, f"{key}.at.{number}", at))


def _nowhere(world: World, key: str, value: tuple[float, ...]) -> str:
    return (
        f"{world.source}: key {key!r}: a robot with {world.clearance:g} m around it does not fit "
        f"there, at {list(value)}; move it, or lower `clearance`."
    )
