"""Baking: scans of every shape on the lidar's main axis, stored in a table (Sec. IV-B).

Application of a sensor model to a freshly baked table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar import bake_kernels
from nics_drl_bridge.lidar.sensor_models import Function, SensorModel, returned
from nics_drl_bridge.lidar.shapes import Circle, Outlines, Shape, describe
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import MOST_WIDE, Density, LidarTable, padding

if TYPE_CHECKING:
    pass

TOUCHING = 1e-6
"""Excess of the nearest grid distance over the radius, as a share of the radius."""
COARSE = np.radians(2.0)
"""Shapes are evaluated between grid rotations in steps of at most half of this [rad]."""
MOST_NUMBERS = 2**31 - 2**20
FIRST_BEAM = -(2**15)
"""Least first beam of a row, relative to the bearing."""
MISS = 0.02
"""An edge that two corners would miss by more than this [beams] is found by climbing the hull."""
Progress = Callable[[int, int], None]
"""Called with the number of rotations done and their total."""


@dataclass(frozen=True)
class Grid:
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
    density: Density | None = None,
    sensor_model: Function | Sequence[SensorModel] | None = None,
    progress: Progress | None = None,
) -> LidarTable:
    """Scans shapes straight ahead, on a grid of distances and rotations, with the exact scanner.

    Args:
        spec: the lidar.
        shapes: H; equal ones are baked once.
        density: of the grid; by default `Density.for_beams`.
        sensor_model: by default that of the lidar; named models, see `sensor_models`, or a
            function of ranges and incidence that returns `inf` where the device gets no return. It
            is baked in and has no run-time cost. Such a beam passes through to objects behind.
        progress: called after each rotation.

    Returns:
        The table.

    Raises:
        ConfigError: the table would be too large, or a shape covers too many beams.
    """
    shapes = tuple(dict.fromkeys(shapes))
    density = density or Density.for_beams(spec.angle_increment)
    outlines = Outlines.of(shapes)
    grids = [grid_of(spec, outlines, h, density) for h in range(len(shapes))]
    cells = np.concatenate([np.zeros((0, 6), np.int64), *(g.cell.reshape(-1, 6) for g in grids)])
    ends = np.cumsum(cells[:, 1]) * density.phases
    if len(cells) and ends[-1] > MOST_NUMBERS:
        raise ConfigError(
            f"a lidar table of {len(cells)} cells with {spec.beams} beams is too large; lower "
            "`distances`, `rotations` or `phases`."
        )
    start = ends - cells[:, 1] * density.phases
    rows = np.zeros(
        (int(ends[-1]) if len(cells) else 0) + padding(spec.angle_increment), np.float32
    )
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
    about = [(g.distances[-1], len(g.turns), f) for g, f in zip(grids, first, strict=True)]
    table = LidarTable(
        shapes,
        density,
        spec.angle_increment,
        np.array(about, dtype=np.float64).reshape(-1, 3),
        start.astype(np.int32),
        cells.astype(np.int16),
        rows,
    )
    model = spec.sensor_model if sensor_model is None else sensor_model
    return apply_model(table, grids, model) if callable(model) or model else table


def with_shapes(spec: LidarSpec, table: LidarTable, shapes: Sequence[Shape]) -> LidarTable:
    """Returns the table if it contains all of these shapes, or else one of equal density."""
    if set(shapes) <= set(table.shapes):
        return table
    if not table.has_rows:
        return LidarTable.without_rows(spec, (*table.shapes, *shapes))
    return bake(spec, (*table.shapes, *shapes), table.density, table.sensor_model)


def grid_of(spec: LidarSpec, outlines: Outlines, h: int, density: Density) -> Grid:
    """Computes the cells of a shape and the widths of their rows."""
    shape, radius, order = outlines.shapes[h], outlines.radii[h], outlines.orders[h]
    distances = np.linspace(radius, spec.range_max + radius, density.distances)
    distances[0] *= 1.0 + TOUCHING
    round_ = isinstance(shape, Circle)
    count = 1 if round_ else max(1, -(-density.rotations // order))
    unit = 2.0 * np.pi / (count * order)
    hull = outlines.hulls[outlines.hull[h] : (outlines.hull[h] + outlines.hull[h + 1]) // 2]
    parts = 2 * max(1, math.ceil(unit / COARSE))
    turns = np.arange(-parts // 2, parts * count - parts // 2 + 1) * unit / parts
    edges = np.zeros((len(turns), density.distances, 2))
    hints = np.zeros(edges.shape, np.int64)
    bake_kernels.silhouettes(hull, radius if round_ else 0.0, distances, turns, edges, hints)
    cell = np.zeros((count, density.distances, 6), np.int64)
    low = _reach_of(edges[..., 0], parts, np.minimum) / spec.angle_increment
    high = _reach_of(edges[..., 1], parts, np.maximum) / spec.angle_increment
    cell[..., 0] = np.floor(low - 0.5)
    cell[..., 1] = np.ceil(high + 0.5) - cell[..., 0] + 1
    if not round_:
        for side in (0, 1):
            wound = _wound(hull, hints[..., side], edges[..., side] - turns[:, None] + side * np.pi)
            two = _candidates(wound, parts, len(hull))
            cell[..., 2 + 2 * side : 4 + 2 * side] = two
            miss = _miss(hull, two, edges[..., side], turns, distances, parts)
            far_off = miss > MISS * spec.angle_increment
            far_off[:, 0] = True  # near contact, the rim of a cell does not bound its interior
            climb = _climbs(wound, parts, len(hull))
            cell[..., 2 + 2 * side : 4 + 2 * side][far_off] = climb[far_off]
    if cell[..., 1].max() > MOST_WIDE or cell[..., 0].min() < FIRST_BEAM:
        raise ConfigError(
            f"{describe(shape)} covers too many beams to be baked, as they are "
            f"{spec.angle_increment:.2g} rad apart; scan with the renderer `exact`."
        )
    return Grid(distances, np.arange(count) * unit, edges[parts // 2 :: parts], cell)


def _within(values: NDArray[Any], parts: int, outer: np.ufunc) -> NDArray[Any]:
    """Outermost value in each cell (T, D), from values (T * parts + 1, D) around and between.

    The kernels blend two distances: a cell extends to the next one.
    """
    count = len(values) // parts
    turned = outer.reduce([values[k:][: count * parts : parts] for k in range(parts + 1)])
    result = turned.copy()
    result[:, :-1] = outer(result[:, :-1], turned[:, 1:])
    return np.asarray(result)


def _reach_of(edge: NDArray[np.float64], parts: int, outer: np.ufunc) -> NDArray[np.float64]:
    """Outermost edge (T, D) of all cells that use the row of a cell."""
    result = _within(edge, parts, outer)
    result[:, 1:] = outer(result[:, 1:], result[:, :-1])
    return result


def _wound(
    hull: NDArray[np.float64], hints: NDArray[np.int64], along: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Unwraps the corners at an edge: indices continue around the hull as the shape rotates.

    Args:
        hull: (V, 2) counter-clockwise.
        hints: (...) indices of the corners.
        along: (...) direction of the edge in the shape's frame, with the hull to its left [rad];
            it lies between those of the hull's sides before and after the corner.
    """
    x, y = (np.roll(hull, -1, axis=0) - hull).T
    after = np.arctan2(y, x)
    middle = after - np.mod(after - np.roll(after, 1), 2.0 * np.pi) / 2.0
    rounds = np.round((along - middle[hints]) / (2.0 * np.pi)).astype(np.int64)
    return np.asarray(hints + len(hull) * rounds)


