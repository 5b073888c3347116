"""Baking: scans of every shape on the lidar's main axis, stored in a table (Sec. IV-B)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar import bake_kernels
from nics_drl_bridge.lidar.arrays import AnyArray, Array, Integers
from nics_drl_bridge.lidar.shapes import Circle, Outlines, Shape, describe
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import MOST_WIDE, Density, LidarTable, count_padding

TOUCHING = 1e-6  # excess of the nearest grid distance over the radius, as a fraction of the radius
# upper limit of twice the steps between grid rotations [rad]
COARSE = np.radians(2.0)
MOST_NUMBERS = 2**31 - 2**20
FIRST_BEAM = -(2**15)  # minimum first beam of a row, relative to the bearing
# if both corners miss an edge by more than this [beams], it is found by climbing the
# hull
MISS = 0.02


@dataclass(frozen=True)
class Grid:
    """The cells of one shape: T rotations, D distances."""

    distances: Array  # (D,) [m]
    turns: Array  # (T,) [rad]
    edges: Array  # (T, D, 2) right and left edge of the shape [rad]
    cell: Integers  # (T, D, 6) see `LidarTable.cell`


def bake(
    spec: LidarSpec,
    shapes: Sequence[Shape],
    density: Density | None = None,
) -> LidarTable:
    """Scan shapes straight ahead, on a grid of distances and rotations, with the exact scanner.

    Equal shapes are baked once, by default at `Density.for_beams`. Raises ConfigError if the table
    would be too large, or a shape covers too many beams.
    """
    shapes = tuple(dict.fromkeys(shapes))
    density = density or Density.for_beams(spec.angle_increment)
    outlines = Outlines.of(shapes)
    grids = [make_grid(spec, outlines, h, density) for h in range(len(shapes))]
    cells = np.concatenate(
        [np.zeros((0, 6), np.int64), *(g.cell.reshape(-1, 6) for g in grids)]
    )
    sizes = cells[:, 1] * density.phases
    if sizes.sum() > MOST_NUMBERS:
        raise ConfigError(
            f"a lidar table of {len(cells)} cells with {spec.beams} beams is too large; lower "
            "`distances`, `rotations` or `phases`."
        )
    first = np.cumsum([0, *(len(g.turns) * density.distances for g in grids)])
    about = [
        (g.distances[-1], len(g.turns), f) for g, f in zip(grids, first, strict=False)
    ]
    table = LidarTable(
        shapes,
        density,
        spec.angle_increment,
        np.array(about, np.float64).reshape(-1, 3),
        (np.cumsum(sizes) - sizes).astype(np.int32),
        cells.astype(np.int16),
        np.zeros(int(sizes.sum()) + count_padding(spec.angle_increment), np.float32),
    )
    _fill(table, grids)
    return table


def add_shapes(
    spec: LidarSpec, table: LidarTable, shapes: Sequence[Shape]
) -> LidarTable:
    """Return the table if it contains all of these shapes, or else one of equal density."""
    if set(shapes) <= set(table.shapes):
        return table
    if not table.has_rows:
        return LidarTable.without_rows(spec, (*table.shapes, *shapes))
    return bake(spec, (*table.shapes, *shapes), table.density)


def make_grid(spec: LidarSpec, outlines: Outlines, h: int, density: Density) -> Grid:
    """Compute the cells of a shape and the widths of their rows."""
    shape = outlines.shapes[h]
    radius = outlines.radii[h]
    distances = np.linspace(radius, spec.range_max + radius, density.distances)
    distances[0] *= 1.0 + TOUCHING
    is_round = isinstance(shape, Circle)
    count = 1
    if not is_round:
        count = max(1, math.ceil(density.rotations / outlines.orders[h]))
    unit = 2.0 * np.pi / (count * outlines.orders[h])
    fine = _find_fine_edges(outlines, h, distances, unit, count)
    cell = np.zeros((count, density.distances, 6), np.int64)
    low = _reach_of(fine.edges[..., 0], fine.parts, np.minimum) / spec.angle_increment
    high = _reach_of(fine.edges[..., 1], fine.parts, np.maximum) / spec.angle_increment
    cell[..., 0] = np.floor(low - 0.5)
    cell[..., 1] = np.ceil(high + 0.5) - cell[..., 0] + 1
    if not is_round:
        cell[..., 2:4] = _find_corners(fine, 0, spec.angle_increment)
        cell[..., 4:] = _find_corners(fine, 1, spec.angle_increment)
    if cell[..., 1].max() > MOST_WIDE or cell[..., 0].min() < FIRST_BEAM:
        raise ConfigError(
            f"{describe(shape)} covers too many beams to be baked: they are "
            f"{spec.angle_increment:.2g} rad apart; scan with the renderer `exact`."
        )
    edges = fine.edges[fine.parts // 2 :: fine.parts]
    return Grid(distances, np.arange(count) * unit, edges, cell)


class _FineEdges(NamedTuple):
    """Edges of a shape, at `parts` rotations in each of the table's, and at its distances."""

    hull: Array  # (V, 2) corners [m]
    distances: Array  # (D,) [m]
    parts: int
    turns: Array  # (T parts + 1,) rotations [rad]
    edges: Array  # (T parts + 1, D, 2) right and left edge [rad]
    corners: Integers  # (T parts + 1, D, 2) of the hull, at the edges


