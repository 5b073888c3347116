"""Compiled inner loops of the baked lidar: look up and fuse (Eq. 3, 4).

A scan is made in passes over the bodies in sight, each pass a short loop without branches:
nearly all the time of a look-up is waiting, for a memory or after a wrong guess of a branch,
and so the waiting of one body overlaps with the work on the next.

Two rows, of the grid distances on both sides of the true one, are blended. A row is stored at
`fine` points per beam, so that the bearing is met to 1/(2 fine) of a beam. Which beams hit
follows from the true silhouette, not from a row: a silhouette on the wrong side of a beam is
by far the largest error of a plain look-up.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

BLOCK = 16
"""So many beams are fused at once; rows and lines are that much longer than their content."""
COLUMNS = 11
"""Numbers per body that one pass hands to the next, see `scan`."""
HALF_PI = 0.5 * math.pi
ATAN = (
    0.9999999996145,
    -0.3333332366563,
    0.1999959585417,
    -0.1427904841688,
    0.1105378475317,
    -0.0879611755717,
    0.0671011398839,
    -0.0442736682632,
    0.0222034549106,
    -0.0071661648959,
    0.0010844927512,
)


@njit(cache=True, error_model="numpy")
def arctan2(y, x):  # type: ignore[no-untyped-def]
    """The angle of (x, y) within 3e-10 rad, without a branch and so many at a time.

    A polynomial in the square of the smaller over the larger, fitted at Chebyshev's nodes.
    """
    ax, ay = abs(x), abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    s = ratio * ratio
    r = ATAN[10]
    r = r * s + ATAN[9]
    r = r * s + ATAN[8]
    r = r * s + ATAN[7]
    r = r * s + ATAN[6]
    r = r * s + ATAN[5]
    r = r * s + ATAN[4]
    r = r * s + ATAN[3]
    r = r * s + ATAN[2]
    r = r * s + ATAN[1]
    r = (r * s + ATAN[0]) * ratio
    r = HALF_PI - r if ay > ax else r
    r = math.pi - r if x < 0.0 else r
    return math.copysign(r, y)


@njit(cache=True, error_model="numpy")
def in_sight(bodies, n, me, sx, sy, range_max, baked, work, cells):  # type: ignore[no-untyped-def]
    """First pass: packs the bodies in sight, offset and squared distance: rows 0 to 2 of work.

    Args:
        bodies: (N, K, 7), see `shapes.BODY`.
        n: which world.
        me: the body that carries the lidar, or -1.
        sx, sy: of the lidar in the world [m].
        range_max: [m].
        baked: (H,) whether a shape is to be looked up.
        work: (COLUMNS, K + BLOCK) scratch, numbers of each body.
        cells: (2, K + BLOCK) scratch: which body, and which cell of the table.

    Returns:
        How many can be looked up, and how many in sight can't: not baked, or so near that the
        lidar is within their circle.
    """
    found, left = 0, 0
    for k in range(bodies.shape[1]):
        dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
        d2 = dx * dx + dy * dy
        reach = range_max + radius
        work[0, found], work[1, found], work[2, found] = dx, dy, d2
        cells[0, found] = k
        seen = (d2 <= reach * reach) & (radius > 0.0) & (k != me)
        kept = seen & (d2 >= radius * radius) & (baked[int(bodies[n, k, 6])] != 0)
        found += kept
        left += seen & (not kept)
    return found, left


@njit(cache=True, error_model="numpy")
def left_out(bodies, n, k, me, sx, sy, range_max, baked):  # type: ignore[no-untyped-def]
    """Whether body k is in sight, but can't be looked up; see `in_sight`."""
    dx, dy, radius = bodies[n, k, 0] - sx, bodies[n, k, 1] - sy, bodies[n, k, 5]
    d2 = dx * dx + dy * dy
    reach = range_max + radius
    seen = radius > 0.0 and k != me and d2 <= reach * reach
    return seen and (baked[int(bodies[n, k, 6])] == 0 or d2 < radius * radius)


@njit(cache=True, error_model="numpy")
def directions(found, work):  # type: ignore[no-untyped-def]
    """Second pass: distance and bearing in the world of each: rows 2 and 3."""
    x, y, distance, bearing = work[0], work[1], work[2], work[3]
    for k in range(found):
        distance[k] = math.sqrt(distance[k])
        bearing[k] = arctan2(y[k], x[k])


