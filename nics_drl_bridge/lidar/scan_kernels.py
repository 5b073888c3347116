"""Fast path of the look-up: what `scan_kernels.look_up` does to one body, to many in short passes.

Nearly all time of a look-up goes into cache misses, branch mispredictions and latencies. Here the
visible bodies of several scans go through each step together, in loops without branches that LLVM
turns into vector instructions. Steps hand on their results in lanes: one array for each type of
number, in which every quantity has `LANES` places from a constant on, so that LLVM can prove that
they do not overlap. Scans are those of `look_up` to the bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import baked_kernels as scalar
from nics_drl_bridge.lidar import exact_kernels, map_kernels
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SHAPE, SIN, LidarPose, X, Y

LANES = 144
BLOCK = 16
"""Beams that are fused at once."""
DX, DY, TURNED, COSINE, SINE, ROUND, AHEAD, AT, MIDDLE, LOW, HIGH = (
    np.uintp(k * LANES) for k in range(11)
)
RX, RY, RX2, RY2, LX, LY, LX2, LY2, WIDE = (np.uintp(k * LANES) for k in range(11, 20))
DISTANCE, BEARING, PART, BLEND, SINGLE = (np.uintp(k * LANES) for k in range(5))
KIND, CELL, HULL, CLIMB, START, PLACE, START2, PLACE2, BEGIN, HITS, BACK = (
    np.uintp(k * LANES) for k in range(11)
)
ONE, TWO, OTHER, OTHER2, WHOLE = (np.uintp(k * LANES) for k in range(11, 16))


class Lanes(NamedTuple):
    wide: NDArray[np.float64]
    single: NDArray[np.float32]
    whole: NDArray[np.int32]


def lanes():
    return Lanes(np.zeros(WIDE), np.zeros(SINGLE, np.float32), np.zeros(WHOLE, np.int32))


@kernel(contracts=True, inline=True)
def select(found, begin, end, bodies, me, here, lidar, lanes):  # type: ignore[no-untyped-def]
    wide, whole = lanes.wide, lanes.whole
    left = 0
    for j in range(begin, end):
        b, k = np.uintp(j), np.uintp(found)
        dx, dy, radius = bodies[b, X] - here.x, bodies[b, Y] - here.y, bodies[b, RADIUS]
        d2, reach = dx * dx + dy * dy, lidar.range_max + radius
        shape = np.int32(bodies[b, SHAPE])
        wide[k + DX], wide[k + DY], wide[k + TURNED] = dx, dy, bodies[b, HEADING]
        wide[k + COSINE], wide[k + SINE] = bodies[b, COS], bodies[b, SIN]
        wide[k + ROUND], wide[k + AHEAD], wide[k + AT] = radius, here.heading, here.at
        whole[k + KIND] = shape
        seen = (d2 <= reach * reach) & (radius > 0.0) & (j != me)
        h = np.uintp(shape)
        kept = seen & (d2 >= radius * radius)
        kept &= (d2 >= lidar.between[h, 0]) & (d2 <= lidar.between[h, 1])
        found += kept
        left += seen & (not kept)
    return found, left


@kernel(contracts=True)
def directions(padded, lanes):
    wide, single = lanes.wide, lanes.single
    for j in range(padded):
        k = np.uintp(j)
        single[k + DISTANCE], single[k + BEARING] = scalar.polar(wide[k + DX], wide[k + DY])


@kernel(contracts=True)
def cells(found, table, lanes):
    wide, single, whole = lanes.wide, lanes.single, lanes.whole
    for j in range(found):
        k = np.uintp(j)
        shape = table.shapes[np.uintp(whole[k + KIND])]
        cell, hull, blend = scalar.nearest_cell(
            single[k + DISTANCE], single[k + BEARING], wide[k + ROUND], wide[k + TURNED], shape, table
        )
        whole[k + CELL], whole[k + HULL], single[k + BLEND] = cell, hull, blend
        wide[k + ROUND] = shape.round_radius


@kernel(contracts=True)
def fetch(found, table, lanes):
    wide, whole, hulls = lanes.wide, lanes.whole, table.hulls
    for j in range(found):
        k = np.uintp(j)
        cell, hull = np.uintp(whole[k + CELL]), whole[k + HULL]
        whole[k + START], whole[k + PLACE] = table.cells[cell, 0], table.cells[cell, 1]
        right, left = table.cells[cell, 2], table.cells[cell, 3]
        cell += np.uintp(1)
        whole[k + START2], whole[k + PLACE2] = table.cells[cell, 0], table.cells[cell, 1]
        other, other2 = right >> 16, left >> 16
        whole[k + CLIMB] = other | other2
        corner = np.uintp(hull + (right & 0xFFFF))
        wide[k + RX], wide[k + RY] = hulls[corner, 0], hulls[corner, 1]
        corner = np.uintp(hull + max(other, 0))
        wide[k + RX2], wide[k + RY2] = hulls[corner, 0], hulls[corner, 1]
        corner = np.uintp(hull + (left & 0xFFFF))
        wide[k + LX], wide[k + LY] = hulls[corner, 0], hulls[corner, 1]
        corner = np.uintp(hull + max(other2, 0))
        wide[k + LX2], wide[k + LY2] = hulls[corner, 0], hulls[corner, 1]


@kernel(contracts=True)
def spans(padded, beams, lanes):
    wide, single = lanes.wide, lanes.single
    for j in range(padded):
        k = np.uintp(j)
        dx, dy, c, s = wide[k + DX], wide[k + DY], wide[k + COSINE], wide[k + SINE]
        seen = scalar.Seen(dx * dx + dy * dy, c * dx + s * dy, s * dx - c * dy)
        radius = wide[k + ROUND]
        right = scalar.tangent(
            seen, wide[k + RX], wide[k + RY], wide[k + RX2], wide[k + RY2], radius, 1.0
        )
        left = scalar.tangent(
            seen, wide[k + LX], wide[k + LY], wide[k + LX2], wide[k + LY2], radius, -1.0
        )
        wide[k + MIDDLE], wide[k + LOW], wide[k + HIGH] = scalar.in_beams(
            right, left, single[k + BEARING], wide[k + AHEAD], beams
        )


@kernel(contracts=True)
def climb(k, lidar, lanes):
    wide, single, whole, table = lanes.wide, lanes.single, lanes.whole, lidar.table
    dx, dy, c, s = wide[k + DX], wide[k + DY], wide[k + COSINE], wide[k + SINE]
    seen = scalar.Seen(dx * dx + dy * dy, c * dx + s * dy, s * dx - c * dy)
    shape, pairs = table.shapes[np.uintp(whole[k + KIND])], table.cells[np.uintp(whole[k + CELL])]
    right = scalar.silhouette(pairs[2], whole[k + HULL], shape, table.hulls, seen, 1.0)
    left = scalar.silhouette(pairs[3], whole[k + HULL], shape, table.hulls, seen, -1.0)
    wide[k + MIDDLE], wide[k + LOW], wide[k + HIGH] = scalar.in_beams(
        right, left, single[k + BEARING], wide[k + AHEAD], lidar.beams
    )


@kernel(contracts=True, inline=True)
def aim(k, count, shift, lanes):
    wide, single, whole = lanes.wide, lanes.single, lanes.whole
    begin, hits = scalar.beams_between(wide[k + LOW], wide[k + HIGH], count)
    exact = (begin - wide[k + MIDDLE]) * np.int32(1 << shift) + scalar.ABOVE_ZERO
    point = np.int32(exact)
    single[k + PART] = np.float32(exact - point)
    point = np.int32(point - np.int32(scalar.ABOVE_ZERO))
    padded = np.int32(np.int32(hits + np.int32(BLOCK - 1)) & np.int32(-BLOCK))
    padded = np.int32(max(padded, np.int32(2 * BLOCK)))
    back = np.int32(max(np.int32(begin + padded - count), np.int32(0)))
    whole[k + BEGIN], whole[k + HITS], whole[k + BACK] = np.int32(begin - back), hits, back
    one, two = scalar.points_of(whole[k + START], whole[k + PLACE], point, shift, hits)
    whole[k + ONE], whole[k + TWO] = np.int32(one - back), np.int32(two - back)
    one, two = scalar.points_of(whole[k + START2], whole[k + PLACE2], point, shift, hits)
    whole[k + OTHER], whole[k + OTHER2] = np.int32(one - back), np.int32(two - back)


@kernel(contracts=True)
def aims(padded, count, shift, lanes):
    for j in range(padded):
        aim(np.uintp(j), count, shift, lanes)


@kernel(contracts=True, inline=True)
def lower(ranges, k, lidar, lanes):
    whole, single, rows = lanes.whole, lanes.single, lidar.table.rows
    low, high = np.float32(lidar.range_min), np.float32(lidar.range_max)
    hits, back, begin = whole[k + HITS], whole[k + BACK], whole[k + BEGIN]
    one, two, other, other2 = whole[k + ONE], whole[k + TWO], whole[k + OTHER], whole[k + OTHER2]
    share, blend = single[k + PART], single[k + BLEND]
    if hits <= 0:
        return
    least = min(begin, min(one, two), min(other, other2))
    skip = 0 if least >= 0 else back
    at = np.uintp(np.int64(lanes.wide[k + AT]) + begin + skip)
    a, b, c, d = np.uintp(one + skip), np.uintp(two + skip), np.uintp(other + skip), np.uintp(other2 + skip)
    n = hits + back if skip == 0 else hits
    back -= skip
    if skip == 0:
        place = np.int32(-back)
        for j in range(max((n + 15) >> 4, 2) << 4):
            i = np.uintp(j)
            value = scalar.blended(rows, a + i, b + i, c + i, d + i, share, blend)
            value = scalar.limited(value, low, high)
            value = value if np.uint32(place) < np.uint32(hits) else np.float32(np.inf)
            place = np.int32(place + np.int32(1))
            held = ranges[at + i]
            ranges[at + i] = value if value < held else held
    else:
        for j in range(hits):
            i = np.uintp(j)
            value = scalar.blended(rows, a + i, b + i, c + i, d + i, share, blend)
            value = scalar.limited(value, low, high)
            held = ranges[at + i]
            ranges[at + i] = value if value < held else held


@kernel
def look_up(found, ranges, lidar, lanes):  # type: ignore[no-untyped-def]
    table, count = lidar.table, np.int32(ranges.shape[2])
    padded = (found + BLOCK - 1) // BLOCK * BLOCK
    flat = ranges.reshape(-1)
    directions(padded, lanes)
    cells(found, table, lanes)
    fetch(found, table, lanes)
    spans(padded, lidar.beams, lanes)
    for j in range(found):
        if lanes.whole[np.uintp(j) + CLIMB] < 0:
            climb(np.uintp(j), lidar, lanes)
    aims(padded, count, table.shift, lanes)
    turn = 2.0 * math.pi / lidar.beams.step
    for j in range(found):
        lower(flat, np.uintp(j), lidar, lanes)
    for j in range(found):
        k = np.uintp(j)
        if lanes.wide[k + HIGH] >= turn:
            for each in (MIDDLE, LOW, HIGH):
                lanes.wide[k + each] -= turn
            aim(k, count, table.shift, lanes)
            lower(flat, k, lidar, lanes)


class Here(NamedTuple):
    x: float
    y: float
    heading: float
    at: int


@kernel
def scan_worlds(ranges, poses, chosen, bodies, first, walls, lidar, lanes):  # type: ignore[no-untyped-def]
    """Scans from the robots of some worlds."""
    count, found, robots, beams = bodies.shape[1], 0, poses.shape[1], ranges.shape[2]
    for n in chosen:
        for m in range(robots):
            out = ranges[n, m]
            for i in range(out.shape[0]):
                out[i] = np.float32(np.inf)
            me = first + m if first >= 0 else -1
            x, y, heading = scalar.sensor_pose(poses[n, m], lidar.mount)
            here = Here(x, y, heading, (n * robots + m) * beams)
            begin, computed = 0, 0
            while begin < count:
                end = min(count, begin + LANES - found)
                found, left = select(found, begin, end, bodies[n], me, here, lidar, lanes)
                begin, computed = end, computed + left
                if found == LANES:
                    look_up(found, ranges, lidar, lanes)
                    found = 0
            if computed > 0 or walls.shape[0] > 0:
                scalar.compute(out, x, y, heading, bodies[n] , me, walls, lidar, computed)
    look_up(found, ranges, lidar, lanes)


@kernel
def add_map(ranges, poses, chosen, lidar, grid, exact, lanes):  # type: ignore[no-untyped-def]
    """Fuses a static map into the scans of some worlds.

    Args:
        ranges: (N, M, B) scans, in place.
        poses: (N, M, 3) of `base_link` in the world.
        chosen: (n,) indices of the worlds.
        lidar: `LidarArrays`.
        grid: `map_kernels.GridArrays`.
        exact: whether to walk from cell to cell.
    """
    for n in chosen:
        for m in range(poses.shape[1]):
            x, y, heading = scalar.sensor_pose(poses[n, m], lidar.mount)
            here = LidarPose(x, y, math.cos(heading), math.sin(heading))
            map_kernels.map_into(ranges[n, m], lidar.beams, here, lidar.range_max, grid, exact, lanes)
            exact_kernels.finish(ranges[n, m], lidar.range_min, lidar.range_max)
