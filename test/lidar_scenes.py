"""Random shapes and scenes for the lidar's tests, and the ranges that plane geometry gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from nics_drl_bridge import geometry
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import SKEW
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Segment, Shape
from nics_drl_bridge.lidar.spec import LidarSpec

CORNER = 1e-4
"""Beams that pass a corner this closely [m] are left out of comparisons."""
TANGENT = 3e-3
"""The same for the rim of a circle, which the oracle knows as a polygon only."""


@dataclass(frozen=True)
class Scene:
    """A robot, shapes (K,) at poses (K, 3), and walls (W, 4)."""

    robot: np.ndarray
    shapes: tuple[Shape, ...]
    poses: np.ndarray
    walls: np.ndarray


def convex(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """Corners on a circle, at random angles."""
    angles = np.sort(rng.uniform(-np.pi, np.pi, corners))
    return Polygon(points=reach * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def star(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """Concave, seen whole from its origin."""
    angles = np.sort(rng.uniform(-np.pi, np.pi, corners))
    radii = rng.uniform(0.2, 1.0, (corners, 1)) * reach
    return Polygon(points=radii * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def tangled(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """Corners in any order: the outline crosses itself."""
    return Polygon(points=rng.uniform(-reach, reach, (corners, 2)))


def thin(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """A sliver."""
    return Polygon(points=convex(rng, corners, reach).outline * [1.0, 0.004])


def off_centre(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """Its origin lies outside of it."""
    return Polygon(
        points=star(rng, corners, reach / 2.0).outline + np.array([0.6 * reach, 0])
    )


def clockwise(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """The other way round."""
    return Polygon(points=star(rng, corners, reach).outline[::-1])


def ring(rng: np.random.Generator, corners: int, reach: float = 0.4) -> Polygon:
    """A letter C: nearly closed around its origin."""
    angles = np.linspace(0.3, 2.0 * np.pi - 0.3, max(corners // 2, 2))
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Polygon(points=np.concatenate([reach * arc, 0.8 * reach * arc[::-1]]))


POLYGONS = (convex, star, tangled, thin, off_centre, clockwise, ring)
CORNERS = (3, 4, 5, 8, 20, 100)


def random_shapes(seed: int) -> tuple[Shape, ...]:
    """One of each kind."""
    rng = np.random.default_rng(seed)
    polygons = [make(rng, int(rng.choice(CORNERS))) for make in POLYGONS]
    return (
        Circle(radius=rng.uniform(0.05, 0.4)),
        Rectangle(size=tuple(rng.uniform(0.05, 0.8, 2))),
        Rectangle(size=(0.6, 0.06)),
        Segment(ends=rng.uniform(-0.4, 0.4, (2, 2))),
        *polygons,
    )


def random_scene(seed: int, shapes: tuple[Shape, ...], far: float = 0.0) -> Scene:
    """Six of the shapes and two walls around a robot, which may stand inside of some."""
    rng = np.random.default_rng(seed)
    origin = np.array([*rng.uniform(-1.0, 1.0, 2) * far, 0.0])
    spread = [2.6, 2.6, 0.0]
    turn = [0.0, 0.0, np.pi]
    robot = origin + rng.uniform(-1.0, 1.0, 3) * ([0.5, 0.5, np.pi])
    poses = origin + rng.uniform(-1.0, 1.0, (6, 3)) * np.add(spread, turn)
    chosen = tuple(shapes[i] for i in rng.integers(len(shapes), size=6))
    walls = np.tile(origin[:2], 2) + rng.uniform(-3.5, 3.5, (2, 4))
    return Scene(robot, chosen, poses, walls)


def poses_around(rng: np.random.Generator, distance: np.ndarray) -> np.ndarray:
    """Poses (..., 3) at distances (...) from the origin, in random directions."""
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, *np.shape(distance)))
    x = distance * np.cos(bearing)
    y = distance * np.sin(bearing)
    return np.stack([x, y, heading], axis=-1)


def solid_of(shape: Shape, pose: np.ndarray) -> shapely.Geometry:
    """A shape at a pose (3,); of a circle the centre, whose radius is to be subtracted."""
    if isinstance(shape, Circle):
        return shapely.Point(pose[:2])
    corners = geometry.rotate(shape.outline, pose[2]) + pose[:2]
    make = shapely.LineString if len(corners) == 2 else shapely.Polygon
    return make(corners)


def placed(shape: Shape, pose: np.ndarray) -> tuple[shapely.Geometry, np.ndarray]:
    """The outline of a shape at a pose, and its corners (V, 2)."""
    if isinstance(shape, Circle):
        rim = shapely.Point(pose[:2]).buffer(shape.radius, quad_segs=64).exterior
        return rim, np.zeros((0, 2))
    points = np.array(
        getattr(shape, "points", shape.outline)
    )  # in the user's own order
    corners = pose[:2] + geometry.rotate(points, pose[2])
    if isinstance(shape, Segment):
        return shapely.LineString(corners), corners
    return shapely.LineString([*corners, corners[0]]), corners


def by_plane_geometry(spec: LidarSpec, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (B,) by a library of plane geometry, and which of them are fit for comparison."""
    sensor = geometry.compose(scene.robot, spec.mount)
    outlines = [
        placed(shape, pose)
        for shape, pose in zip(scene.shapes, scene.poses, strict=True)
    ]
    walls = scene.walls.reshape(-1, 2, 2)
    corners = (
        np.concatenate([*(c for _, c in outlines), walls.reshape(-1, 2)]) - sensor[:2]
    )
    moved = [
        shapely.transform(outline, lambda xy: xy - sensor[:2])
        for outline in (*(o for o, _ in outlines), *shapely.linestrings(walls))
    ]
    angles = sensor[2] + spec.angles
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = directions * (spec.range_max + 1.0)
    rays = shapely.linestrings(np.stack([np.zeros_like(ends), ends], axis=1))
    tree = shapely.STRtree(moved)
    ray, hit = tree.query(rays, predicate="intersects")
    crossing = shapely.intersection(rays[ray], np.array(moved, dtype=object)[hit])
    ranges = np.full(spec.beams, np.inf)
    np.minimum.at(ranges, ray, shapely.distance(shapely.Point(0.0, 0.0), crossing))

    along = directions @ corners.T
    across = directions[:, :1] * corners[:, 1] - directions[:, 1:] * corners[:, 0]
    clear = ~((np.abs(across) < CORNER) & (along > -CORNER)).any(axis=1)
    for shape, pose in zip(scene.shapes, scene.poses, strict=True):
        if isinstance(shape, Circle):
            x, y = pose[:2] - sensor[:2]
            clear &= np.abs(np.abs(directions @ [-y, x]) - shape.radius) > TANGENT
    for limit in (spec.range_min, spec.range_max):
        clear &= np.abs(ranges - limit) > 1e-3
    ranges[ranges > spec.range_max] = np.inf
    ranges[ranges < spec.range_min] = -np.inf
    return ranges, clear


def slice_poses(
    pose, twist, sweep_time: float, slices: int, skew: str, moving: float = np.inf
) -> np.ndarray:
    """Poses (G, 3) of a robot during a sweep that ends at `pose`, with a body twist (3,).

    It has been `moving` for so long [s].
    """
    out = np.empty((slices, 3))
    fault_kernels.slice_poses(
        out, np.asarray(pose), np.asarray(twist), sweep_time, SKEW[skew], moving
    )
    out[:, 2] = geometry.wrap_angle(out[:, 2])
    return out


def scan_skewed(render, poses: np.ndarray) -> np.ndarray:
    """A scan (B,) by `render` in G equal groups of beams, each from its pose (G, 3)."""
    scans = [render(pose) for pose in poses]
    edges = np.arange(len(poses) + 1) * len(scans[0]) // len(poses)
    return np.concatenate(
        [scans[g][edges[g] : edges[g + 1]] for g in range(len(poses))]
    )