def _find_fine_edges(
    outlines: Outlines, h: int, distances: Array, unit: float, count: int
) -> _FineEdges:
    """Find the edges of shape h for `count` grid rotations, a `unit` apart [rad]."""
    begin = outlines.hull[h]
    hull = outlines.hulls[begin : (begin + outlines.hull[h + 1]) // 2]
    round_radius = 0.0
    if isinstance(outlines.shapes[h], Circle):
        round_radius = outlines.radii[h]
    parts = 2 * max(1, math.ceil(unit / COARSE))
    turns = np.arange(-parts // 2, parts * count - parts // 2 + 1) * unit / parts
    edges = np.zeros((len(turns), len(distances), 2))
    corners = np.zeros(edges.shape, np.int64)
    bake_kernels.find_edges(hull, round_radius, distances, turns, edges, corners)
    return _FineEdges(hull, distances, parts, turns, edges, corners)


def _find_corners(fine: _FineEdges, side: int, beam_angle: float) -> Integers:
    """Return the corners (T, D, 2) for the right (0) or left (1) edge, see `LidarTable`."""
    edge = fine.edges[..., side]
    along = edge - fine.turns[:, None] + side * np.pi
    wound = _wound(fine.hull, fine.corners[..., side], along)
    two, climb = _choose_corners(wound, fine.parts, len(fine.hull))
    far_off = _miss(fine, two, edge) > MISS * beam_angle
    # close to contact, the border of a cell does not bound its interior
    far_off[:, 0] = True
    return np.where(far_off[..., None], climb, two)


def _reduce_cells(values: AnyArray, parts: int, outer: np.ufunc) -> AnyArray:
    """Outermost value in each cell (T, D) and its neighbour, since two distances are blended."""
    count = len(values) // parts
    turned = outer.reduce(
        [values[k:][: count * parts : parts] for k in range(parts + 1)]
    )
    result = turned.copy()
    result[:, :-1] = outer(result[:, :-1], turned[:, 1:])
    return np.asarray(result)


def _reach_of(edge: Array, parts: int, outer: np.ufunc) -> Array:
    """Outermost edge (T, D) of all cells that use the row of a cell."""
    result = _reduce_cells(edge, parts, outer)
    result[:, 1:] = outer(result[:, 1:], result[:, :-1])
    return result


def _wound(hull: Array, hints: Integers, along: Array) -> Integers:
    """Unwrap corners at an edge (...), which points `along` in the shape's frame [rad]."""
    x, y = (np.roll(hull, -1, axis=0) - hull).T
    after = np.arctan2(y, x)
    middle = after - np.mod(after - np.roll(after, 1), 2.0 * np.pi) / 2.0
    rounds = np.round((along - middle[hints]) / (2.0 * np.pi)).astype(np.int64)
    return np.asarray(hints + len(hull) * rounds)


def _choose_corners(
    wound: Integers, parts: int, corners: int
) -> tuple[Integers, Integers]:
    """Return two corners (T, D, 2) that may be an edge in a cell, or a start for climbing.

    Along a line and around an outer circle, the corner changes monotonically, so those
    at the border of a cell enclose all others. If there are more than two, the ones at
    one and three quarters represent them.
    """
    low = _reduce_cells(wound, parts, np.minimum)
    high = _reduce_cells(wound, parts, np.maximum)
    quarter = (high - low) // 4
    first = wound[parts // 2 :: parts]
    away = np.clip(np.maximum(high - first, first - low), 1, corners - 1)
    stride = np.exp2(np.floor(np.log2(away))).astype(np.int64)
    two = np.stack([(low + quarter) % corners, (high - quarter) % corners], axis=-1)
    return two, np.stack([first % corners, -stride], axis=-1)


def _miss(fine: _FineEdges, two: Integers, edge: Array) -> Array:
    """Error (T, D) of the better of two corners at the border of a cell [rad]."""
    parts = fine.parts
    worst = np.zeros(two.shape[:2])
    for k in range(parts + 1):
        turn = fine.turns[k:][: len(two) * parts : parts]
        true = edge[k:][: len(two) * parts : parts]
        corner = rotate(fine.hull[two], turn[:, None, None])
        for later in (0, 1):
            last = len(fine.distances) - later
            x = corner[:, :last, :, 0] + fine.distances[later:, None]
            off = np.abs(
                np.arctan2(corner[:, :last, :, 1], x) - true[:, later:, None]
            ).min(axis=-1)
            worst[:, :last] = np.maximum(worst[:, :last], off)
    return worst


def _fill(table: LidarTable, grids: Sequence[Grid]) -> None:
    """Write the rows of all cells into the table."""
    outlines = table.outlines
    distances = table.density.distances
    done = 0
    for h, grid in enumerate(grids):
        shape = (
            outlines.corners[outlines.corner[h] : outlines.corner[h + 1]],
            outlines.radii[h],
        )
        for t, turn in enumerate(grid.turns):
            start = table.start[done * distances : (done + 1) * distances].astype(
                np.int64
            )
            layout = np.stack([start, grid.cell[t, :, 0], grid.cell[t, :, 1]])
            bake_kernels.fill_rows_of_turn(
                table.rows,
                layout,
                shape,
                grid.distances,
                turn,
                grid.edges[t],
                table.beam_angle,
                table.density.phases,
            )
            done += 1
