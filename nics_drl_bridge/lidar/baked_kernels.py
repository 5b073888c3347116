"""Compiled inner loops of the baked lidar: table look-up (Eq. 3); see also `fuse_kernels`.

The visible bodies of several scans go through a number of passes together, each a short loop
without branches: nearly all the time of a look-up goes into cache misses and branch mispredictions,
and so the latency of one body overlaps with the work on the next. Passes hand on their results in
lanes: one array per number type, in which every quantity has `LANES` places at a fixed offset, so
that LLVM can prove that they do not overlap. The result for a body depends on that body only, so
that a scan is identical in any batch.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.map_kernels import get, peek, put

LANES = 144
"""Number of bodies that go through the passes together: a multiple of `BLOCK`, and few enough that
their scans stay in the L1 cache."""
WIDE, SINGLE, WHOLE = 20, 8, 15
"""Numbers of quantities in double precision, in single precision and in integers."""
X, Y, TURN, COS, SIN, RADIUS, AHEAD, AT, ROUND, MIDDLE, RIGHT, LEFT = (k * LANES for k in range(12))
"""Of a body: offset from the lidar, heading, cos, sin, radius; the bearing of beam 0 in the world
and the index of the scan in memory; radius of a circle or 0; bearing and silhouettes in beams."""
RIGHT_X, RIGHT_Y, RIGHT_X2, RIGHT_Y2, LEFT_X, LEFT_Y, LEFT_X2, LEFT_Y2 = (
    k * LANES for k in range(12, 20)
)
"""The two corners of the hull that can be the right silhouette, and the left one."""
DISTANCE, BEARING, ALONG, ACROSS, ALONG2, ACROSS2, PART, BLEND = (k * LANES for k in range(8))
"""The silhouettes along and across the bearing, then `ALONG` and `ALONG2` as angles; shares of the
next point and of the farther row."""
SHAPE, CELL, HULL, CLIMB, START, PLACE, START2, PLACE2, BEGIN, HITS, BACK = (
    k * LANES for k in range(11)
)
NEAR, NEAR2, FAR, FAR2 = (k * LANES for k in range(11, 15))
"""The cell and the next one, packed as in the table; the span of beams; indices of the points."""
PER_METRE, ROTATIONS, PARTS_PER_ROTATION, FIRST_CELL, CELLS_PER_PART = range(5)
HULL_END, CORNERS_PER_PART, CORNERS, ROUND_RADIUS, ABOUT = range(5, 10)
"""Parameters of a shape in the kernels, see `table.LidarTable.lookup`, and their number."""
PER_TURN = 0.5 / math.pi
ATAN = tuple(
    np.float32(factor)
    for factor in (
        0.999999881,
        -0.333319604,
        0.199692354,
        -0.140165851,
        0.0990609676,
        -0.0593671016,
        0.0241661891,
        -0.00466877315,
    )
)


@kernel(contracts=True, inline=True)
def in_sight(found, begin, end, bodies, n, me, scan, range_max, baked, wide, whole):  # type: ignore[no-untyped-def]
    """First pass: packs the bodies within range of one scan into the lanes.

    Args:
        found: number of lanes in use.
        begin, end: range of the bodies; there are lanes for all of them.
        bodies: (N, K, 7), see `shapes.BODY`.
        n: index of the world.
        me: the body that carries the lidar, or -1.
        scan: x and y of the lidar in the world [m], the bearing of beam 0 [rad], and the index
            of its range in the array of the ranges.
        range_max: [m].
        baked: (H, 2) squares of the distances between which a shape is looked up [m^2]; inf if it
            never is.
        wide, whole: lanes.

    Returns:
        Number of lanes in use, and number of bodies within range that are not looked up: the lidar
        is within their circle, or not between the distances of their shape.
    """
    n, left = np.uintp(n), 0
    sx, sy, ahead, at = scan
    for k in range(begin, end):
        b = np.uintp(k)
        dx, dy, radius = bodies[n, b, 0] - sx, bodies[n, b, 1] - sy, bodies[n, b, 5]
        d2 = dx * dx + dy * dy
        reach = range_max + radius
        shape = np.int32(bodies[n, b, 6])
        put(wide, found + X, dx)
        put(wide, found + Y, dy)
        put(wide, found + TURN, bodies[n, b, 2])
        put(wide, found + COS, bodies[n, b, 3])
        put(wide, found + SIN, bodies[n, b, 4])
        put(wide, found + RADIUS, radius)
        put(wide, found + AHEAD, ahead)
        put(wide, found + AT, at)
        put(whole, found + SHAPE, np.int32(shape * ABOUT))
        seen = (d2 <= reach * reach) & (radius > 0.0) & (k != me)
        h = np.uintp(shape)
        kept = seen & (d2 >= radius * radius) & (d2 >= baked[h, 0]) & (d2 <= baked[h, 1])
        found += kept
        left += seen & (not kept)
    return found, left


@kernel(contracts=True)
def left_out(bodies, n, k, me, sx, sy, range_max, baked):  # type: ignore[no-untyped-def]
    """True if body k is within range but not looked up; see `in_sight`."""
    dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
    d2 = dx * dx + dy * dy
    reach = range_max + radius
    seen = radius > 0.0 and k != me and d2 <= reach * reach
    h = int(bodies[n, k, 6])
    return seen and (d2 < radius * radius or d2 < baked[h, 0] or d2 > baked[h, 1])


@kernel(contracts=True, inline=True)
def arctan2_single(y, x):  # type: ignore[no-untyped-def]
    """Like `kernels.arctan2`, in single precision, within 2e-7 rad."""
    ax, ay = abs(x), abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    s = ratio * ratio
    r = ATAN[7]
    r = r * s + ATAN[6]
    r = r * s + ATAN[5]
    r = r * s + ATAN[4]
    r = r * s + ATAN[3]
    r = r * s + ATAN[2]
    r = r * s + ATAN[1]
    r = (r * s + ATAN[0]) * ratio
    r = np.float32(0.5 * math.pi) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < np.float32(0.0) else r
    return math.copysign(r, y)


@kernel(contracts=True)
def directions(padded, wide, single):  # type: ignore[no-untyped-def]
    """Second pass: distance and bearing in the world of each body."""
    for k in range(padded):
        x, y = get(wide, k + X), get(wide, k + Y)
        put(single, k + ALONG, np.float32(x))
        put(single, k + ACROSS, np.float32(y))
        put(single, k + DISTANCE, np.float32(x * x + y * y))
    for k in range(padded):
        put(single, k + DISTANCE, math.sqrt(get(single, k + DISTANCE)))
        put(single, k + BEARING, arctan2_single(get(single, k + ACROSS), get(single, k + ALONG)))


@kernel(contracts=True)
def cells_of(padded, distances, about, wide, single, whole):  # type: ignore[no-untyped-def]
    """Third pass: the table cell of each body, and the first corner of its hull.

    All indices are clamped to the table: a heading may be NaN, and unused lanes contain old values.
    """
    zero, last = np.int32(0), np.int32(distances - 2)
    for k in range(padded):
        h = np.int64(get(whole, k + SHAPE))
        place = (get(single, k + DISTANCE) - get(wide, k + RADIUS)) * peek(about, h + PER_METRE)
        step = np.int32(max(min(np.int32(place), last), zero))
        put(single, k + BLEND, np.float32(place - step))
        share = (get(wide, k + TURN) - get(single, k + BEARING)) * PER_TURN
        share -= np.floor(share)
        rotations = peek(about, h + ROTATIONS)
        turn = np.int32(share * rotations + 0.5)
        turn = np.int32(max(min(turn, np.int32(rotations)), zero))
        sector = np.int32((turn + 0.5) * peek(about, h + PARTS_PER_ROTATION))
        cell = turn * distances - sector * peek(about, h + CELLS_PER_PART)
        put(whole, k + CELL, np.int32(np.int32(cell + peek(about, h + FIRST_CELL)) + step))
        hull = peek(about, h + HULL_END) - sector * peek(about, h + CORNERS_PER_PART)
        put(whole, k + HULL, np.int32(hull))
        put(wide, k + ROUND, peek(about, h + ROUND_RADIUS))


@kernel(contracts=True)
def fetch(found, cells, hulls, wide, whole):  # type: ignore[no-untyped-def]
    """Fourth pass: loads the cells, the only pass with these cache misses.

    Args:
        found: number of lanes in use.
        cells: (cells * 4,) int32, see `table.LidarTable.lookup`.
        hulls: (2 * corners,), see `shapes.Outlines`.
        wide, whole: lanes.
    """
    zero = np.int32(0)
    for k in range(found):
        cell, skip = np.int64(get(whole, k + CELL)) * 4, get(whole, k + HULL)
        put(whole, k + START, cells[np.uintp(cell)])
        put(whole, k + PLACE, cells[np.uintp(cell + 1)])
        put(whole, k + START2, cells[np.uintp(cell + 4)])
        put(whole, k + PLACE2, cells[np.uintp(cell + 5)])
        right, left = cells[np.uintp(cell + 2)], cells[np.uintp(cell + 3)]
        other, other2 = np.int32(right >> 16), np.int32(left >> 16)
        put(whole, k + CLIMB, np.int32(other | other2))  # negative if either is
        corner = 2 * np.int64(skip + (right & 0xFFFF))
        put(wide, k + RIGHT_X, hulls[np.uintp(corner)])
        put(wide, k + RIGHT_Y, hulls[np.uintp(corner + 1)])
        corner = 2 * np.int64(skip + max(other, zero))
        put(wide, k + RIGHT_X2, hulls[np.uintp(corner)])
        put(wide, k + RIGHT_Y2, hulls[np.uintp(corner + 1)])
        corner = 2 * np.int64(skip + (left & 0xFFFF))
        put(wide, k + LEFT_X, hulls[np.uintp(corner)])
        put(wide, k + LEFT_Y, hulls[np.uintp(corner + 1)])
        corner = 2 * np.int64(skip + max(other2, zero))
        put(wide, k + LEFT_X2, hulls[np.uintp(corner)])
        put(wide, k + LEFT_Y2, hulls[np.uintp(corner + 1)])


@kernel(contracts=True, inline=True)
def seen_from(d2, cos, sin, x, y):  # type: ignore[no-untyped-def]
    """Returns a corner (x, y) of a hull along and across the bearing, times the distance.

    `d2` is the square of the distance; `cos` and `sin` are those of the heading relative to the
    bearing, times the distance.
    """
    return d2 + cos * x - sin * y, sin * x + cos * y


@kernel(contracts=True)
def silhouettes(padded, wide, single):  # type: ignore[no-untyped-def]
    """Fifth pass: the two silhouettes as (along, across), each from the outer of two corners."""
    for k in range(padded):
        x, y, c, s = get(wide, k + X), get(wide, k + Y), get(wide, k + COS), get(wide, k + SIN)
        d2, cos, sin = x * x + y * y, c * x + s * y, s * x - c * y
        radius = get(wide, k + ROUND)
        tangent = math.sqrt(max(d2 - radius * radius, 0.0))
        ax, ay = seen_from(d2, cos, sin, get(wide, k + RIGHT_X), get(wide, k + RIGHT_Y))
        bx, by = seen_from(d2, cos, sin, get(wide, k + RIGHT_X2), get(wide, k + RIGHT_Y2))
        outer = ax * by - ay * bx < 0.0
        ax, ay = bx if outer else ax, by if outer else ay
        put(single, k + ALONG, np.float32(tangent if radius > 0.0 else ax))
        put(single, k + ACROSS, np.float32(-radius if radius > 0.0 else ay))
        ax, ay = seen_from(d2, cos, sin, get(wide, k + LEFT_X), get(wide, k + LEFT_Y))
        bx, by = seen_from(d2, cos, sin, get(wide, k + LEFT_X2), get(wide, k + LEFT_Y2))
        outer = ax * by - ay * bx > 0.0
        ax, ay = bx if outer else ax, by if outer else ay
        put(single, k + ALONG2, np.float32(tangent if radius > 0.0 else ax))
        put(single, k + ACROSS2, np.float32(radius if radius > 0.0 else ay))


@kernel(contracts=True)
def outermost(hulls, skip, corners, first, stride, d2, cos, sin, side):  # type: ignore[no-untyped-def]
    """Climbs along a hull to its right (side 1) or left (-1) silhouette, as (along, across).

    Seen from outside, the direction of the corners rises and falls once around the hull, so that a
    local optimum is the global one. Only shapes with many corners need it, at short distances.

    Args:
        hulls: (2 * corners,) of all hulls, see `shapes.Outlines`.
        skip, corners: index of the hull's first corner, and number of its corners.
        first: the corner to begin at.
        stride: initial stride, a power of 2.
        d2, cos, sin: of the shape, see `seen_from`.
        side: 1 or -1.
    """
    best = first
    one = 2 * (skip + best)
    x, y = seen_from(d2, cos, sin, hulls[np.uintp(one)], hulls[np.uintp(one + 1)])
    while stride > 0:
        for _ in range(corners):
            moved = False
            for step in (stride, corners - stride):
                other = best + step
                other -= corners if other >= corners else 0
                one = 2 * (skip + other)
                ax, ay = seen_from(d2, cos, sin, hulls[np.uintp(one)], hulls[np.uintp(one + 1)])
                if side * (x * ay - y * ax) < 0.0:
                    best, x, y, moved = other, ax, ay, True
            if not moved:
                break
        stride >>= 1
    return x, y


@kernel(contracts=True, inline=True)
def climb(k, about, cells, hulls, wide, single, whole):  # type: ignore[no-untyped-def]
    """Replaces the silhouettes of one body that the two corners of its cell do not determine."""
    x, y, c, s = get(wide, k + X), get(wide, k + Y), get(wide, k + COS), get(wide, k + SIN)
    d2, cos, sin = x * x + y * y, c * x + s * y, s * x - c * y
    cell, skip = np.int64(get(whole, k + CELL)) * 4, np.int64(get(whole, k + HULL))
    corners = np.int64(peek(about, np.int64(get(whole, k + SHAPE)) + CORNERS))
    right, left = np.int64(peek(cells, cell + 2)), np.int64(peek(cells, cell + 3))
    if right < 0:
        first, stride = right & 0xFFFF, -(right >> 16)
        ax, ay = outermost(hulls, skip, corners, first, stride, d2, cos, sin, 1.0)
        put(single, k + ALONG, np.float32(ax))
        put(single, k + ACROSS, np.float32(ay))
    if left < 0:
        first, stride = left & 0xFFFF, -(left >> 16)
        ax, ay = outermost(hulls, skip, corners, first, stride, d2, cos, sin, -1.0)
        put(single, k + ALONG2, np.float32(ax))
        put(single, k + ACROSS2, np.float32(ay))
