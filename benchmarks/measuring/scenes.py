"""The paper's four scenes (Sec. V-B), and what a renderer gets wrong in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle, Rectangle, Shape
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.lidar.table import LidarTable

Ranges = NDArray[np.float32]
CIRCLE = Circle(radius=0.15)
SCENES: dict[str, tuple[Shape, ...]] = {
    "circle": (CIRCLE,),
    "square": (SQUARE,),
    "strip": (STRIP,),
    "mixture": (CIRCLE, SQUARE, STRIP),
}
OBSTACLES = 10
BATCH = 1024
SPEC = load_lidar("paper")


@dataclass(frozen=True)
class Batch:
    """Some scans, each of obstacles of its own around a lidar that stands in the middle.

    Attributes:
        shapes: K, one for each obstacle of a scan.
        poses: (N, K, 3) x, y [m], heading [rad] of the obstacles.
        lidar: (N, 3) the same for the lidar: all zero.
    """

    shapes: tuple[Shape, ...]
    poses: Array
    lidar: Array

    def bodies(self, scanner: Scanner) -> Array:
        """(N, K, 7) the obstacles, placed."""
        return scanner.place(self.shapes, self.poses)


def batches(shapes: Sequence[Shape], scans: int, spec: LidarSpec = SPEC) -> list[Batch]:
    """As many scans in batches of `BATCH`, each batch from a seed of its own."""
    return [
        random_batch(shapes, min(BATCH, scans - first), seed, spec)
        for seed, first in enumerate(range(0, scans, BATCH))
    ]


def random_batch(
    shapes: Sequence[Shape],
    scans: int,
    seed: int,
    spec: LidarSpec = SPEC,
) -> Batch:
    """Obstacles anywhere within the lidar's range, none of them nearer than its least one.

    They may overlap each other, and take turns when there are several shapes.
    """
    rng = np.random.default_rng([2024, seed])
    shapes = tuple(shapes[k % len(shapes)] for k in range(OBSTACLES))
    poses = np.empty((scans, OBSTACLES, 3))
    for k, shape in enumerate(shapes):
        wanting = np.arange(scans)
        while len(wanting):
            far = spec.range_max * np.sqrt(rng.random(len(wanting)))
            bearing, heading = rng.uniform(-np.pi, np.pi, (2, len(wanting)))
            poses[wanting, k] = np.stack(
                [far * np.cos(bearing), far * np.sin(bearing), heading], axis=1
            )
            wanting = wanting[gap(shape, poses[wanting, k]) <= spec.range_min]
    return Batch(shapes, poses, np.zeros((scans, 3)))


def gap(shape: Shape, poses: Array) -> Array:
    """(N,) from the lidar at the origin to a shape at (N, 3); a polygon counts as its circle."""
    if not isinstance(shape, Rectangle):
        return np.hypot(poses[:, 0], poses[:, 1]) - shape.radius
    x, y, heading = poses.T
    along = np.abs(np.cos(heading) * x + np.sin(heading) * y) - shape.size[0] / 2.0
    across = np.abs(np.cos(heading) * y - np.sin(heading) * x) - shape.size[1] / 2.0
    return np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))


def scan(
    table: LidarTable, renderer: Renderer, batch: Batch, spec: LidarSpec = SPEC
) -> Ranges:
    """(N, B) ranges of a batch."""
    scanner = Scanner(spec, table, renderer)
    return scanner.scan(batch.lidar, batch.bodies(scanner))


def nearest_row(batch: Batch, table: LidarTable, spec: LidarSpec = SPEC) -> Batch:
    """The batch as a plain look-up sees it (Sec. IV-B): every obstacle on the nearest grid point.

    That is the nearest distance and the nearest rotation of the table, and the nearest whole
    beam as the bearing. An exact scan of it is what looking the nearest rows up and fusing
    them gives. An obstacle whose circle holds the lidar is beyond the tables: it stays.
    """
    poses = batch.poses.copy()
    for k, shape in enumerate(batch.shapes):
        x, y, heading = batch.poses[:, k].T
        h = table.outlines.index_of(shape)
        grid = np.linspace(shape.radius, table.grid[h, 0], table.density.distances)
        distance = np.hypot(x, y)
        bearing = np.arctan2(y, x)
        step = grid[1] - grid[0]
        turn = 2.0 * np.pi / table.density.rotations
        row = np.clip(np.rint((distance - grid[0]) / step), 0, len(grid) - 1).astype(
            int
        )
        beam = np.rint((bearing - spec.angle_min) / spec.angle_increment)
        to = spec.angle_min + beam * spec.angle_increment
        rotation = np.rint((heading - bearing) / turn) * turn
        far = np.maximum(
            grid[row], shape.radius * (1.0 + 1e-6)
        )  # a lidar outside of it
        moved = np.stack([far * np.cos(to), far * np.sin(to), to + rotation], axis=1)
        poses[:, k] = np.where((distance < shape.radius)[:, None], poses[:, k], moved)
    return Batch(batch.shapes, poses, batch.lidar)


def errors(
    found: Sequence[Ranges], exact: Sequence[Ranges], spec: LidarSpec = SPEC
) -> tuple[float, float]:
    """RMSE of the range over all beams [m] and of the area over all scans [m^2]."""
    a, b = (filled(np.concatenate(list(each)), spec) for each in (found, exact))
    areas = 0.5 * spec.angle_increment * ((a**2).sum(axis=1) - (b**2).sum(axis=1))
    return float(np.sqrt(((a - b) ** 2).mean())), float(np.sqrt((areas**2).mean()))


def filled(ranges: Ranges, spec: LidarSpec = SPEC) -> Array:
    """Ranges with the limits in place of `inf` (no return) and `-inf` (too close)."""
    return np.clip(ranges.astype(np.float64), spec.range_min, spec.range_max)