@njit(cache=True, error_model="numpy")
def cells_of(found, bodies, n, shape_of, cell_of, hulls, work, cells):  # type: ignore[no-untyped-def]
    """Third pass: which cell each looks up, and its two silhouettes as (along, across).

    The silhouette is exact: of two corners that it can be within the cell, the outer one.
    """
    for k in range(found):
        b = cells[0, k]
        dx, dy, distance = work[0, k], work[1, k], work[2, k]
        c, s, h = bodies[n, b, 3], bodies[n, b, 4], int(bodies[n, b, 6])
        radius, distances, turns, parts = (
            shape_of[h, 0],
            shape_of[h, 2],
            shape_of[h, 4],
            shape_of[h, 5],
        )
        place = (distance - radius) * shape_of[h, 1]
        step = min(math.floor(place), distances - 2.0)
        turn = (bodies[n, b, 2] - work[3, k]) * shape_of[h, 3] + 0.5
        turn = max(math.floor(turn - turns * parts * math.floor(turn * shape_of[h, 6])), 0.0)
        sector = math.floor((turn + 0.5) * shape_of[h, 6] * parts)
        cell = int(shape_of[h, 7] + (turn - sector * turns) * distances + step)
        skip = int(shape_of[h, 8] + (parts - sector) * shape_of[h, 9])
        cos, sin = c * dx + s * dy, s * dx - c * dy  # of the shape against its bearing, times d
        one = np.uintp(skip + cell_of[cell, 2])
        right_x = distance * distance + cos * hulls[one, 0] - sin * hulls[one, 1]
        right_y = sin * hulls[one, 0] + cos * hulls[one, 1]
        if cell_of[cell, 3] != cell_of[cell, 2]:
            one = np.uintp(skip + cell_of[cell, 3])
            x = distance * distance + cos * hulls[one, 0] - sin * hulls[one, 1]
            y = sin * hulls[one, 0] + cos * hulls[one, 1]
            outer = right_x * y - right_y * x < 0.0
            right_x, right_y = x if outer else right_x, y if outer else right_y
        one = np.uintp(skip + cell_of[cell, 4])
        left_x = distance * distance + cos * hulls[one, 0] - sin * hulls[one, 1]
        left_y = sin * hulls[one, 0] + cos * hulls[one, 1]
        if cell_of[cell, 5] != cell_of[cell, 4]:
            one = np.uintp(skip + cell_of[cell, 5])
            x = distance * distance + cos * hulls[one, 0] - sin * hulls[one, 1]
            y = sin * hulls[one, 0] + cos * hulls[one, 1]
            outer = left_x * y - left_y * x > 0.0
            left_x, left_y = x if outer else left_x, y if outer else left_y
        tangent = math.sqrt(max(distance * distance - radius * radius, 0.0))
        round_ = shape_of[h, 10] > 0.0
        work[4, k], work[5, k] = tangent if round_ else right_x, -radius if round_ else right_y
        work[6, k], work[7, k] = tangent if round_ else left_x, radius if round_ else left_y
        work[8, k] = place - step
        cells[1, k] = cell


@njit(cache=True, error_model="numpy")
def spans(found, heading, beams, work):  # type: ignore[no-untyped-def]
    """Fourth pass: bearing and both silhouettes in beams, the right one within the first turn."""
    per_beam = 1.0 / beams[1]
    turn = 2.0 * math.pi * per_beam
    rx, ry, lx, ly = work[4], work[5], work[6], work[7]
    bearing, right, left = work[3], work[9], work[10]
    for k in range((found + 15) // 16 * 16):
        low = arctan2(ry[k], rx[k]) * per_beam
        high = arctan2(ly[k], lx[k]) * per_beam
        middle = (bearing[k] - heading - beams[0]) * per_beam
        middle -= math.floor((middle + low) / turn) * turn
        bearing[k], right[k], left[k] = middle, middle + low, middle + high


@njit(cache=True, error_model="numpy")
def fuse(line, found, beams, row_of, cell_of, rows, shift, work, cells):  # type: ignore[no-untyped-def]
    """Last pass: lowers the beams of every span to the blended rows of its cell."""
    phases = 1 << shift
    nothing = np.float32(np.inf)
    turn = 2.0 * math.pi / beams[1]
    last = int(beams[3]) - 1
    for k in range(found):
        middle, right, left, cell = work[3, k], work[9, k], work[10, k], cells[1, k]
        blend = np.float32(work[8, k])
        while True:
            begin = max(math.ceil(right), 0)
            hits = min(math.floor(left), last) - begin + 1
            if hits > 0:
                point = math.floor((begin - middle) * phases + 0.5)
                beam, phase = point >> shift, point & (phases - 1)
                width, width2 = cell_of[cell, 1], cell_of[cell + 1, 1]
                skip = max(min(beam - cell_of[cell, 0], width - hits), 0)
                skip2 = max(min(beam - cell_of[cell + 1, 0], width2 - hits), 0)
                near = row_of[cell] + phase * width + skip
                far = row_of[cell + 1] + phase * width2 + skip2
                for i in range((hits + BLOCK - 1) // BLOCK * BLOCK):
                    value = rows[np.uintp(near + i)]
                    value += blend * (rows[np.uintp(far + i)] - value)
                    value = value if i < hits else nothing
                    held = line[np.uintp(begin + i)]
                    line[np.uintp(begin + i)] = value if value < held else held
            if left < turn:
                break
            middle, right, left = middle - turn, right - turn, left - turn
