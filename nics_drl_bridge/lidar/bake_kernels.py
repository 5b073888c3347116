"""Compiled inner loops of baking: scans of a shape on the lidar's main axis."""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers, ShortIntegers, Singles
from nics_drl_bridge.lidar.beam_kernels import INF_BITS, Beams, make_beams
from nics_drl_bridge.lidar.exact_kernels import (
    place_corner,
    scan_circle,
    scan_polygon,
)
from nics_drl_bridge.lidar.lookup_kernels import LEFT, RIGHT

# ranges at an edge are taken this far inside it, as a fraction of the width
EDGE = 1e-6


@kernel
def find_edges(
    hull: Array,
    radius: float,
    distances: Array,
    turns: Array,
    edges: Array,
    hints: Integers,
) -> None:
    """Write the right and left edge [rad] of a shape straight ahead, and the corners there.

    Both results are (T, D, 2), for rotations (T,) [rad] and distances (D,) [m] of its origin. The
    convex hull is (V, 2) [m], unused for a circle; `radius` [m] is 0 for any other shape.
    """
    for t in range(len(turns)):
        c = math.cos(turns[t])
        s = math.sin(turns[t])
        for d in range(len(distances)):
            if radius > 0.0:
                half = math.asin(min(radius / distances[d], 1.0))
                edges[t, d, 0] = -half
                edges[t, d, 1] = half
                continue
            for k, side in enumerate((RIGHT, LEFT)):
                edges[t, d, k], hints[t, d, k] = _find_edge(
                    distances[d], c, s, hull, side
                )


@kernel
def _find_edge(
    distance: float, c: float, s: float, hull: Array, side: float
) -> tuple[float, int]:
    """Return the direction of the outermost corner on a side [rad], and its index."""
    outer_x, outer_y = place_corner(distance, 0.0, c, s, hull[0])
    corner = 0
    for v in range(1, len(hull)):
        x, y = place_corner(distance, 0.0, c, s, hull[v])
        if side * (outer_x * y - outer_y * x) < 0.0:
            outer_x = x
            outer_y = y
            corner = v
    return math.atan2(outer_y, outer_x), corner


class ShapeAhead(NamedTuple):
    """A shape straight ahead of the lidar."""

    corners: Array  # (V, 2) of its outline [m]; none of a circle
    radius: float  # [m]
    distance: float  # of its origin [m]
    c: float  # cosine and sine of its rotation
    s: float


@kernel
def scan_ahead(scan: ShortIntegers, beams: Beams, shape: ShapeAhead) -> None:
    """Fuse a shape into a scan (B,), see `beam_kernels`."""
    if len(shape.corners) == 0:
        scan_circle(scan, beams, shape.distance, 0.0, shape.radius)
    else:
        scan_polygon(scan, beams, shape.distance, 0.0, shape.c, shape.s, shape.corners)


@kernel(allocates=True)
def find_range(angle: float, shape: ShapeAhead) -> np.float32:
    """Find the range to a shape in one direction [rad]."""
    direction = np.empty((2, 1))
    direction[0, 0] = math.cos(angle)
    direction[1, 0] = math.sin(angle)
    scan = np.empty(1, np.int32)
    scan[0] = INF_BITS
    scan_ahead(scan, make_beams(direction, angle, 1.0), shape)
    nearest = scan.view(np.float32)[0]
    if not np.isfinite(nearest):  # a wall seen edge-on
        for v in range(len(shape.corners)):
            x, y = place_corner(shape.distance, 0.0, shape.c, shape.s, shape.corners[v])
            nearest = min(nearest, np.float32(math.hypot(x, y)))
    return nearest


@kernel(allocates=True)
def fill_row(
    fine: Singles, start: int, step: float, shape: ShapeAhead, edges: Array
) -> None:
    """Write ranges (P,) [m] of a shape, continued beyond its edges (2,) [rad].

    The points are at the angles `start`, `start + 1`... times `step` [rad].
    """
    fine[:] = np.inf
    first = max(math.ceil(edges[0] / step) - start, 0)
    last = min(math.floor(edges[1] / step) - start, len(fine) - 1)
    if first <= last:
        directions = np.empty((2, last + 1 - first))
        for i in range(directions.shape[1]):
            angle = (start + first + i) * step
            directions[0, i] = math.cos(angle)
            directions[1, i] = math.sin(angle)
        scan = fine.view(np.int32)[first : last + 1]
        beams = make_beams(directions, (start + first) * step, step)
        scan_ahead(scan, beams, shape)
    while first <= last and not np.isfinite(fine[first]):
        first += 1
    while last > first and not np.isfinite(fine[last]):
        last -= 1
    if first > last:  # the shape is thinner than the spacing of the points
        fine[:] = find_range((edges[0] + edges[1]) / 2.0, shape)
        return
    inside = EDGE * (edges[1] - edges[0])
    fine[:first] = find_range(edges[0] + inside, shape)
    fine[last + 1 :] = find_range(edges[1] - inside, shape)


@kernel(allocates=True)
def fill_rows_of_turn(
    rows: Singles,
    layout: Integers,
    shape: tuple[Array, float],
    distances: Array,
    turn: float,
    edges: Array,
    step: float,
    phases: int,
) -> None:
    """Write the rows of one rotation [rad] into the table's ranges (R,) float32 [m].

    The layout (3, D) holds, per distance, the start of its row, its first beam relative to the
    bearing, and its width in beams. `shape` are corners and radius, see `ShapeAhead`; edges are
    (D, 2), beams are a `step` apart [rad], with `phases` points each.
    """
    c = math.cos(turn)
    s = math.sin(turn)
    corners, radius = shape
    for d in range(len(distances)):
        start = layout[0, d]
        width = layout[2, d]
        fine = np.empty(width * phases, np.float32)
        ahead = ShapeAhead(corners, radius, distances[d], c, s)
        fill_row(fine, layout[1, d] * phases, step / phases, ahead, edges[d])
        # All points of one phase, then those of the next.
        for phase in range(phases):
            for beam in range(width):
                rows[start + phase * width + beam] = fine[beam * phases + phase]
