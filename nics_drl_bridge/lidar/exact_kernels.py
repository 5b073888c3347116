"""Compiled exact scanner: the ranges of one object in one scan.

Each function lowers the ranges of the beams that hit its object, see `beam_kernels`;
one call after another computes the minimum of Eq. 4. Positions are in the lidar's
frame.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers, ShortIntegers
from nics_drl_bridge.lidar.beam_kernels import (
    TWO_PI,
    Beams,
    LidarPose,
    arctan2,
    beams_within,
    lower,
    span_beams,
)

IN_LINE = (
    1e-9  # a wall is seen edge-on if its line passes the lidar closer than this [m]
)
X, Y, HEADING, COS, SIN, RADIUS, SHAPE = range(7)
"""Columns of a placed body; an absent body has radius 0, and `SHAPE` is an index."""


class OutlineArrays(NamedTuple):
    """Outlines of all shapes, see `shapes.Outlines`."""

    corners: Array  # (sum V, 2) of all outlines [m]
    first: Integers  # (H + 1,) first corner of each outline; a circle has none


@kernel
def scan_circle(
    scan: ShortIntegers, beams: Beams, x: float, y: float, radius: float
) -> None:
    """Lower the beams that hit a circle at (x, y) to its near side, or from inside the far one."""
    distance = math.sqrt(x * x + y * y)
    is_inside = distance <= radius
    half = math.pi if is_inside else math.asin(radius / distance)
    span = span_beams(arctan2(y, x) - half, 2.0 * half, beams)
    for turned_by in (0.0, span.full_turn):
        first, end = beams_within(span, turned_by, beams.directions.shape[1])
        for i in range(first, end):
            c = beams.directions[0, i]
            s = beams.directions[1, i]
            across = c * y - s * x
            half_chord = math.sqrt(max(radius * radius - across * across, 0.0))
            along = c * x + s * y
            lower(scan, i, along + half_chord if is_inside else along - half_chord)


@kernel
def scan_edge(
    scan: ShortIntegers,
    beams: Beams,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
) -> None:
    """Lower the beams that hit a straight wall; its ends are x, y [m] and the bearing [rad]."""
    ex = end[0] - start[0]
    ey = end[1] - start[1]
    cross = start[0] * ey - start[1] * ex
    if not cross * cross > IN_LINE * IN_LINE * (ex * ex + ey * ey):
        return
    right = start[2] if cross > 0.0 else end[2]
    width = end[2] - start[2] if cross > 0.0 else start[2] - end[2]
    if width < -1.0:
        width += TWO_PI
    span = span_beams(right, max(width, 0.0), beams)
    for turned_by in (0.0, span.full_turn):
        first, last = beams_within(span, turned_by, beams.directions.shape[1])
        _cross_beams(scan, beams.directions, first, last, np.float32(cross), ex, ey)


@kernel(contracts=True, inline=True)
def _cross_beams(
    scan: ShortIntegers,
    directions: Array,
    first: int,
    end: int,
    cross: np.float32,
    ex: float,
    ey: float,
) -> None:
    for k in range(end - first):
        i = np.uintp(first + k)
        # A division in single precision takes half the time.
        distance = cross / np.float32(directions[0, i] * ey - directions[1, i] * ex)
        lower(scan, i, distance if distance >= np.float32(0.0) else np.float32(np.inf))


@kernel
def scan_polygon(
    scan: ShortIntegers,
    beams: Beams,
    x: float,
    y: float,
    c: float,
    s: float,
    corners: Array,
) -> None:
    """Lower the beams that hit the outline `corners` (V, 2), rotated by (c, s), at (x, y)."""
    corner_x, corner_y = place_corner(x, y, c, s, corners[-1])
    start = corner_x, corner_y, arctan2(corner_y, corner_x)
    for v in range(len(corners)):
        corner_x, corner_y = place_corner(x, y, c, s, corners[v])
        end = corner_x, corner_y, arctan2(corner_y, corner_x)
        scan_edge(scan, beams, start, end)
        start = end


@kernel(inline=True)
def place_corner(
    x: float, y: float, c: float, s: float, corner: Array
) -> tuple[float, float]:
    """Position of a corner (2,) of a shape turned by (c, s) and placed at (x, y)."""
    return x + c * corner[0] - s * corner[1], y + s * corner[0] + c * corner[1]


@kernel
def scan_walls(
    scan: ShortIntegers, beams: Beams, lidar: LidarPose, walls: Array, range_max: float
) -> None:
    """Fuse walls (W, 4) of the world; those out of range are skipped."""
    for w in range(len(walls)):
        start_x, start_y = _transform_point(walls[w, 0], walls[w, 1], lidar)
        end_x, end_y = _transform_point(walls[w, 2], walls[w, 3], lidar)
        ex = end_x - start_x
        ey = end_y - start_y
        # The nearest point, as a fraction of the length.
        foot = -(start_x * ex + start_y * ey) / (ex * ex + ey * ey)
        foot = min(max(foot, 0.0), 1.0)
        nearest_x = start_x + foot * ex
        nearest_y = start_y + foot * ey
        if nearest_x * nearest_x + nearest_y * nearest_y > range_max * range_max:
            continue
        start = start_x, start_y, arctan2(start_y, start_x)
        end = end_x, end_y, arctan2(end_y, end_x)
        scan_edge(scan, beams, start, end)


@kernel(inline=True)
def _transform_point(x: float, y: float, lidar: LidarPose) -> tuple[float, float]:
    """Return a point of the world in the frame of the lidar."""
    dx = x - lidar.x
    dy = y - lidar.y
    return lidar.c * dx + lidar.s * dy, lidar.c * dy - lidar.s * dx


@kernel
def scan_body(
    scan: ShortIntegers,
    beams: Beams,
    lidar: LidarPose,
    body: Array,
    outlines: OutlineArrays,
) -> None:
    """Fuse one body (7,) of the world."""
    x, y = _transform_point(body[X], body[Y], lidar)
    shape = int(body[SHAPE])
    begin = outlines.first[shape]
    end = outlines.first[shape + 1]
    if begin == end:
        scan_circle(scan, beams, x, y, body[RADIUS])
    else:
        cos = body[COS] * lidar.c + body[SIN] * lidar.s
        sin = body[SIN] * lidar.c - body[COS] * lidar.s
        scan_polygon(scan, beams, x, y, cos, sin, outlines.corners[begin:end])
