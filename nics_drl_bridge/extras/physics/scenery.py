"""A world as solids that every physics engine supports: upright boxes, cylinders, convex prisms."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import (
    Circle,
    Rectangle,
    Segment,
    Shape,
    find_convex_hull,
)
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.sim.world import World

HEIGHT = 0.5  # height of walls and obstacles [m]
WALL_THICKNESS = 0.002  # thickness of walls [m]; for the lidar they have none
BUMPER_FRICTION = 0.3
SLIVER = 1e-9  # minimum area of a triangle, relative to the outline's size squared


@dataclass(frozen=True)
class Box:
    """An upright box."""

    middle: Array  # (2,) x, y [m]
    heading: float  # [rad]
    size: tuple[float, float]  # length and width [m]

    @property
    def corners(self) -> Array:
        """(4, 2) [m]."""
        signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        return self.middle + geometry.rotate(
            0.5 * signs * np.array(self.size), self.heading
        )


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder around the origin."""

    radius: float  # [m]


@dataclass(frozen=True)
class Prism:
    """An upright prism."""

    corners: Array  # (V, 2) of a convex outline [m]


Solid = Box | Cylinder | Prism


@dataclass(frozen=True)
class Obstacle:
    """An obstacle of a scene."""

    number: int  # row of the scene's bodies
    shape: Shape
    pose: Array  # (3,) x [m], y [m], heading [rad]
    moves: bool


def cut_world(world: World) -> Iterator[Box]:
    """Yields the walls and the map of a world."""
    for wall in world.all_walls():
        yield _make_wall(wall[:2], wall[2:])
    if world.grid is not None:
        yield from _cut_map(world.grid)


def cut_shape(shape: Shape) -> list[Solid]:
    """Returns the solids of a shape in its own frame."""
    if isinstance(shape, Circle):
        return [Cylinder(shape.radius)]
    if isinstance(shape, Rectangle):
        return [Box(np.zeros(2), 0.0, shape.size)]
    if isinstance(shape, Segment):
        return [_make_wall(*shape.outline)]
    return [Prism(part) for part in split_convex(shape.outline)]


def _make_wall(start: Array, end: Array) -> Box:
    along = end - start
    heading = float(np.arctan2(along[1], along[0]))
    return Box(0.5 * (start + end), heading, (float(np.hypot(*along)), WALL_THICKNESS))


def _cut_map(grid: GridMap) -> Iterator[Box]:
    side = grid.resolution
    for first_row, first, row, column in merge_into_rectangles(grid.blocked):
        middle = grid.cell_to_world(
            [0.5 * (first_row + row - 1), 0.5 * (first + column - 1)]
        )
        size = (side * (column - first), side * (row - first_row))
        yield Box(middle, grid.origin[2], size)


def aim_beams(lidar: LidarSpec, pose: Array, height: float) -> tuple[Array, Array]:
    """Returns start (3,) and ends (B, 3) of rays at a height, from a robot's pose [m]."""
    x, y, heading = geometry.compose(pose, np.array(lidar.mount))
    start = np.array([x, y, height])
    ends = np.full((lidar.beams, 3), height)
    ends[:, :2] = [x, y] + lidar.range_max * geometry.rotate(lidar.directions, heading)
    return start, ends


def make_scan(lidar: LidarSpec, fractions: ArrayLike) -> Singles:
    """Returns ranges (B,) [m], REP-117, of rays that end at fractions (B,); inf: without a hit."""
    ranges = lidar.range_max * np.asarray(fractions)
    ranges[ranges < lidar.range_min] = -np.inf
    return ranges.astype(np.float32)


def split_convex(outline: Array) -> list[Array]:
    """Splits an outline (V, 2) into convex ones; uses ear clipping (Meisters 1975) if needed."""
    if len(find_convex_hull(outline)) == len(outline):
        return [outline]
    rest = list(range(len(outline)))
    parts = []
    minimum_area = SLIVER * float(np.ptp(outline, axis=0).max()) ** 2
    while len(rest) > 3:
        at = next((i for i in range(len(rest)) if _is_ear(outline, rest, i)), 0)
        parts.append(outline[[rest[at - 1], rest[at], rest[(at + 1) % len(rest)]]])
        del rest[at]
    parts.append(outline[rest])
    return [part for part in parts if _compute_area(*part) > minimum_area]


def _compute_area(a: Array, b: Array, c: Array) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _is_ear(outline: Array, rest: list[int], i: int) -> bool:
    before = rest[i - 1]
    here = rest[i]
    after = rest[(i + 1) % len(rest)]
    a = outline[before]
    b = outline[here]
    c = outline[after]
    if _compute_area(a, b, c) <= 0.0:
        return False
    others = (outline[k] for k in rest if k not in (before, here, after))
    return not any(
        min(_compute_area(a, b, p), _compute_area(b, c, p), _compute_area(c, a, p))
        >= 0.0
        for p in others
    )


def merge_into_rectangles(blocked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns rectangles (R, 4) of blocked cells: first row, first column, last ones + 1."""
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row, cells in enumerate(np.pad(blocked, ((0, 1), (1, 1)))):
        edges = np.flatnonzero(cells[1:] != cells[:-1]).reshape(-1, 2)
        runs = {(int(first), int(after)) for first, after in edges}
        for run in open_runs.keys() - runs:
            done.append((open_runs.pop(run), run[0], row, run[1]))
        for run in runs:
            open_runs.setdefault(run, row)
    return np.array(sorted(done), dtype=np.int64).reshape(-1, 4)
