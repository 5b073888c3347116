"""GridMap: a static map of square cells, and what the lidar and the simulator ask of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from nics_drl_bridge.lidar import map_kernels

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
NO_MAP: tuple[NDArray[Any], NDArray[Any]] = (np.zeros((0, 0), np.uint32), np.zeros(0))
"""What the kernels take where there is no map."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """A static map. Cells are solid squares or free; what is outside is free.

    Attributes:
        cells: (rows, columns) int8 as in `nav_msgs/OccupancyGrid`: 0 free, 100 occupied, -1
            unknown, else how likely occupied [%]. Row 0 is the lowest y of the map, which is the
            last row of its image.
        resolution: side of a cell [m].
        origin: x [m], y [m], heading [rad] of the outer corner of cell (0, 0) in the world.
        unknown_stops: whether cells that are neither free nor occupied stop a beam.
        occupied_from: occupied are cells of this value and more; 100 as in Nav2's static layer.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unknown_stops: bool = False
    occupied_from: int = OCCUPIED

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """(rows, columns) cells that are known to be free."""
        return np.asarray(self.cells == FREE)

    @cached_property
    def blocked(self) -> NDArray[np.bool_]:
        """(rows, columns) cells that stop a beam."""
        occupied = self.cells >= self.occupied_from
        return np.asarray(~self.free if self.unknown_stops else occupied)

    @cached_property
    def arrays(self) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
        """What `map_kernels` take as `map_arrays`; baked when first asked for."""
        x, y, heading = self.origin
        frame = np.array([x, y, np.cos(heading), np.sin(heading), self.resolution])
        return map_kernels.free_squares(self.blocked), frame

    def world_to_cell(self, points: ArrayLike) -> NDArray[np.int64]:
        """Row and column (..., 2) of points (..., 2) x, y [m]; may lie outside the map."""
        x, y, heading = self.origin
        d = np.asarray(points, dtype=np.float64) - (x, y)
        c, s = np.cos(heading), np.sin(heading)
        place = np.stack([c * d[..., 1] - s * d[..., 0], c * d[..., 0] + s * d[..., 1]], axis=-1)
        return np.floor(place / self.resolution).astype(np.int64)

    def cell_to_world(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Centres (..., 2) x, y [m] of cells (..., 2) row, column."""
        x, y, heading = self.origin
        place = (np.asarray(cells, dtype=np.float64) + 0.5) * self.resolution
        c, s = np.cos(heading), np.sin(heading)
        across, up = place[..., 1], place[..., 0]
        return np.stack([x + c * across - s * up, y + s * across + c * up], axis=-1)

    @cached_property
    def distance_field(self) -> NDArray[np.float32]:
        """(rows, columns) distance from each cell's centre to the nearest blocked square [m].

        Exact, 0 in blocked cells and `inf` where nothing is blocked. A disc around the centre
        touches nothing when its radius is less. Between centres the distance changes by no more
        than the way.
        """
        if not self.blocked.any():
            return np.full(self.cells.shape, np.inf, np.float32)
        rows, columns = self.cells.shape
        # At half the resolution, centres and corners are points of one lattice, and of a square
        # the point nearest to a lattice point is one too.
        clear = np.ones((2 * rows + 1, 2 * columns + 1), bool)
        at, to = np.nonzero(self.blocked)
        for down in range(3):
            for right in range(3):
                clear[2 * at + down, 2 * to + right] = False
        steps = ndimage.distance_transform_edt(clear)[1::2, 1::2]
        return np.asarray(steps * (self.resolution / 2.0), dtype=np.float32)

    def reachable(self, start: ArrayLike, radius: float) -> NDArray[np.bool_]:
        """Cells to whose centre a disc can move from a start, by way of free cells.

        It moves between centres of neighbouring cells (four each), and stays in the map.

        Args:
            start: (2,) x, y [m].
            radius: of the disc [m].

        Returns:
            (rows, columns), all False when the disc does not fit at the start's own cell.
        """
        fits = self.free & (self.distance_field > radius)
        row, column = self.world_to_cell(start)
        inside = 0 <= row < fits.shape[0] and 0 <= column < fits.shape[1]
        if not inside or not fits[row, column]:
            return np.zeros_like(fits)
        labels, _ = ndimage.label(fits)
        return np.asarray(labels == labels[row, column])
