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

BLOCK = 16
"""So many beams are fused at once; rows and lines are that much longer than their content."""
DOUBLES, SINGLES, WHOLES = 6, 5, 2
"""Numbers per body that one pass hands to the next, by their kind."""
ABOVE_ZERO = 2.0**24
"""Added before a number is cut to a whole one, so that it is rounded down."""
PER_TURN = 0.5 / math.pi
SINGLE = tuple(
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
def in_sight(bodies, n, me, sx, sy, range_max, baked, which, x, y, distance):  # type: ignore[no-untyped-def]
    """First pass: packs the bodies in sight: which, offset, and the square of the distance.

    Args:
        bodies: (N, K, 7), see `shapes.BODY`.
        n: which world.
        me: the body that carries the lidar, or -1.
        sx, sy: of the lidar in the world [m].
        range_max: [m].
        baked: (H,) whether a shape is to be looked up.
        which, x, y, distance: results, of the first bodies only.

    Returns:
        How many can be looked up, and how many in sight can't: not baked, or so near that the
        lidar is within their circle.
    """
    n = np.uintp(n)
    found, left = 0, 0
    for k in range(bodies.shape[1]):
        dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
        d2 = dx * dx + dy * dy
        reach = range_max + radius
        which[found], x[found], y[found], distance[found] = k, dx, dy, d2
        seen = (d2 <= reach * reach) & (radius > 0.0) & (k != me)
        kept = seen & (d2 >= radius * radius) & (baked[np.uintp(bodies[n, k, 6])] != 0)
        found += kept
        left += seen & (not kept)
    return found, left


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def left_out(bodies, n, k, me, sx, sy, range_max, baked):  # type: ignore[no-untyped-def]
    """Whether body k is in sight, but can't be looked up; see `in_sight`."""
    dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
    d2 = dx * dx + dy * dy
    reach = range_max + radius
    seen = radius > 0.0 and k != me and d2 <= reach * reach
    return seen and (baked[int(bodies[n, k, 6])] == 0 or d2 < radius * radius)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def directions(found, x, y, distance, bearing):  # type: ignore[no-untyped-def]
    """Second pass: distance and bearing in the world of each."""
    for k in range((found + BLOCK - 1) // BLOCK * BLOCK):
        distance[k] = math.sqrt(distance[k])
        bearing[k] = kernels.arctan2(y[k], x[k])


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
    one = np.uintp(skip + best)
    x = d2 + cos * hulls[one, 0] - sin * hulls[one, 1]
    y = sin * hulls[one, 0] + cos * hulls[one, 1]
    while stride > 0:
        for _ in range(corners):
            moved = False
            for step in (stride, corners - stride):
                other = best + step
                other -= corners if other >= corners else 0
                one = np.uintp(skip + other)
                ax = d2 + cos * hulls[one, 0] - sin * hulls[one, 1]
                ay = sin * hulls[one, 0] + cos * hulls[one, 1]
                if side * (x * ay - y * ax) < 0.0:
                    best, x, y, moved = other, ax, ay, True
            if not moved:
                break
        stride >>= 1
    return x, y


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def cells_of(  # type: ignore[no-untyped-def]
    found, bodies, n, limits, shape_of, grid_of, cell_of, hulls, which, x, y, distance, bearing,
    rx, ry, lx, ly, blend, cell_at,
):  # fmt: skip
    """Third pass: which cell each looks up, and its two silhouettes as (along, across).

    The silhouette is exact: of the corners that it can be within the cell, the outermost.
    """
    for k in range(found):
        b = np.uintp(which[k])
        h = np.uintp(bodies[n, b, 6])
        d, radius, distances = distance[k], shape_of[h, 0], grid_of[h, 0]
        place = (d - radius) * shape_of[h, 1]
        step = min(int(place), distances - 2)
        blend[k] = place - step
        which[k] = (d + radius > limits[1]) | (d - radius < limits[0])
        parts = grid_of[h, 2]
        if parts == 0:
            lx[k], ly[k] = math.sqrt(max(d * d - radius * radius, 0.0)), radius
            rx[k], ry[k] = lx[k], -radius
            cell_at[k] = grid_of[h, 3] + step
            continue
        share = (bodies[n, b, 2] - bearing[k]) * PER_TURN
        turn = int((share - math.floor(share)) * shape_of[h, 2] + 0.5)
        sector = int((turn + 0.5) * shape_of[h, 3])
        cell = np.uintp(grid_of[h, 3] + (turn - sector * grid_of[h, 1]) * distances + step)
        cell_at[k] = cell
        skip = grid_of[h, 4] + (parts - sector) * grid_of[h, 5]
        c, s = bodies[n, b, 3], bodies[n, b, 4]
        cos, sin = c * x[k] + s * y[k], s * x[k] - c * y[k]  # against the bearing, times d
        corners = grid_of[h, 5] * parts
        first, other = cell_of[cell, 2], cell_of[cell, 3]
        one = np.uintp(skip + first)
        right_x = d * d + cos * hulls[one, 0] - sin * hulls[one, 1]
        right_y = sin * hulls[one, 0] + cos * hulls[one, 1]
        if other < 0:
            right_x, right_y = outermost(hulls, skip, corners, first, -other, d * d, cos, sin, 1.0)
        elif other != first:
            one = np.uintp(skip + other)
            ax = d * d + cos * hulls[one, 0] - sin * hulls[one, 1]
            ay = sin * hulls[one, 0] + cos * hulls[one, 1]
            outer = right_x * ay - right_y * ax < 0.0
            right_x, right_y = ax if outer else right_x, ay if outer else right_y
        first, other = cell_of[cell, 4], cell_of[cell, 5]
        one = np.uintp(skip + first)
        left_x = d * d + cos * hulls[one, 0] - sin * hulls[one, 1]
        left_y = sin * hulls[one, 0] + cos * hulls[one, 1]
        if other < 0:
            left_x, left_y = outermost(hulls, skip, corners, first, -other, d * d, cos, sin, -1.0)
        elif other != first:
            one = np.uintp(skip + other)
            ax = d * d + cos * hulls[one, 0] - sin * hulls[one, 1]
            ay = sin * hulls[one, 0] + cos * hulls[one, 1]
            outer = left_x * ay - left_y * ax > 0.0
            left_x, left_y = ax if outer else left_x, ay if outer else left_y
        rx[k], ry[k], lx[k], ly[k] = right_x, right_y, left_x, left_y


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"})
def arctan2_single(y, x):  # type: ignore[no-untyped-def]
    """As `kernels.arctan2` in single precision, within 2e-7 rad."""
    ax, ay = abs(x), abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    s = ratio * ratio
    r = SINGLE[7]
    r = r * s + SINGLE[6]
    r = r * s + SINGLE[5]
    r = r * s + SINGLE[4]
    r = r * s + SINGLE[3]
    r = r * s + SINGLE[2]
    r = r * s + SINGLE[1]
    r = (r * s + SINGLE[0]) * ratio
    r = np.float32(kernels.HALF_PI) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < np.float32(0.0) else r
    return math.copysign(r, y)


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def spans(found, heading, beams, rx, ry, lx, ly, bearing, right, left):  # type: ignore[no-untyped-def]
    """Fourth pass: bearing and both silhouettes in beams, the right one within the first turn."""
    per_beam = 1.0 / beams[1]
    turn = 2.0 * math.pi * per_beam
    per_turn = 1.0 / turn
    padded = (found + BLOCK - 1) // BLOCK * BLOCK
    for k in range(padded):
        rx[k] = arctan2_single(ry[k], rx[k])
    for k in range(padded):
        lx[k] = arctan2_single(ly[k], lx[k])
    for k in range(padded):
        low, high = rx[k] * per_beam, lx[k] * per_beam
        middle = (bearing[k] - heading - beams[0]) * per_beam
        middle -= math.floor((middle + low) * per_turn) * turn
        bearing[k], right[k], left[k] = middle, middle + low, middle + high


@njit(cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True)
def fuse(  # type: ignore[no-untyped-def]
    ranges, n, m, found, beams, limits, row_of, cell_of, rows, shift, bearing, right, left, blend,
    which, cell_at,
):  # fmt: skip
    """Last pass: lowers the beams of every span to the blended rows of its cell."""
    phases = 1 << shift
    nothing, close = np.float32(np.inf), np.float32(-np.inf)
    low, high = np.float32(limits[0]), np.float32(limits[1])
    turn = 2.0 * math.pi / beams[1]
    count = ranges.shape[2]
    for k in range(found):
        middle, first, last, cell = bearing[k], right[k], left[k], np.uintp(cell_at[k])
        next_cell, share, limited = cell + np.uintp(1), blend[k], which[k] != 0
        for _ in range(2):  # over the seam once at most, and no end where a pose is not a number
            begin = int(first)  # to convert is faster than to round up or down
            begin = max(begin + (first > begin), 0)
            hits = min(int(last), count - 1) - begin + 1
            if hits > 0:
                exact = (begin - middle) * phases + ABOVE_ZERO
                point = int(exact)
                part = np.float32(exact - point)
                point -= int(ABOVE_ZERO)
                beam, phase = point >> shift, point & (phases - 1)
                width, width2 = cell_of[cell, 1], cell_of[next_cell, 1]
                skip = max(min(beam - cell_of[cell, 0], width - hits - 1), 0)
                skip2 = max(min(beam - cell_of[next_cell, 0], width2 - hits - 1), 0)
                near = row_of[cell] + phase * width + skip
                far = row_of[next_cell] + phase * width2 + skip2
                same = phase + 1 < phases  # the next point: of the next phase, or beam
                near2 = near + width if same else near - phase * width + 1
                far2 = far + width2 if same else far - phase * width2 + 1
                padded = (hits + BLOCK - 1) // BLOCK * BLOCK
                if limited or begin + padded > count:
                    for i in range(hits):
                        value, other = rows[np.uintp(near + i)], rows[np.uintp(far + i)]
                        value += part * (rows[np.uintp(near2 + i)] - value)
                        other += part * (rows[np.uintp(far2 + i)] - other)
                        value += share * (other - value)
                        value = value if value <= high else nothing
                        value = value if value >= low else close
                        held = ranges[n, m, np.uintp(begin + i)]
                        ranges[n, m, np.uintp(begin + i)] = value if value < held else held
                else:
                    for i in range(np.int32(padded)):
                        value, other = rows[np.uintp(near + i)], rows[np.uintp(far + i)]
                        value += part * (rows[np.uintp(near2 + i)] - value)
                        other += part * (rows[np.uintp(far2 + i)] - other)
                        value += share * (other - value)
                        value = value if i < np.int32(hits) else nothing
                        held = ranges[n, m, np.uintp(begin + i)]
                        ranges[n, m, np.uintp(begin + i)] = value if value < held else held
            if last < turn:
                break
            middle, first, last = middle - turn, first - turn, last - turn
