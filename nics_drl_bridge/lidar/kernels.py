"""Compiled inner loops of the lidar: what one object does to the beams of one scan.

Each function lowers the beams that its object touches in a scan `out` (B,), float32, in
metres, and leaves the others alone, so that calling them one after the other is the fusion by
minimum of Eq. 4. Positions are in the frame of the lidar. `beams` is the geometry of the
beams: angle_min, angle_increment, and 1.0 for a full circle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TWO_PI = 2.0 * math.pi
ROUNDING = 1e-6
"""A beam this near to an edge, in beams, is tried; the exact test decides."""


@njit(cache=True)
def _lower(out, i, value):  # type: ignore[no-untyped-def]
    """Fuses one return into beam i of a full or partial circle."""
    if value < out[i]:
        out[i] = value


@njit(cache=True)
def beam_span(low, high, beams, count):  # type: ignore[no-untyped-def]
    """First beam index and number of beams in the angles [low, high].

    In a full circle the beams may run over the seam: the index has to be taken modulo the
    count.
    """
    first = math.ceil((low - beams[0]) / beams[1] - ROUNDING)
    last = math.floor((high - beams[0]) / beams[1] + ROUNDING)
    if beams[2] > 0.0:
        return first % count, min(last - first + 1, count)
    first, last = max(first, 0), min(last, count - 1)
    return first, max(last - first + 1, 0)


@njit(cache=True)
def circle(out, directions, beams, x, y, radius, range_max):  # type: ignore[no-untyped-def]
    """Exact ranges to a circle at (x, y)."""
    d2 = x * x + y * y
    r2 = radius * radius
    d = math.sqrt(d2)
    if d - radius > range_max or radius <= 0.0:
        return
    count = out.shape[0]
    if d2 <= r2:  # the lidar is inside: it sees the far side, in all directions
        for i in range(count):
            c, s = directions[i, 0], directions[i, 1]
            across = c * y - s * x
            _lower(out, i, c * x + s * y + math.sqrt(max(r2 - across * across, 0.0)))
        return
    bearing = math.atan2(y, x)
    half = math.asin(radius / d)
    turns = 1 if beams[2] > 0.0 else 3
    for turn in range(turns):
        shift = 0.0 if turns == 1 else (turn - 1) * TWO_PI
        first, hits = beam_span(bearing - half + shift, bearing + half + shift, beams, count)
        for k in range(hits):
            i = first + k
            if i >= count:
                i -= count
            c, s = directions[i, 0], directions[i, 1]
            across = c * y - s * x
            rest = r2 - across * across
            if rest >= 0.0:
                _lower(out, i, c * x + s * y - math.sqrt(rest))


@njit(cache=True)
def segment(out, directions, beams, x1, y1, x2, y2):  # type: ignore[no-untyped-def]
    """Exact ranges to the straight wall from (x1, y1) to (x2, y2)."""
    count = out.shape[0]
    ex, ey = x2 - x1, y2 - y1
    cross = x1 * ey - y1 * ex
    if cross == 0.0:  # seen edge-on
        return
    low, high = math.atan2(y1, x1), math.atan2(y2, x2)
    if cross < 0.0:
        low, high = high, low
    if high < low:
        high += TWO_PI
    turns = 1 if beams[2] > 0.0 else 3
    for turn in range(turns):
        shift = 0.0 if turns == 1 else (turn - 1) * TWO_PI
        first, hits = beam_span(low + shift, high + shift, beams, count)
        for k in range(hits):
            i = first + k
            if i >= count:
                i -= count
            along = directions[i, 0] * ey - directions[i, 1] * ex
            if along != 0.0:
                distance = cross / along
                if distance >= 0.0:
                    _lower(out, i, distance)


@njit(cache=True)
def baked_circle(out, beams, x, y, radius, shape, table, rows, first, start, fine):  # type: ignore[no-untyped-def]
    """Looks a circle up in a table and turns its rows to its bearing (Eq. 3).

    Two rows, of the grid distances on both sides of the true one, are blended. Their ranges
    are stored at `fine` points per beam, so that the bearing is met to 1/(2 fine) of a beam.
    Which beams hit follows from the true distance, not from a row: a silhouette on the wrong
    side of a beam is by far the largest error of a plain look-up.

    Args:
        out: (B,) scan.
        beams: see the module.
        x, y: centre of the circle.
        radius: of the circle.
        shape: index of the circle's radius in the table.
        table: (shapes, 3) nearest grid distance, grid step, number of grid distances.
        rows: (R,) float32 ranges of all rows, one after the other.
        first: (shapes, distances) offset of each row's first point from the bearing [points].
        start: (shapes, distances + 1) where each row begins in `rows`.
        fine: points per beam.
    """
    count = out.shape[0]
    distance = math.sqrt(x * x + y * y)
    place = (distance - table[shape, 0]) / table[shape, 1]
    lower = int(place)
    if place < 0.0 or place > table[shape, 2] - 1.0:
        return
    upper = min(lower + 1, int(table[shape, 2]) - 1)
    blend = np.float32(place - lower)
    begin, last = start[shape, lower], start[shape, lower + 1] - start[shape, lower] - 1
    begin2, last2 = start[shape, upper], start[shape, upper + 1] - start[shape, upper] - 1
    if last < 0 or last2 < 0:
        return
    skip = first[shape, lower] - first[shape, upper]
    half = math.asin(min(radius / distance, 1.0))
    bearing = math.atan2(y, x)
    turns = 1 if beams[2] > 0.0 else 3
    for turn in range(turns):
        turned = bearing if turns == 1 else bearing + (turn - 1) * TWO_PI
        i, hits = beam_span(turned - half, turned + half, beams, count)
        if hits <= 0:
            continue
        offset = i - (turned - beams[0]) / beams[1]
        if turns == 1:
            offset -= count * math.floor(offset / count + 0.5)
        j = math.floor(offset * fine + 0.5) - first[shape, lower]
        for _ in range(hits):
            value = rows[begin + min(max(j, 0), last)]
            value += blend * (rows[begin2 + min(max(j + skip, 0), last2)] - value)
            _lower(out, i, value)
            j += fine
            i += 1
            if i >= count:
                i -= count


@njit(cache=True)
def clear(out):  # type: ignore[no-untyped-def]
    """Begins a scan: no return anywhere."""
    for i in range(out.shape[0]):
        out[i] = np.inf


@njit(cache=True)
def finish(out, range_min, range_max):  # type: ignore[no-untyped-def]
    """Ends a scan: too far is `inf`, too close is `-inf` (REP-117)."""
    for i in range(out.shape[0]):
        if out[i] > range_max:
            out[i] = np.inf
        elif out[i] < range_min:
            out[i] = -np.inf


@njit(cache=True)
def to_sensor(pose, mount):  # type: ignore[no-untyped-def]
    """x, y, cos, sin of the lidar in the world, from the robot's pose (3,) and the mount (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] + c * mount[0] - s * mount[1]
    y = pose[1] + s * mount[0] + c * mount[1]
    return x, y, math.cos(pose[2] + mount[2]), math.sin(pose[2] + mount[2])


