"""Baking: every shape scanned beforehand, on the lidar's main axis (Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar import bake_kernels
from nics_drl_bridge.lidar.baked_kernels import BLOCK
from nics_drl_bridge.lidar.shapes import Circle, Outlines, Shape, describe
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import Density, LidarTable

TOUCHING = 1e-6
"""The nearest grid distance is this much more than the radius, as a part of it."""
DENSITY = Density()
SensorModel = Callable[[NDArray[np.float32], NDArray[np.float64]], NDArray[np.float32]]
"""Ranges (P,) [m] and angles of incidence (P,) [rad] to the ranges that the device reports."""
Progress = Callable[[int, int], None]
"""Called with how many rotations are done, and of how many."""


@dataclass(frozen=True)
class _Grid:
    """The cells of one shape: T rotations, D distances.

    Attributes:
        distances: (D,) [m].
        turns: (T,) [rad].
        edges: (T, D, 2) right and left edge of the shape [rad].
        cell: (T, D, 6) see `LidarTable.cell`.
    """

    distances: NDArray[np.float64]
    turns: NDArray[np.float64]
    edges: NDArray[np.float64]
    cell: NDArray[np.int64]


def bake(
    spec: LidarSpec,
    shapes: Sequence[Shape],
    density: Density = DENSITY,
    sensor_model: SensorModel | None = None,
    progress: Progress | None = None,
) -> LidarTable:
    """Scans shapes straight ahead, at a grid of distance and rotation, with the exact scanner.

    Args:
        spec: the lidar.
        shapes: H; equal ones are baked once.
        density: of the grid.
        sensor_model: what the device makes of ranges and incidence, `inf` where it sees nothing;
            it is baked in and costs nothing later. Such a beam goes through to what is behind.
        progress: told how far it is.

    Returns:
        The table.

    Raises:
        ConfigError: the table would be too large.
    """
    shapes = tuple(dict.fromkeys(shapes))
    outlines = Outlines.of(shapes)
    grids = [_grid(spec, outlines, h, density) for h in range(len(shapes))]
    cells = np.concatenate([np.zeros((0, 6), np.int64), *(g.cell.reshape(-1, 6) for g in grids)])
    ends = np.cumsum(cells[:, 1]) * density.phases
    if len(cells) and (ends[-1] + BLOCK > np.iinfo(np.int32).max or np.abs(cells).max() > 32_767):
        raise ConfigError(
            f"a lidar table of {len(cells)} cells with {spec.beams} beams is too large; lower "
            "`distances`, `rotations` or `phases`."
        )
    start = ends - cells[:, 1] * density.phases
    rows = np.zeros((int(ends[-1]) if len(cells) else 0) + BLOCK, np.float32)
    total, done, first = sum(len(grid.turns) for grid in grids), 0, []
    for h, grid in enumerate(grids):
        first.append(sum(g.cell.shape[0] * g.cell.shape[1] for g in grids[:h]))
        for t in range(len(grid.turns)):
            begin = first[h] + t * density.distances
            starts = start[begin : begin + density.distances]
            _rows_of_turn(rows, starts, grid, t, outlines, h, spec, density.phases)
            done += 1
            if progress is not None:
                progress(done, total)
    if sensor_model is not None:
        _apply(sensor_model, rows, start, cells, spec, density.phases)
    about = [(g.distances[-1], len(g.turns), f) for g, f in zip(grids, first, strict=True)]
    return LidarTable(
        shapes,
        density,
        np.array(about, dtype=np.float64).reshape(-1, 3),
        start.astype(np.int32),
        cells.astype(np.int16),
        rows,
    )


def with_shapes(spec: LidarSpec, table: LidarTable, shapes: Sequence[Shape]) -> LidarTable:
    """The table itself if it holds all of these shapes, or one of the same density that does."""
    if set(shapes) <= set(table.shapes):
        return table
    return bake(spec, (*table.shapes, *shapes), table.density)


def _grid(spec: LidarSpec, outlines: Outlines, h: int, density: Density) -> _Grid:
    """Where the cells of a shape lie and how wide their rows are."""
    shape, radius, order = outlines.shapes[h], outlines.radii[h], outlines.orders[h]
    distances = np.linspace(radius, spec.range_max + radius, density.distances)
    distances[0] *= 1.0 + TOUCHING
    round_ = isinstance(shape, Circle)
    count = 1 if round_ else max(1, -(-density.rotations // order))
    unit = 2.0 * np.pi / (count * order)
    hull = outlines.hulls[outlines.hull[h] : (outlines.hull[h] + outlines.hull[h + 1]) // 2]
    halves = np.arange(-1, 2 * count) * unit / 2.0  # also between the grid's rotations
    edges = np.zeros((len(halves), density.distances, 2))
    hints = np.zeros(edges.shape, np.int64)
    bake_kernels.silhouettes(hull, radius if round_ else 0.0, distances, halves, edges, hints)
    cell = np.zeros((count, density.distances, 6), np.int64)
    low = _around(edges[..., 0], np.minimum) / spec.angle_increment
    high = _around(edges[..., 1], np.maximum) / spec.angle_increment
    cell[..., 0] = np.floor(low - 0.5)
    cell[..., 1] = np.ceil(high + 0.5) - cell[..., 0] + 1
    for side in (0, 1):
        cell[..., 2 + 2 * side], cell[..., 3 + 2 * side] = _candidates(hints[..., side])
    if cell[..., 1].max() > 32_767:
        raise ConfigError(f"{describe(shape)} with {spec.beams} beams: too many beams to bake.")
    return _Grid(distances, np.arange(count) * unit, edges[1::2], cell)


def _around(edge: NDArray[np.float64], outer: np.ufunc) -> NDArray[np.float64]:
    """(T, D) the outermost edge until the next cells, from edges (2 T + 1, D) at half steps."""
    turned = outer(outer(edge[:-1:2], edge[1::2]), edge[2::2])
    result = turned.copy()
    result[:, 1:] = outer(result[:, 1:], turned[:, :-1])
    result[:, :-1] = outer(result[:, :-1], turned[:, 1:])
    return np.asarray(result)


def _candidates(hints: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(T, D) twice: two corners that can be an edge in a cell, from those at its four corners."""
    later = np.concatenate([hints[:, 1:], hints[:, -1:]], axis=1)
    before, after = hints[:-1:2], hints[2::2]
    other = np.where(after != before, after, later[:-1:2])
    other = np.where(other != before, other, later[2::2])
    return before, other


