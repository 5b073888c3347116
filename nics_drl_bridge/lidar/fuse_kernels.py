"""Compiled inner loops of the baked lidar: fusion of the rows that were looked up (Eq. 4).

The two rows at the grid distances on either side of the true one are blended, and in each the two
points on either side of a beam. The beams that hit follow from the true silhouette, not from a row:
a silhouette on the wrong side of a beam is by far the largest error of a plain look-up.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.baked_kernels import (
    ACROSS,
    ACROSS2,
    AHEAD,
    ALONG,
    ALONG2,
    AT,
    BACK,
    BEARING,
    BEGIN,
    BLEND,
    CLIMB,
    FAR,
    FAR2,
    HITS,
    LEFT,
    MIDDLE,
    NEAR,
    NEAR2,
    PART,
    PLACE,
    PLACE2,
    RIGHT,
    START,
    START2,
    arctan2_single,
    cells_of,
    climb,
    directions,
    fetch,
    silhouettes,
)
from nics_drl_bridge.lidar.block_kernels import BLOCK, lower_beam, lower_block, prefetch
from nics_drl_bridge.lidar.map_kernels import get, peek, put

SOON = 8
"""Prefetch distance: the rows of the body this many lanes ahead are prefetched."""
ABOVE_ZERO = 2.0**24
"""Added before truncation to an integer, so that numbers are rounded down."""


@kernel(contracts=True)
def spans(padded, beams, wide, single):  # type: ignore[no-untyped-def]
    """Sixth pass: bearing and both silhouettes in beams, the right one in the first turn."""
    per_beam = 1.0 / beams[1]
    turn = 2.0 * math.pi * per_beam
    per_turn = 1.0 / turn
    for k in range(padded):
        put(single, k + ALONG, arctan2_single(get(single, k + ACROSS), get(single, k + ALONG)))
        put(single, k + ALONG2, arctan2_single(get(single, k + ACROSS2), get(single, k + ALONG2)))
    for k in range(padded):
        low, high = get(single, k + ALONG) * per_beam, get(single, k + ALONG2) * per_beam
        middle = (get(single, k + BEARING) - get(wide, k + AHEAD)) * per_beam
        middle -= np.floor((middle + low) * per_turn) * turn
        put(wide, k + MIDDLE, middle)
        put(wide, k + RIGHT, middle + low)
        put(wide, k + LEFT, middle + high)


@kernel(contracts=True, inline=True)
def aim(k, count, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    """Seventh pass, for one body: the beams that are hit, and the indices of their points.

    The span is fused in whole blocks, at least two: most need no more, and a varying number of
    blocks would mean a branch misprediction for every other body. Where the blocks would extend
    beyond the last of `count` beams, they begin `BACK` beams earlier.
    """
    zero, one, block = np.int32(0), np.int32(1), np.int32(BLOCK)
    first, last, middle = get(wide, k + RIGHT), get(wide, k + LEFT), get(wide, k + MIDDLE)
    begin = np.int32(first)  # conversion is faster than rounding up or down
    begin = np.int32(max(np.int32(begin + np.int32(first > begin)), zero))
    hits = np.int32(min(np.int32(last), np.int32(count - one)) - begin + one)
    phases = np.int32(one << shift)
    exact = (begin - middle) * phases + ABOVE_ZERO
    point = np.int32(exact)
    put(single, k + PART, np.float32(exact - point))
    point = np.int32(point - np.int32(ABOVE_ZERO))
    beam, phase = np.int32(point >> shift), np.int32(point & np.int32(phases - one))
    last_phase = np.int32(phase + one) == phases  # then the next point is of the next beam
    padded = np.int32(np.int32(hits + np.int32(block - one)) & np.int32(-block))
    padded = np.int32(max(padded, np.int32(2 * block)))
    back = np.int32(max(np.int32(begin + padded - count), zero))
    put(whole, k + BEGIN, np.int32(begin - back))
    put(whole, k + HITS, hits)
    put(whole, k + BACK, back)
    place, place2 = get(whole, k + PLACE), get(whole, k + PLACE2)
    width, width2 = np.int32(place & 0xFFFF), np.int32(place2 & 0xFFFF)
    skip = np.int32(min(np.int32(beam - (place >> 16)), np.int32(width - hits - one)))
    skip2 = np.int32(min(np.int32(beam - (place2 >> 16)), np.int32(width2 - hits - one)))
    near = np.int32(get(whole, k + START) + phase * width + max(skip, zero) - back)
    far = np.int32(get(whole, k + START2) + phase * width2 + max(skip2, zero) - back)
    put(whole, k + NEAR, near)
    put(whole, k + FAR, far)
    put(whole, k + NEAR2, np.int32(near - phase * width + one if last_phase else near + width))
    put(whole, k + FAR2, np.int32(far - phase * width2 + one if last_phase else far + width2))


@kernel(contracts=True)
def aims(padded, count, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    """Seventh pass, see `aim`."""
    for k in range(padded):
        aim(k, count, shift, wide, single, whole)


@kernel(contracts=True, inline=True)
def lower(ranges, k, limits, rows, wide, single, whole):  # type: ignore[no-untyped-def]
    """Last pass, for one body: lowers the beams of its span to the blended rows of its cell."""
    begin, hits, back = get(whole, k + BEGIN), get(whole, k + HITS), get(whole, k + BACK)
    near, near2 = np.int64(get(whole, k + NEAR)), np.int64(get(whole, k + NEAR2))
    far, far2 = np.int64(get(whole, k + FAR)), np.int64(get(whole, k + FAR2))
    weights = get(single, k + PART), get(single, k + BLEND)
    at, points = np.int64(get(wide, k + AT)) + begin, (near, near2, far, far2)
    if hits <= 0:
        return
    if (
        min(begin, near, near2, far, far2) >= 0
    ):  # the point after a row's last phase is in its first
        lower_block(ranges, at, rows, points, 0, weights, limits, (back, hits))
        lower_block(ranges, at, rows, points, BLOCK, weights, limits, (back, hits))
        for j in range(2 * BLOCK, hits, BLOCK):
            lower_block(ranges, at, rows, points, j, weights, limits, (back, hits))
    else:  # no block fits: few beams, or a span at the last beams and the table's first row
        for j in range(back, back + hits):
            value, other = peek(rows, near + j), peek(rows, far + j)
            value += weights[0] * (peek(rows, near2 + j) - value)
            other += weights[0] * (peek(rows, far2 + j) - other)
            value += weights[1] * (other - value)
            value = value if value <= limits[1] else np.float32(np.inf)
            value = value if value >= limits[0] else np.float32(-np.inf)
            lower_beam(ranges, at + j, value)


@kernel(contracts=True)
def fuse(found, ranges, beams, limits, rows, shift, wide, single, whole):  # type: ignore[no-untyped-def]
    """Last pass: all spans, and a second time those across the seam of the turn."""
    turn, count = 2.0 * math.pi / beams[1], np.int32(ranges.shape[2])
    within = np.float32(limits[0]), np.float32(limits[1])
    for k in range(found):
        soon = min(k + SOON, found - 1)
        near, far = np.int64(get(whole, soon + NEAR)), np.int64(get(whole, soon + FAR))
        for line in (0, BLOCK):
            prefetch(rows, near + line)
            prefetch(rows, far + line)
        lower(ranges, k, within, rows, wide, single, whole)
    for k in range(found):
        if get(wide, k + LEFT) >= turn:
            for each in (MIDDLE, RIGHT, LEFT):
                put(wide, k + each, get(wide, k + each) - turn)
            aim(k, count, np.int32(shift), wide, single, whole)
            lower(ranges, k, within, rows, wide, single, whole)


@kernel
def look_up(found, ranges, beams, limits, lookup, room):  # type: ignore[no-untyped-def]
    """All passes after the first: fuses the bodies on the lanes into their scans.

    Args:
        found: number of lanes in use.
        ranges: (N, M, B) in place.
        beams, limits, lookup: see `scanner.Scanner.arguments`.
        room: see `scanner.Scanner.room`.
    """
    about, distances, cells, rows, shift, hulls = lookup
    wide, single, whole = room
    padded = (found + BLOCK - 1) // BLOCK * BLOCK
    directions(padded, wide, single)
    cells_of(padded, distances, about, wide, single, whole)
    fetch(found, cells, hulls, wide, whole)
    silhouettes(padded, wide, single)
    for k in range(found):
        if get(whole, k + CLIMB) < 0:
            climb(k, about, cells, hulls, wide, single, whole)
    spans(padded, beams, wide, single)
    aims(padded, np.int32(ranges.shape[2]), np.int32(shift), wide, single, whole)
    fuse(found, ranges, beams, limits, rows, shift, wide, single, whole)
