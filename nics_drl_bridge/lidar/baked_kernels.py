"""Compiled inner loops of the baked lidar: look up and fuse (Eq. 3, 4).

A scan is made in passes over the bodies in sight, each pass a short loop without branches:
nearly all the time of a look-up is waiting, for a memory or after a wrong guess of a branch,
and so the waiting of one body overlaps with the work on the next.

Two rows, of the grid distances on both sides of the true one, are blended, and in each the two
points on both sides of a beam. Which beams hit
follows from the true silhouette, not from a row: a silhouette on the wrong side of a beam is
by far the largest error of a plain look-up.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nics_drl_bridge.lidar import kernels
from nics_drl_bridge.lidar.map_memory_kernels import get, peek, put
from nics_drl_bridge.lidar.block_kernels import BLOCK, lower_beam, lower_block, prefetch

LANES = 272
"""So many bodies, of several scans, go through the passes together; a multiple of `BLOCK`."""
WIDE, SINGLE, WHOLE = 19, 8, 16
X, Y, TURN, COS, SIN, AHEAD, RADIUS, ROUND, MIDDLE, RIGHT, LEFT, RIGHT_X, RIGHT_Y, RIGHT_X2, RIGHT_Y2, LEFT_X, LEFT_Y, LEFT_X2, LEFT_Y2 = (
    k * LANES for k in range(19)
)
DISTANCE, BEARING, ALONG, ACROSS, ALONG2, ACROSS2, PART, BLEND = (
    k * LANES for k in range(8)
)
ROW, SHAPE, START, FIRST, START2, FIRST2, BEGIN, HITS, NEAR, NEAR2, FAR, FAR2, CELL, HULL, CLIMB, BACK = (
    k * LANES for k in range(16)
)
PER_METRE, ROTATIONS, PARTS_PER_ROTATION, FIRST_CELL, CELLS_PER_PART, HULL_END, CORNERS_PER_PART, ROUND_RADIUS, CORNERS = range(9)
ABOUT = 16
AHEAD_OF = 8
ABOVE_ZERO = 2.0**24
"""Added before a number is cut to a whole one, so that it is rounded down."""
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




@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def in_sight(i, begin, end, bodies, n, row, me, sx, sy, ahead, range_max, baked, wide, whole):  # type: ignore[no-untyped-def]
    left, unknown = 0, 0
    n = np.uintp(n)
    for k in range(begin, end):
        b = np.uintp(k)
        dx, dy, radius = bodies[n, b, 0] - sx, bodies[n, b, 1] - sy, bodies[n, b, 5]
        d2 = dx * dx + dy * dy
        reach = range_max + radius
        known = (bodies[n, b, 6] >= 0.0) & (bodies[n, b, 6] < baked.shape[0])
        shape = int(bodies[n, b, 6]) if known else 0
        put(wide, i + X, dx)
        put(wide, i + Y, dy)
        put(wide, i + TURN, bodies[n, b, 2])
        put(wide, i + COS, bodies[n, b, 3])
        put(wide, i + SIN, bodies[n, b, 4])
        put(wide, i + AHEAD, ahead)
        put(wide, i + RADIUS, radius)
        put(whole, i + ROW, np.int32(row))
        put(whole, i + SHAPE, np.int32(shape * ABOUT))
        seen = known & (d2 <= reach * reach) & (radius > 0.0) & (k != me)
        kept = seen & (d2 >= radius * radius) & (baked[np.uintp(shape)] != 0)
        i += kept
        left += seen & (not kept)
        unknown += not known
    return i, left, unknown


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def left_out(bodies, n, k, me, sx, sy, range_max, baked):  # type: ignore[no-untyped-def]
    """Whether body k is in sight, but can't be looked up; see `in_sight`."""
    dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
    d2 = dx * dx + dy * dy
    reach = range_max + radius
    shape = bodies[n, k, 6]
    seen = shape >= 0.0 and shape < baked.shape[0] and k != me and d2 <= reach * reach and radius > 0.0
    return seen and (baked[int(bodies[n, k, 6])] == 0 or d2 < radius * radius)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def directions(padded, wide, single):  # type: ignore[no-untyped-def]
    for k in range(padded):
        i = k
        x, y = wide[i + X], wide[i + Y]
        single[i + ALONG], single[i + ACROSS] = x, y
        single[i + DISTANCE] = x * x + y * y
    for k in range(padded):
        i = k
        single[i + DISTANCE] = math.sqrt(single[i + DISTANCE])
        single[i + BEARING] = arctan2_single(single[i + ACROSS], single[i + ALONG])


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def outermost(hulls, skip, corners, first, stride, d2, cos, sin, side):  # type: ignore[no-untyped-def]
    """Climbs along a hull to its right (side 1) or left (-1) silhouette, as (along, across).

    Seen from outside, the direction of the corners rises and falls once around the hull: the best
    corner among its neighbours is the best of all. Only shapes of many corners need it, nearby.

    Args:
        hulls, skip, corners: the hull begins at `skip` and has so many corners.
        first: the corner to begin at.
        stride: to begin with, a power of 2.
        d2, cos, sin: of the shape, see `cells_of`.
        side: which.
    """
    best = first
    one = np.uintp(2) * np.uintp(skip + best)
    x = d2 + cos * hulls[one] - sin * hulls[one + np.uintp(1)]
    y = sin * hulls[one] + cos * hulls[one + np.uintp(1)]
    while stride > 0:
        for _ in range(corners):
            moved = False
            for step in (stride, corners - stride):
                other = best + step
                other -= corners if other >= corners else 0
                one = np.uintp(2) * np.uintp(skip + other)
                ax = d2 + cos * hulls[one] - sin * hulls[one + np.uintp(1)]
                ay = sin * hulls[one] + cos * hulls[one + np.uintp(1)]
                if side * (x * ay - y * ax) < 0.0:
                    best, x, y, moved = other, ax, ay, True
            if not moved:
                break
        stride >>= 1
    return x, y


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def cells_of(padded, distances, about, wide, single, whole):  # type: ignore[no-untyped-def]
    zero, last = np.int32(0), np.int32(distances - 2)
    for k in range(padded):
        h = get(whole, k + SHAPE)
        place = (get(single, k + DISTANCE) - get(wide, k + RADIUS)) * peek(about, h + PER_METRE)
        step = np.int32(max(min(np.int32(place), last), zero))
        put(single, k + BLEND, np.float32(place - step))
        share = (get(wide, k + TURN) - get(single, k + BEARING)) * PER_TURN
        share -= np.floor(share)
        rotations = peek(about, h + ROTATIONS)
        turn = np.int32(share * rotations + 0.5)
        turn = np.int32(max(min(turn, np.int32(rotations)), zero))  # a heading may be no number
        sector = np.int32((turn + 0.5) * peek(about, h + PARTS_PER_ROTATION))
        cell = peek(about, h + FIRST_CELL) + turn * distances - sector * peek(about, h + CELLS_PER_PART)
        put(whole, k + CELL, np.int32(np.int32(cell) + step))
        skip = peek(about, h + HULL_END) - sector * peek(about, h + CORNERS_PER_PART)
        put(whole, k + HULL, np.int32(skip))
        put(wide, k + ROUND, peek(about, h + ROUND_RADIUS))


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def fetch(found, cells, hulls, wide, whole):  # type: ignore[no-untyped-def]
    zero = np.int32(0)
    for k in range(found):
        cell, skip = np.int64(get(whole, k + CELL)) * 4, get(whole, k + HULL)
        put(whole, k + START, cells[np.uintp(cell)])
        put(whole, k + FIRST, cells[np.uintp(cell + 1)])
        put(whole, k + START2, cells[np.uintp(cell + 4)])
        put(whole, k + FIRST2, cells[np.uintp(cell + 5)])
        right, left = cells[np.uintp(cell + 2)], cells[np.uintp(cell + 3)]
        other, other2 = right >> 16, left >> 16
        put(whole, k + CLIMB, np.int32(other | other2))
        p = 2 * np.int64(skip + np.int32(right & 0xFFFF))
        put(wide, k + RIGHT_X, hulls[np.uintp(p)])
        put(wide, k + RIGHT_Y, hulls[np.uintp(p + 1)])
        p = 2 * np.int64(skip + np.int32(max(other, zero)))
        put(wide, k + RIGHT_X2, hulls[np.uintp(p)])
        put(wide, k + RIGHT_Y2, hulls[np.uintp(p + 1)])
        p = 2 * np.int64(skip + np.int32(left & 0xFFFF))
        put(wide, k + LEFT_X, hulls[np.uintp(p)])
        put(wide, k + LEFT_Y, hulls[np.uintp(p + 1)])
        p = 2 * np.int64(skip + np.int32(max(other2, zero)))
        put(wide, k + LEFT_X2, hulls[np.uintp(p)])
        put(wide, k + LEFT_Y2, hulls[np.uintp(p + 1)])


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def silhouettes(padded, wide, single):  # type: ignore[no-untyped-def]
    for k in range(padded):
        x, y, c, s = get(wide, k + X), get(wide, k + Y), get(wide, k + COS), get(wide, k + SIN)
        round_ = get(wide, k + ROUND)
        d2 = x * x + y * y
        cos, sin = c * x + s * y, s * x - c * y  # against the bearing, times d
        hx, hy = get(wide, k + RIGHT_X), get(wide, k + RIGHT_Y)
        ax, ay = d2 + cos * hx - sin * hy, sin * hx + cos * hy
        hx, hy = get(wide, k + RIGHT_X2), get(wide, k + RIGHT_Y2)
        bx, by = d2 + cos * hx - sin * hy, sin * hx + cos * hy
        outer = ax * by - ay * bx < 0.0
        ax, ay = bx if outer else ax, by if outer else ay
        tangent = math.sqrt(max(d2 - round_ * round_, 0.0))
        put(single, k + ALONG, np.float32(tangent if round_ > 0.0 else ax))
        put(single, k + ACROSS, np.float32(-round_ if round_ > 0.0 else ay))
        hx, hy = get(wide, k + LEFT_X), get(wide, k + LEFT_Y)
        ax, ay = d2 + cos * hx - sin * hy, sin * hx + cos * hy
        hx, hy = get(wide, k + LEFT_X2), get(wide, k + LEFT_Y2)
        bx, by = d2 + cos * hx - sin * hy, sin * hx + cos * hy
        outer = ax * by - ay * bx > 0.0
        ax, ay = bx if outer else ax, by if outer else ay
        put(single, k + ALONG2, np.float32(tangent if round_ > 0.0 else ax))
        put(single, k + ACROSS2, np.float32(round_ if round_ > 0.0 else ay))


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def climb(i, corners, cells, hulls, wide, single, whole):  # type: ignore[no-untyped-def]
    x, y, c, s = wide[i + X], wide[i + Y], wide[i + COS], wide[i + SIN]
    cos, sin, d2 = c * x + s * y, s * x - c * y, x * x + y * y
    cell, skip = np.uintp(whole[i + CELL]) * np.uintp(4), whole[i + HULL]
    right, left = cells[cell + np.uintp(2)], cells[cell + np.uintp(3)]
    first, other = right & 0xFFFF, right >> 16
    if other < 0:
        single[i + ALONG], single[i + ACROSS] = outermost(hulls, skip, corners, first, -other, d2, cos, sin, 1.0)
    first, other = left & 0xFFFF, left >> 16
    if other < 0:
        single[i + ALONG2], single[i + ACROSS2] = outermost(hulls, skip, corners, first, -other, d2, cos, sin, -1.0)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def climbs(found, about, cells, hulls, wide, single, whole):  # type: ignore[no-untyped-def]
    for k in range(found):
        i = k
        if whole[i + CLIMB] < 0:
            corners = int(about[np.uintp(whole[i + SHAPE] + CORNERS)])
            climb(i, corners, cells, hulls, wide, single, whole)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def edges(padded, single):  # type: ignore[no-untyped-def]
    for k in range(padded):
        i = k
        single[i + ALONG] = arctan2_single(single[i + ACROSS], single[i + ALONG])
        single[i + ALONG2] = arctan2_single(single[i + ACROSS2], single[i + ALONG2])


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def arctan2_single(y, x):  # type: ignore[no-untyped-def]
    """As `kernels.arctan2` in single precision, within 2e-7 rad."""
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
    r = np.float32(kernels.HALF_PI) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < np.float32(0.0) else r
    return math.copysign(r, y)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def spans(padded, beams, wide, single):  # type: ignore[no-untyped-def]
    """Bearing and both silhouettes in beams, the right one within the first turn."""
    per_beam = 1.0 / beams[1]
    turn = 2.0 * math.pi * per_beam
    per_turn = 1.0 / turn
    for k in range(padded):
        i = k
        low, high = single[i + ALONG] * per_beam, single[i + ALONG2] * per_beam
        middle = (single[i + BEARING] - wide[i + AHEAD]) * per_beam
        middle -= math.floor((middle + low) * per_turn) * turn
        wide[i + MIDDLE], wide[i + RIGHT], wide[i + LEFT] = middle, middle + low, middle + high


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def aim(k, count, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    one, zero = np.int32(1), np.int32(0)
    first, last, middle = get(wide, k + RIGHT), get(wide, k + LEFT), get(wide, k + MIDDLE)
    begin = np.int32(first)
    begin = np.int32(max(np.int32(begin + np.int32(first > begin)), zero))
    hits = np.int32(min(np.int32(last), np.int32(count - one)) - begin + one)
    phases = np.int32(one << shift)
    exact = (begin - middle) * phases + ABOVE_ZERO
    point = np.int32(exact)
    put(single, k + PART, np.float32(exact - point))
    point = np.int32(point - np.int32(ABOVE_ZERO))
    beam, phase = np.int32(point >> shift), np.int32(point & np.int32(phases - one))
    place, place2 = get(whole, k + FIRST), get(whole, k + FIRST2)
    low, low2 = np.int32(place >> 16), np.int32(place2 >> 16)
    width, width2 = np.int32(place & 0xFFFF), np.int32(place2 & 0xFFFF)
    skip = np.int32(max(min(np.int32(beam - low), np.int32(width - hits - one)), zero))
    skip2 = np.int32(max(min(np.int32(beam - low2), np.int32(width2 - hits - one)), zero))
    near = np.int32(get(whole, k + START) + phase * width + skip)
    far = np.int32(get(whole, k + START2) + phase * width2 + skip2)
    same = np.int32(phase + one) < phases
    two, block = np.int32(2 * BLOCK), np.int32(BLOCK)
    padded = np.int32(max(np.int32(hits + np.int32(block - one)) & np.int32(-block), two))
    back = np.int32(max(np.int32(begin + padded - count), zero))
    put(whole, k + NEAR, np.int32(near - back))
    put(whole, k + FAR, np.int32(far - back))
    put(whole, k + NEAR2, (np.int32(near + width) if same else np.int32(near - phase * width + one)) - back)
    put(whole, k + FAR2, (np.int32(far + width2) if same else np.int32(far - phase * width2 + one)) - back)
    put(whole, k + BEGIN, np.int32(begin - back))
    put(whole, k + HITS, hits)
    put(whole, k + BACK, back)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def aims(padded, count, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    for k in range(padded):
        aim(k, count, shift, wide, single, whole)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def lower(ranges, k, limits, rows, single, whole):  # type: ignore[no-untyped-def]
    """Lowers the beams of a span to the blended rows of its cell."""
    count = ranges.shape[2]
    begin, hits = np.int64(get(whole, k + BEGIN)), np.int64(get(whole, k + HITS))
    near, near2, far, far2 = np.int64(get(whole, k + NEAR)), np.int64(get(whole, k + NEAR2)), np.int64(get(whole, k + FAR)), np.int64(get(whole, k + FAR2))
    weights = get(single, k + PART), get(single, k + BLEND)
    at = np.int64(get(whole, k + ROW)) * count + begin
    back = get(whole, k + BACK)
    hit = np.int32(hits)
    if min(begin, near, far) >= 0:
        lower_block(ranges, at, rows, (near, near2, far, far2), weights, limits, (back, hit))
        j = BLOCK
        lower_block(ranges, at + j, rows, (near + j, near2 + j, far + j, far2 + j), weights, limits, (np.int32(back - j), hit))
        for j in range(2 * BLOCK, hits, BLOCK):
            lower_block(ranges, at + j, rows, (near + j, near2 + j, far + j, far2 + j), weights, limits, (np.int32(back - j), hit))
    else:
        j = np.int64(back)
        at, near, near2, far, far2 = at + j, near + j, near2 + j, far + j, far2 + j
        low, high = limits
        part, share = weights
        for j in range(hits):
            value, other = peek(rows, near + j), peek(rows, far + j)
            value += part * (peek(rows, near2 + j) - value)
            other += part * (peek(rows, far2 + j) - other)
            value += share * (other - value)
            value = value if value <= high else np.float32(np.inf)
            value = value if value >= low else np.float32(-np.inf)
            lower_beam(ranges, at + j, value)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def fuse(found, ranges, beams, limits, rows, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    turn = 2.0 * math.pi / beams[1]
    limits_ = np.float32(limits[0]), np.float32(limits[1])
    for k in range(found):
        near, far = np.int64(get(whole, k + AHEAD_OF + NEAR)), np.int64(get(whole, k + AHEAD_OF + FAR))
        prefetch(rows, near)
        prefetch(rows, far)
        prefetch(rows, near + BLOCK)
        prefetch(rows, far + BLOCK)
        if get(whole, k + HITS) > 0:
            lower(ranges, k, limits_, rows, single, whole)
    for k in range(found):
        if get(wide, k + LEFT) >= turn:  # over the seam once at most
            put(wide, k + MIDDLE, get(wide, k + MIDDLE) - turn)
            put(wide, k + RIGHT, get(wide, k + RIGHT) - turn)
            put(wide, k + LEFT, get(wide, k + LEFT) - turn)
            aim(k, np.int32(ranges.shape[2]), np.int32(shift), wide, single, whole)
            if get(whole, k + HITS) > 0:
                lower(ranges, k, limits_, rows, single, whole)


@njit(cache=True, error_model="numpy", _nrt=False)
def look_up(found, ranges, beams, limits, lookup, room):  # type: ignore[no-untyped-def]
    about, distances, cells, rows, shift, hulls = lookup
    wide, single, whole = room
    padded = (found + BLOCK - 1) // BLOCK * BLOCK
    directions(padded, wide, single)
    cells_of(padded, distances, about, wide, single, whole)
    fetch(found, cells, hulls, wide, whole)
    silhouettes(padded, wide, single)
    climbs(found, about, cells, hulls, wide, single, whole)
    edges(padded, single)
    spans(padded, beams, wide, single)
    aims(padded, np.int32(ranges.shape[2]), np.int32(shift), wide, single, whole)
    fuse(found, ranges, beams, limits, rows, shift, wide, single, whole)
