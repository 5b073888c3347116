"""Compiled inner loops of baking: scans of a shape on the lidar's main axis."""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import exact_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers, Singles
from nics_drl_bridge.lidar.exact_kernels import Beams

EDGE = 1e-6  # ranges at an edge are taken this far inside it, as a fraction of the whole width


@kernel(allocates=True)
def silhouettes(
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
    for t in range(turns.shape[0]):
        c = math.cos(turns[t])
        s = math.sin(turns[t])
        for d in range(distances.shape[0]):
            if radius > 0.0:
                half = math.asin(min(radius / distances[d], 1.0))
                edges[t, d, 0] = -half
                edges[t, d, 1] = half
                hints[t, d] = 0
                continue
            rx, ry = exact_kernels.turned(distances[d], 0.0, c, s, hull[0])
            lx = rx
            ly = ry
            right = left = 0
            for v in range(1, hull.shape[0]):
                x, y = exact_kernels.turned(distances[d], 0.0, c, s, hull[v])
                if rx * y - ry * x < 0.0:
                    rx = x
                    ry = y
                    right = v
                if lx * y - ly * x > 0.0:
                    lx = x
                    ly = y
                    left = v
            edges[t, d, 0], edges[t, d, 1] = math.atan2(ry, rx), math.atan2(ly, lx)
            hints[t, d, 0] = right
            hints[t, d, 1] = left


@kernel(allocates=True)
def along(
    angle: float, corners: Array, radius: float, distance: float, cos: float, sin: float
) -> np.float32:
    """Range to a shape straight ahead in one direction [rad]; see `row`."""
    ray = np.empty((2, 1))
    out = np.full(1, np.inf, np.float32)
    ray[0, 0], ray[1, 0] = math.cos(angle), math.sin(angle)
    beams = exact_kernels.beams_of(ray, angle, 1.0, False)
    if corners.shape[0] == 0:
        exact_kernels.circle(out, beams, distance, 0.0, radius, np.inf)
    else:
        exact_kernels.polygon(out, beams, distance, 0.0, cos, sin, corners)
        if not np.isfinite(out[0]):  # a wall seen edge-on
            for v in range(corners.shape[0]):
                x, y = exact_kernels.turned(distance, 0.0, cos, sin, corners[v])
                out[0] = min(out[0], math.hypot(x, y))
    return out[0]


@kernel(allocates=True)
def row(
    fine: Singles,
    beams: Beams,
    corners: Array,
    radius: float,
    distance: float,
    cos: float,
    sin: float,
    edge: Array,
) -> None:
    """Write ranges (P,) [m] of a shape straight ahead, continued beyond its edges (2,) [rad]."""
    fine[:] = np.inf
    if corners.shape[0] == 0:
        exact_kernels.circle(fine, beams, distance, 0.0, radius, np.inf)
    else:
        exact_kernels.polygon(fine, beams, distance, 0.0, cos, sin, corners)
    count = fine.shape[0]
    first = min(max(math.ceil((edge[0] - beams.first) / beams.step), 0), count - 1)
    last = max(min(math.floor((edge[1] - beams.first) / beams.step), count - 1), 0)
    while first < last and not np.isfinite(fine[first]):
        first += 1
    while last > first and not np.isfinite(fine[last]):
        last -= 1
    # the shape is thinner than the spacing of the points, so no point hits it
    if not np.isfinite(fine[first]):
        fine[:] = along((edge[0] + edge[1]) / 2.0, corners, radius, distance, cos, sin)
        return
    inside = EDGE * (edge[1] - edge[0])
    fine[:first] = along(edge[0] + inside, corners, radius, distance, cos, sin)
    fine[last + 1 :] = along(edge[1] - inside, corners, radius, distance, cos, sin)


@kernel(allocates=True)
def into_phases(rows: Singles, fine: Singles, width: int, phases: int) -> None:
    """Sort points (width * phases,) so that those of one phase are contiguous."""
    for phase in range(phases):
        for k in range(width):
            rows[phase * width + k] = fine[k * phases + phase]


@kernel(allocates=True)
def rows_of_turn(
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
    bearing, and its width in beams. `shape` are corners and radius, see `row`; edges are (D, 2),
    beams are a `step` apart [rad], with `phases` points each.
    """
    c = math.cos(turn)
    s = math.sin(turn)
    corners, radius = shape
    for d in range(distances.shape[0]):
        start = layout[0, d]
        begin = layout[1, d]
        width = layout[2, d]
        points = width * phases
        angles = (begin * phases + np.arange(points)) * (step / phases)
        directions = np.stack((np.cos(angles), np.sin(angles)))
        fine = np.empty(points, np.float32)
        beams = exact_kernels.beams_of(directions, angles[0], step / phases, False)
        row(fine, beams, corners, radius, distances[d], c, s, edges[d])
        into_phases(rows[start : start + points], fine, width, phases)
