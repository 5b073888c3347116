"""What a sensor model changes in a table that has just been baked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar import intensity_kernels
from nics_drl_bridge.lidar.sensor_models import Function, SensorModel, intensity_of, returned
from nics_drl_bridge.lidar.table import LidarTable

if TYPE_CHECKING:
    from nics_drl_bridge.lidar.baking import Grid


def apply_model(
    table: LidarTable, grids: Sequence[Grid], model: Function | Sequence[SensorModel]
) -> LidarTable:
    """The table as the device sees it; the rows of the given one are overwritten.

    Args:
        table: without a model.
        grids: (H,) the cells of each of its shapes.
        model: named models, all of which act, or a function of the ranges of one row and the
            angles of incidence.

    Returns:
        The table, with a reflectance if the model yields intensities.
    """
    cosines = _cosines(table, grids)
    if callable(model):
        _apply_function(model, table, cosines)
        return table
    bright = intensity_of(model)
    reflectance = None if bright is None else np.zeros(table.rows.shape, np.float32)
    ends = _ends(table)
    for shape, (first, last) in zip(table.shapes, table.cells_of_shapes(), strict=True):
        part = slice(int(table.start[first]), int(ends[last - 1]))
        cosine = cosines[part].astype(np.float64)
        table.rows[part] = returned(model, table.rows[part], np.arccos(cosine), shape.reflectivity)
        if bright is not None and reflectance is not None:
            reflectance[part] = bright.reflectance(cosine, shape.reflectivity)
    return replace(table, sensor_model=tuple(model), reflectance=reflectance)


def _ends(table: LidarTable) -> NDArray[np.int64]:
    """(cells,) where each row ends in `rows`."""
    return table.start + table.widths * table.density.phases


def _cosines(table: LidarTable, grids: Sequence[Grid]) -> NDArray[np.float32]:
    """(R,) cosine of the angle between each ray and the normal of what it meets, in [0, 1]."""
    cosines, outlines = np.zeros(table.rows.shape, np.float32), table.outlines
    for h, (grid, (first, _)) in enumerate(zip(grids, table.cells_of_shapes(), strict=True)):
        corners = outlines.corners[outlines.corner[h] : outlines.corner[h + 1]]
        for t, turn in enumerate(grid.turns):
            begin = first + t * table.density.distances
            starts = table.start[begin : begin + table.density.distances].astype(np.int64)
            intensity_kernels.cosines_of_turn(
                cosines,
                np.stack([starts, grid.cell[t, :, 0], grid.cell[t, :, 1]]),
                (corners, outlines.radii[h]),
                grid.distances,
                turn,
                grid.edges[t],
                table.beam_angle,
                table.density.phases,
            )
    return np.minimum(cosines, np.float32(1.0))


def _apply_function(model: Function, table: LidarTable, cosines: NDArray[np.float32]) -> None:
    """Changes every row by a function, which is given its points in the order of their angles."""
    phases = table.density.phases
    for begin, end in zip(table.start, _ends(table), strict=True):
        part, cosine = (a[begin:end].reshape(phases, -1).T.ravel() for a in (table.rows, cosines))
        changed = model(part, np.arccos(cosine.astype(np.float64)))
        table.rows[begin:end] = np.asarray(changed, np.float32).reshape(-1, phases).T.ravel()
