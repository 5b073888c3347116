"""Baked lidar tables: every circle scanned beforehand, at every distance (Sec. IV-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import npz_arrays, npz_bytes
from nics_drl_bridge.lidar import kernels
from nics_drl_bridge.lidar.spec import LidarSpec

DISTANCES = 200
FINE = 4


@dataclass(frozen=True)
class LidarTable:
    """The ranges that circles give, as rows over angle, for a grid of distances.

    A circle looks the same from all sides, so its own rotation needs no rows. A row holds
    only the directions that hit, at `FINE` points per beam, around the bearing of the circle.

    Attributes:
        radii: (H,) radius of each circle [m], ascending.
        grid: (H, 3) nearest distance [m], step [m], number of distances.
        rows: (R,) float32 ranges [m], all rows one after the other.
        first: (H, distances) int32 offset of a row's first point from the bearing [points].
        start: (H, distances + 1) int64 where each row begins in `rows`.
    """

    radii: NDArray[np.float64]
    grid: NDArray[np.float64]
    rows: NDArray[np.float32]
    first: NDArray[np.int32]
    start: NDArray[np.int64]

    def shape_of(self, radius: float) -> int:
        """Index of a radius. Raises ModelError when it was not baked."""
        found = np.flatnonzero(np.abs(self.radii - radius) < 1e-9)
        if not len(found):
            raise ModelError(
                f"a circle of radius {radius} m is not in the lidar table "
                f"(it holds {', '.join(f'{r:g}' for r in self.radii)} m); generate the model for "
                "this world."
            )
        return int(found[0])

    @property
    def lookup(self) -> tuple[object, ...]:
        """The arrays in the order that the kernel takes."""
        return self.grid, self.rows, self.first, self.start, FINE

    @property
    def memory(self) -> int:
        """Memory of the table [bytes]."""
        return sum(a.nbytes for a in (self.radii, self.grid, self.rows, self.first, self.start))

    def dump(self) -> bytes:
        """The table as the content of an `.npz` file."""
        return npz_bytes(vars(self))

    @classmethod
    def parse(cls, data: bytes, source: str) -> LidarTable:
        """Reads what `dump` wrote. Raises ModelError with the file's name otherwise."""
        try:
            return cls(**npz_arrays(data))
        except (ValueError, TypeError) as error:
            raise ModelError(
                f"{source}: is no lidar table ({error}); generate the model anew."
            ) from None


def bake(spec: LidarSpec, radii: tuple[float, ...], distances: int = DISTANCES) -> LidarTable:
    """Scans circles on the lidar's main axis, at a grid of distances, with the exact scanner.

    Args:
        spec: the lidar.
        radii: of the circles [m].
        distances: how many, from touching the circle to out of range.

    Returns:
        The table.
    """
    ordered = np.unique(np.asarray(radii, dtype=np.float64))
    grid, first = np.zeros((len(ordered), 3)), np.zeros((len(ordered), distances), np.int32)
    start = np.zeros((len(ordered), distances + 1), np.int64)
    rows: list[NDArray[np.float32]] = []
    filled = 0
    for h, radius in enumerate(ordered):
        at = np.linspace(radius, spec.range_max + radius, distances)
        grid[h] = at[0], at[1] - at[0], distances
        for d, distance in enumerate(at):
            first[h, d], row = _scan_on_axis(spec, radius, max(distance, radius * (1 + 1e-6)))
            rows.append(row)
            start[h, d], filled = filled, filled + len(row)
        start[h, distances] = filled
    return LidarTable(ordered, grid, np.concatenate([*rows, np.empty(0, np.float32)]), first, start)


def _scan_on_axis(
    spec: LidarSpec, radius: float, distance: float
) -> tuple[int, NDArray[np.float32]]:
    """The points that hit a circle straight ahead: offset of the first, and their ranges."""
    step = spec.angle_increment / FINE
    half = int(np.arcsin(min(radius / distance, 1.0)) / step + 1e-6)
    angles = np.arange(-half, half + 1) * step
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    out = np.full(len(angles), np.inf, np.float32)
    beams = np.array([angles[0], step, 0.0])
    kernels.circle(out, directions, beams, distance, 0.0, radius, np.inf)
    hits = np.flatnonzero(np.isfinite(out))
    if not len(hits):
        return 0, out[:0]
    return int(hits[0]) - half, out[hits[0] : hits[-1] + 1]
