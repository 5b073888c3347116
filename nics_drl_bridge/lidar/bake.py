"""Baking: scans of every shape on the lidar's main axis, stored in a table (Sec. IV-B)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
    order = outlines.orders[h]
    distances = np.linspace(radius, spec.range_max + radius, density.distances)
    distances[0] *= 1.0 + TOUCHING
    is_round = isinstance(shape, Circle)
    if is_round:
        count = 1
        round_radius = radius
    else:
        count = max(1, math.ceil(density.rotations / order))
        round_radius = 0.0
    unit = 2.0 * np.pi / (count * order)
    hull = outlines.hulls[
        outlines.hull[h] : (outlines.hull[h] + outlines.hull[h + 1]) // 2
    ]
    parts = 2 * max(1, math.ceil(unit / COARSE))
    turns = np.arange(-parts // 2, parts * count - parts // 2 + 1) * unit / parts
    edges = np.zeros((len(turns), density.distances, 2))
    hints = np.zeros(edges.shape, np.int64)
    bake_kernels.find_edges(hull, round_radius, distances, turns, edges, hints)
    cell = np.zeros((count, density.distances, 6), np.int64)
    low = _reach_of(edges[..., 0], parts, np.minimum) / spec.angle_increment
    high = _reach_of(edges[..., 1], parts, np.maximum) / spec.angle_increment
    cell[..., 0] = np.floor(low - 0.5)
    cell[..., 1] = np.ceil(high + 0.5) - cell[..., 0] + 1
    for side in () if is_round else (0, 1):
        edge = edges[..., side]
        wound = _wound(hull, hints[..., side], edge - turns[:, None] + side * np.pi)
        two, climb = _choose_corners(wound, parts, len(hull))
        miss = _miss(hull, two, edge, turns, distances, parts)
        far_off = miss > MISS * spec.angle_increment
        # close to contact, the border of a cell does not bound its interior
        far_off[:, 0] = True
        corners = np.where(far_off[..., None], climb, two)
        cell[..., 2 + 2 * side : 4 + 2 * side] = corners
    if cell[..., 1].max() > MOST_WIDE or cell[..., 0].min() < FIRST_BEAM:
        raise ConfigError(
            f"{describe(shape)} covers too many beams to be baked: they are "
            f"{spec.angle_increment:.2g} rad apart; scan with the renderer `exact`."
        )
    return Grid(distances, np.arange(count) * unit, edges[parts // 2 :: parts], cell)


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


def _miss(
    hull: Array,
    two: Integers,
    edge: Array,
    turns: Array,
    distances: Array,
    parts: int,
) -> Array:
    """Error (T, D) of the better of two corners at the border of a cell [rad]."""
    count = len(two)
    worst = np.zeros(two.shape[:2])
    for k in range(parts + 1):
        turn = turns[k:][: count * parts : parts]
        true = edge[k:][: count * parts : parts]
        corner = rotate(hull[two], turn[:, None, None])
        for later in (0, 1):
            last = len(distances) - later
            x = corner[:, :last, :, 0] + distances[later:, None]
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