def _rows_of_turn(
    rows: NDArray[np.float32],
    starts: NDArray[np.int64],
    grid: _Grid,
    t: int,
    outlines: Outlines,
    h: int,
    spec: LidarSpec,
    phases: int,
) -> None:
    corners = outlines.corners[outlines.corner[h] : outlines.corner[h + 1]]
    bake_kernels.rows_of_turn(
        rows,
        np.stack([starts, grid.cell[t, :, 0], grid.cell[t, :, 1]]),
        (corners, outlines.radii[h]),
        grid.distances,
        grid.turns[t],
        grid.edges[t],
        spec.angle_increment,
        phases,
    )


def _apply(
    sensor_model: SensorModel,
    rows: NDArray[np.float32],
    start: NDArray[np.int64],
    cells: NDArray[np.int64],
    spec: LidarSpec,
    phases: int,
) -> None:
    """Changes every row by the sensor model; incidence follows from r' / r along the row."""
    for begin, width in zip(start, cells[:, 1], strict=True):
        part = rows[begin : begin + width * phases]
        fine = part.reshape(phases, width).T.ravel()
        slope = np.gradient(fine.astype(np.float64), spec.angle_increment / phases)
        changed = sensor_model(fine, np.arctan2(np.abs(slope), fine))
        part[:] = np.asarray(changed, np.float32).reshape(width, phases).T.ravel()