@njit(cache=True)
def walls_into(out, directions, beams, sx, sy, c, s, walls):  # type: ignore[no-untyped-def]
    """Fuses straight walls (W, 4), given in the world, into a scan from (sx, sy, c, s)."""
    for w in range(walls.shape[0]):
        ax, ay = walls[w, 0] - sx, walls[w, 1] - sy
        bx, by = walls[w, 2] - sx, walls[w, 3] - sy
        ax, ay = c * ax + s * ay, c * ay - s * ax
        bx, by = c * bx + s * by, c * by - s * bx
        segment(out, directions, beams, ax, ay, bx, by)


@njit(cache=True)
def scan(out, pose, circles, walls, sensor):  # type: ignore[no-untyped-def]
    """One scan (B,) from a robot's pose (3,).

    Args:
        out: (B,) result.
        pose: (3,) of `base_link` in the world.
        circles: (K, 4) x, y, radius [m], index of the radius in the table.
        walls: (W, 4) x1, y1, x2, y2 [m].
        sensor: see `scanner.Scanner.arguments`.
    """
    mount, directions, beams, limits, baked, lookup = sensor
    clear(out)
    sx, sy, c, s = to_sensor(pose, mount)
    table, rows, first, start, fine = lookup
    for k in range(circles.shape[0]):
        dx, dy, radius = circles[k, 0] - sx, circles[k, 1] - sy, circles[k, 2]
        reach = limits[1] + radius
        if radius <= 0.0 or dx * dx + dy * dy > reach * reach:
            continue
        x, y = c * dx + s * dy, c * dy - s * dx
        if baked and dx * dx + dy * dy > radius * radius:
            baked_circle(
                out, beams, x, y, radius, int(circles[k, 3]), table, rows, first, start, fine
            )
        else:
            circle(out, directions, beams, x, y, radius, limits[1])
    walls_into(out, directions, beams, sx, sy, c, s, walls)
    finish(out, limits[0], limits[1])
