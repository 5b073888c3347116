"""One call for a batch of scans, exact or baked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.lidar import kernels
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import LidarTable, bake

Renderer = Literal["baked", "exact"]
RENDERERS: tuple[Renderer, ...] = ("baked", "exact")


@dataclass(frozen=True)
class Scanner:
    """A lidar with its table, ready to scan.

    Attributes:
        spec: the lidar.
        table: for the baked renderer.
        renderer: `baked` looks circles up; `exact` computes every ray. Walls are exact in
            both: a straight wall costs no more than a row of a table.
    """

    spec: LidarSpec
    table: LidarTable
    renderer: Renderer = "baked"

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What the kernels take as `sensor`.

        Mount (3,), directions (B, 2), beams (angle_min, angle_increment, 1 for a full circle),
        limits (range_min, range_max), whether circles are looked up, the table's arrays.
        """
        spec = self.spec
        beams = np.array([spec.angle_min, spec.angle_increment, float(spec.full_circle)])
        limits = np.array([spec.range_min, spec.range_max])
        baked = self.renderer == "baked"
        return np.array(spec.mount), spec.directions, beams, limits, baked, self.table.lookup

    def scan(self, poses: ArrayLike, circles: ArrayLike, walls: ArrayLike) -> NDArray[np.float32]:
        """Scans of several robots, each in a world of its own.

        Args:
            poses: (N, 3) of `base_link` in the world.
            circles: (N, K, 3) x, y, radius [m]; a radius of 0 is no circle.
            walls: (W, 4) x1, y1, x2, y2 [m], the same in every world.

        Returns:
            (N, B) ranges [m]: `inf` no return, `-inf` too close (REP-117).
        """
        poses = np.atleast_2d(np.asarray(poses, dtype=np.float64))
        shaped = self.with_shapes(np.asarray(circles, dtype=np.float64).reshape(len(poses), -1, 3))
        walls = np.asarray(walls, dtype=np.float64).reshape(-1, 4)
        out = np.empty((len(poses), self.spec.beams), np.float32)
        _scan_batch(out, poses, shaped, walls, self.arguments)
        return out

    def with_shapes(self, circles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Circles (..., 3) with the index of their radius in the table behind: (..., 4)."""
        shape = np.zeros(circles.shape[:-1])
        if self.renderer == "baked":
            for radius in np.unique(circles[..., 2]):
                if radius > 0.0:
                    shape[circles[..., 2] == radius] = self.table.shape_of(float(radius))
        return np.concatenate([circles, shape[..., None]], axis=-1)


def make_scanner(
    spec: LidarSpec, radii: tuple[float, ...], renderer: Renderer = "baked"
) -> Scanner:
    """A scanner with a table for circles of the given radii, baked now."""
    return Scanner(spec, bake(spec, radii), renderer)


@njit(cache=True)
def _scan_batch(out, poses, circles, walls, sensor):  # type: ignore[no-untyped-def]
    for n in range(poses.shape[0]):
        kernels.scan(out[n], poses[n], circles[n], walls, sensor)