def _candidates(wound: NDArray[np.int64], parts: int, corners: int) -> NDArray[np.int64]:
    """Two corners (T, D, 2) that can be an edge within each cell.

    Along a line and around a circle outside the shape the corner changes monotonically, so those at
    the rim of a cell enclose all others. If there are more than two, those at one quarter and three
    quarters represent all.
    """
    low, high = _within(wound, parts, np.minimum), _within(wound, parts, np.maximum)
    quarter = (high - low) // 4
    return np.stack([(low + quarter) % corners, (high - quarter) % corners], axis=-1)


def _climbs(wound: NDArray[np.int64], parts: int, corners: int) -> NDArray[np.int64]:
    """Corner in the middle of each cell, and minus the initial stride for climbing (T, D, 2)."""
    low, high = _within(wound, parts, np.minimum), _within(wound, parts, np.maximum)
    first = wound[parts // 2 :: parts]
    away = np.clip(np.maximum(high - first, first - low), 1, corners - 1)
    stride = np.exp2(np.floor(np.log2(away))).astype(np.int64)
    return np.stack([first % corners, -stride], axis=-1)


def _miss(
    hull: NDArray[np.float64],
    two: NDArray[np.int64],
    edge: NDArray[np.float64],
    turns: NDArray[np.float64],
    distances: NDArray[np.float64],
    parts: int,
) -> NDArray[np.float64]:
    """Error (T, D) of the nearer of two corners against the edge at the rim of a cell [rad]."""
    count = len(two)
    worst = np.zeros(two.shape[:2])
    for k in range(parts + 1):
        turn, true = turns[k:][: count * parts : parts], edge[k:][: count * parts : parts]
        corner = rotate(hull[two], turn[:, None, None])
        for later in (0, 1):
            last = distances.shape[0] - later
            x = corner[:, :last, :, 0] + distances[later:, None]
            bearing = np.arctan2(corner[:, :last, :, 1], x)
            off = np.abs(bearing - true[:, later:, None]).min(axis=-1)
            worst[:, :last] = np.maximum(worst[:, :last], off)
    return worst


def _rows_of_turn(
    rows: NDArray[np.float32],
    starts: NDArray[np.int64],
    grid: Grid,
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


def apply_model(
    table: LidarTable, grids: Sequence[Grid], model: Function | Sequence[SensorModel]
) -> LidarTable:
    """Returns the table as measured by the device; the rows of the given one are overwritten.

    Args:
        table: without a model.
        grids: (H,) the cells of each of its shapes.
        model: named models, all of which act, or a function of the ranges of one row and the
            angles of incidence.

    Returns:
        The table.
    """
    cosines = _cosines(table, grids)
    if callable(model):
        _apply_function(model, table, cosines)
        return table
    ends = _ends(table)
    for shape, (first, last) in zip(table.shapes, table.cells_of_shapes(), strict=True):
        part = slice(int(table.start[first]), int(ends[last - 1]))
        cosine = cosines[part].astype(np.float64)
        table.rows[part] = returned(model, table.rows[part], np.arccos(cosine), shape.reflectivity)
    return replace(table, sensor_model=tuple(model))


def _ends(table: LidarTable) -> NDArray[np.int64]:
    """Returns the end of each row in `rows` (cells,)."""
    return table.start + table.widths * table.density.phases


def _cosines(table: LidarTable, grids: Sequence[Grid]) -> NDArray[np.float32]:
    """Returns the cosine (R,) of the angle of incidence of each ray, in [0, 1]."""
    cosines, outlines = np.zeros(table.rows.shape, np.float32), table.outlines
    for h, (grid, (first, _)) in enumerate(zip(grids, table.cells_of_shapes(), strict=True)):
        corners = outlines.corners[outlines.corner[h] : outlines.corner[h + 1]]
        for t, turn in enumerate(grid.turns):
            begin = first + t * table.density.distances
            starts = table.start[begin : begin + table.density.distances].astype(np.int64)
            bake_kernels.cosines_of_turn(
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
    """Applies a function to every row, with its points in the order of their angles."""
    phases = table.density.phases
    for begin, end in zip(table.start, _ends(table), strict=True):
        part, cosine = (a[begin:end].reshape(phases, -1).T.ravel() for a in (table.rows, cosines))
        changed = model(part, np.arccos(cosine.astype(np.float64)))
        table.rows[begin:end] = np.asarray(changed, np.float32).reshape(-1, phases).T.ravel()
