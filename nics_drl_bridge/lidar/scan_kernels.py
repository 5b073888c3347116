"""Scans of whole worlds; and the fast path of the look-up, which goes through many bodies at once.

A look-up's time goes into cache misses, branch mispredictions and latencies. So the visible bodies
of several scans go through each step of `baked_kernels` together, in loops without branches that
LLVM vectorises. Steps hand on their results in lanes: one array per type of number, with `LANES`
places for each quantity from a constant on, which LLVM can prove not to overlap.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel, prefetch
from nics_drl_bridge.lidar import baked_kernels as baked
from nics_drl_bridge.lidar import cell_kernels, exact_kernels, map_kernels
from nics_drl_bridge.lidar.exact_kernels import (
    COS,
    HEADING,
    RADIUS,
    SHAPE,
    SIN,
    LidarPose,
    X,
    Y,
)
from nics_drl_bridge.lidar.fixture_kernels import grid_of, walls_of

BLOCK = 16  # Beams that are fused at once
SOON = 8  # Bodies between asking for points and fusing them
LANES = (
    9 * BLOCK
)  # Bodies looked up together: so few that their scans stay in the L1 cache
DX, DY, TURNED, COSINE, SINE, SIZE, BEARING_0, SCAN, MIDDLE, LOW, HIGH, AT = (
    np.uintp(k * LANES) for k in range(12)
)
"""Of a body: offset from the lidar, heading, cosine, sine, radius; the bearing of beam 0 and the
index of the scan in memory; bearing and silhouettes [beams]; index of the first range to fuse."""
RIGHT_X, RIGHT_Y, RIGHT_X2, RIGHT_Y2, LEFT_X, LEFT_Y, LEFT_X2, LEFT_Y2 = (
    np.uintp(k * LANES) for k in range(12, 20)
)
"""The two corners of the hull that can be the right silhouette, and the left one."""
DISTANCE, BEARING, BLEND, SHARE = (np.uintp(k * LANES) for k in range(4))
"""The latter two are those of the farther row and of the next point."""
KIND, CELL, HULL, CLIMBS, START, PLACE, START2, PLACE2 = (
    np.uintp(k * LANES) for k in range(8)
)
"""Shape, cell, first corner of the hull; begin and place of the row and of the farther one."""
BLOCKS, HITS, BACK, ONE, TWO, OTHER, OTHER2 = (
    np.uintp(k * LANES) for k in range(8, 15)
)
"""Blocks, 0 where none fits; beams, and those before the first; points of the row, and of the
farther one."""


class ScanLanes(NamedTuple):
    """Scratch memory of the scans of one thread."""

    wide: NDArray[np.float64]
    single: NDArray[np.float32]
    whole: NDArray[np.int32]
    walls: NDArray[np.float64]


def scan_lanes() -> ScanLanes:
    """Allocates the memory that one thread needs to scan."""
    return ScanLanes(
        np.zeros(20 * LANES),
        np.zeros(4 * LANES, np.float32),
        np.zeros(15 * LANES, np.int32),
        np.zeros(11 * exact_kernels.TOGETHER),
    )


@kernel
def scan_worlds(ranges, poses, chosen, bodies, first, fixtures, lidar, cells, lanes):  # type: ignore[no-untyped-def]
    """Scans from the robots of the worlds `chosen` (n,), at poses (N, M, 3), into ranges (N, M, B).

    Of the bodies (N, K, 7) that of robot 0 is `first`, the others follow; -1 if robots are none.
    Walls and maps are the `fixtures`, cells (`BodyCells`) are those of the bodies, which wait in
    the lanes until these are full.
    """
    robots = poses.shape[1]
    found = 0
    for n in chosen:
        walls = walls_of(n, fixtures)
        for m in range(robots):
            out = ranges[n, m]
            me = first + m if first >= 0 else -1
            for i in range(out.shape[0]):
                out[i] = np.float32(np.inf)
            x, y, heading = baked.sensor_pose(poses[n, m], lidar.mount)
            here = LidarPose(x, y, math.cos(heading), math.sin(heading))
            at = (n * robots + m) * out.shape[0]
            count = cell_kernels.around(n, x, y, lidar.range_max, cells)
            begin = 0
            computed = 0
            while begin < count:
                end = min(count, begin + LANES - found)
                near = cells.found[begin:end]
                found, more = select(
                    found, near, bodies[n], me, here, heading, at, lidar, lanes
                )
                begin = end
                computed = computed + more
                if found == LANES:
                    look_up(found, ranges, lidar, lanes)
                    found = 0
            if computed > 0 or walls.shape[0] > 0:
                near = cells.found[: count if computed > 0 else 0]
                baked.compute(out, here, bodies[n], me, near, walls, lidar, lanes.walls)
    look_up(found, ranges, lidar, lanes)
    if fixtures.squares.size > 0:
        add_maps(ranges, poses, chosen, fixtures, lidar, lanes)


@kernel(contracts=True, inline=True)
def select(found, near, bodies, me, here, heading, at, lidar, lanes):  # type: ignore[no-untyped-def]
    """Lanes the bodies `near` that may be seen; returns lanes in use, and bodies to compute."""
    wide = lanes.wide
    computed = 0
    behind = lidar.beams.behind
    for j in range(near.shape[0]):
        b = np.uintp(near[j])
        k = np.uintp(found)
        dx = bodies[b, X] - here.x
        dy = bodies[b, Y] - here.y
        radius = bodies[b, RADIUS]
        d2 = dx * dx + dy * dy
        reach = lidar.range_max + radius
        shape = np.int32(bodies[b, SHAPE])
        wide[k + DX], wide[k + DY], wide[k + TURNED] = dx, dy, bodies[b, HEADING]
        wide[k + COSINE], wide[k + SINE], wide[k + SIZE] = (
            bodies[b, COS],
            bodies[b, SIN],
            radius,
        )
        wide[k + BEARING_0] = heading
        wide[k + SCAN] = at
        lanes.whole[k + KIND] = shape
        h = np.uintp(shape)
        u = here.c * dx + here.s * dy
        v = here.c * dy - here.s * dx
        away = (behind[0, 0] * u + behind[0, 1] * v >= radius) & (
            behind[1, 0] * u + behind[1, 1] * v >= radius
        )
        seen = (d2 <= reach * reach) & (radius > 0.0) & (near[j] != me) & (not away)
        kept = seen & (d2 >= radius * radius)
        kept &= (d2 >= lidar.between[h, 0]) & (d2 <= lidar.between[h, 1])
        found += kept
        computed += seen & (not kept)
    return found, computed


@kernel
def look_up(found, ranges, lidar, lanes):  # type: ignore[no-untyped-def]
    """Fuses the bodies in the lanes into their scans (N, M, B)."""
    wide = lanes.wide
    table = lidar.table
    flat = ranges.reshape(-1).view(np.int32)
    padded = (found + BLOCK - 1) // BLOCK * BLOCK
    turn = 2.0 * math.pi / lidar.beams.step
    count = np.int32(ranges.shape[2])
    places(padded, lanes)
    cells(found, table, lanes)
    fetch(found, table, lanes)
    spans(padded, lidar.beams, lanes)
    for j in range(found):
        if lanes.whole[np.uintp(j) + CLIMBS] < 0:
            climb(np.uintp(j), lidar, lanes)
    aims(padded, count, np.int32(table.shift), lanes)
    for j in range(found):
        soon = np.uintp(min(j + SOON, found - 1))
        for row in (ONE, OTHER):
            prefetch(table.rows, np.intp(lanes.whole[soon + row]))
            prefetch(table.rows, np.intp(lanes.whole[soon + row] + BLOCK))
        fuse(flat, np.uintp(j), lidar, lanes)
    for j in range(found):
        if wide[np.uintp(j) + HIGH] >= turn:  # across the seam of the circle
            aim(np.uintp(j), turn, count, np.int32(table.shift), lanes)
            fuse(flat, np.uintp(j), lidar, lanes)


@kernel(contracts=True)
def places(padded, lanes):  # type: ignore[no-untyped-def]
    """Distance and bearing of each body; unused lanes contain old values."""
    for j in range(padded):
        k = np.uintp(j)
        distance, bearing = baked.polar(lanes.wide[k + DX], lanes.wide[k + DY])
        lanes.single[k + DISTANCE] = distance
        lanes.single[k + BEARING] = bearing


@kernel(contracts=True)
def cells(found, table, lanes):  # type: ignore[no-untyped-def]
    """Table cell of each body, and the first corner of its hull."""
    wide = lanes.wide
    single = lanes.single
    whole = lanes.whole
    for j in range(found):
        k = np.uintp(j)
        shape = table.shapes[np.uintp(whole[k + KIND])]
        distance = single[k + DISTANCE]
        whole[k + CELL], whole[k + HULL], single[k + BLEND] = baked.nearest_cell(
            distance,
            single[k + BEARING],
            wide[k + SIZE],
            wide[k + TURNED],
            shape,
            table,
        )
        wide[k + SIZE] = shape.round_radius


@kernel
def fetch(found, table, lanes):  # type: ignore[no-untyped-def]
    """Loads cells and corners, the step with most cache misses: nothing waits for them here."""
    wide = lanes.wide
    whole = lanes.whole
    for j in range(found):
        k = np.uintp(j)
        hull = whole[k + HULL]
        cell = np.uintp(whole[k + CELL])
        near = table.cells[cell]
        far = table.cells[cell + np.uintp(1)]
        whole[k + START], whole[k + PLACE] = near[0], near[1]
        whole[k + START2], whole[k + PLACE2] = far[0], far[1]
        whole[k + CLIMBS] = (near[2] | near[3]) >> 16
        for pair, at in ((near[2], RIGHT_X), (near[3], LEFT_X)):
            one = table.hulls[np.uintp(hull + (pair & 0xFFFF))]
            two = table.hulls[np.uintp(hull + max(pair >> 16, 0))]
            wide[k + at], wide[k + at + np.uintp(LANES)] = one[0], one[1]
            wide[k + at + np.uintp(2 * LANES)], wide[k + at + np.uintp(3 * LANES)] = (
                two[0],
                two[1],
            )


@kernel(contracts=True)
def spans(padded, beams, lanes):  # type: ignore[no-untyped-def]
    """Bearing and silhouettes of each body in beams, from the outer of two corners."""
    wide = lanes.wide
    for j in range(padded):
        k = np.uintp(j)
        seen = baked.seen_at(
            wide[k + DX], wide[k + DY], wide[k + COSINE], wide[k + SINE]
        )
        radius = wide[k + SIZE]
        x = wide[k + RIGHT_X]
        y = wide[k + RIGHT_Y]
        x2 = wide[k + RIGHT_X2]
        y2 = wide[k + RIGHT_Y2]
        right = baked.tangent(seen, x, y, x2, y2, radius, 1.0)
        x = wide[k + LEFT_X]
        y = wide[k + LEFT_Y]
        x2 = wide[k + LEFT_X2]
        y2 = wide[k + LEFT_Y2]
        left = baked.tangent(seen, x, y, x2, y2, radius, -1.0)
        bearing = lanes.single[k + BEARING]
        ahead = wide[k + BEARING_0]
        wide[k + MIDDLE], wide[k + LOW], wide[k + HIGH] = baked.in_beams(
            right, left, bearing, ahead, beams
        )


@kernel(contracts=True)
def climb(k, lidar, lanes):  # type: ignore[no-untyped-def]
    """Replaces the silhouettes of a body that two corners do not determine."""
    wide = lanes.wide
    whole = lanes.whole
    table = lidar.table
    seen = baked.seen_at(wide[k + DX], wide[k + DY], wide[k + COSINE], wide[k + SINE])
    shape = table.shapes[np.uintp(whole[k + KIND])]
    cell = table.cells[np.uintp(whole[k + CELL])]
    right = baked.silhouette(cell[2], whole[k + HULL], shape, table.hulls, seen, 1.0)
    left = baked.silhouette(cell[3], whole[k + HULL], shape, table.hulls, seen, -1.0)
    bearing = lanes.single[k + BEARING]
    ahead = wide[k + BEARING_0]
    wide[k + MIDDLE], wide[k + LOW], wide[k + HIGH] = baked.in_beams(
        right, left, bearing, ahead, lidar.beams
    )


@kernel(contracts=True, inline=True)
def aim(k, turn, count, shift, lanes):  # type: ignore[no-untyped-def]
    """Finds the beams and the points of one body.

    Whole blocks of beams are fused, at least two, which most bodies need: a varying number would
    often mispredict a branch. Blocks beyond the last of `count` beams begin `BACK` earlier.
    """
    wide = lanes.wide
    whole = lanes.whole
    zero = np.int32(0)
    middle = wide[k + MIDDLE] - turn
    low = wide[k + LOW] - turn
    high = wide[k + HIGH] - turn
    begin, hits, point, share = baked.beams_between(middle, low, high, count, shift)
    width = np.int32(
        max(np.int32(hits + BLOCK - 1) & np.int32(-BLOCK), np.int32(2 * BLOCK))
    )
    back = np.int32(max(np.int32(begin + width - count), zero))
    whole[k + HITS], whole[k + BACK], wide[k + AT] = (
        hits,
        back,
        wide[k + SCAN] + (begin - back),
    )
    one, two = baked.points_of(whole[k + START], whole[k + PLACE], point, shift, hits)
    other, other2 = baked.points_of(
        whole[k + START2], whole[k + PLACE2], point, shift, hits
    )
    whole[k + ONE], whole[k + TWO] = np.int32(one - back), np.int32(two - back)
    whole[k + OTHER], whole[k + OTHER2] = (
        np.int32(other - back),
        np.int32(other2 - back),
    )
    first = np.int32(min(min(one, two), min(min(other, other2), begin)) - back)
    blocks = np.int32(
        max(np.int32(hits + back + BLOCK - 1) >> np.int32(4), np.int32(2))
    )
    whole[k + BLOCKS] = (
        blocks if (first >= 0) & (hits > 0) else zero
    )  # none at a table's begin
    lanes.single[k + SHARE] = share


@kernel(contracts=True)
def aims(padded, count, shift, lanes):  # type: ignore[no-untyped-def]
    """Finds the beams and the points of each body."""
    for j in range(padded):
        aim(np.uintp(j), 0.0, count, shift, lanes)


@kernel(contracts=True, inline=True)
def fuse(flat, k, lidar, lanes):  # type: ignore[no-untyped-def]
    """Lowers the beams of one body in blocks, or beam by beam where no block fits."""
    whole = lanes.whole
    rows = lidar.table.rows
    blocks = whole[k + BLOCKS]
    hits = whole[k + HITS]
    back = whole[k + BACK]
    share = lanes.single[k + SHARE]
    blend = lanes.single[k + BLEND]
    least = np.float32(lidar.range_min)
    most = np.float32(lidar.range_max)
    at = np.uintp(lanes.wide[k + AT])
    first = np.int64(0 if blocks > 0 else back)
    one = np.uintp(whole[k + ONE] + first)
    two = np.uintp(whole[k + TWO] + first)
    other = np.uintp(whole[k + OTHER] + first)
    other2 = np.uintp(whole[k + OTHER2] + first)
    # Ranges are fused as whole numbers, in the same order: of floats LLVM masks the store.
    if blocks > 0:
        place = np.int32(-back)
        for j in range(blocks * BLOCK):
            i = np.uintp(j)
            value = baked.blended(
                rows, one + i, two + i, other + i, other2 + i, share, blend, least, most
            )
            value = value if np.uint32(place) < np.uint32(hits) else np.float32(np.inf)
            place = np.int32(place + np.int32(1))  # of 32 bits, as the ranges
            flat[at + i] = min(flat[at + i], np.float32(value).view(np.int32))
    else:  # few beams, or at the begin of the table
        at = np.uintp(lanes.wide[k + AT] + back)
        for j in range(hits):
            i = np.uintp(j)
            value = baked.blended(
                rows, one + i, two + i, other + i, other2 + i, share, blend, least, most
            )
            flat[at + i] = min(flat[at + i], np.float32(value).view(np.int32))


@kernel
def add_maps(ranges, poses, chosen, fixtures, lidar, lanes):  # type: ignore[no-untyped-def]
    """Fuses static maps into the scans of some worlds, see `scan_worlds`."""
    for n in chosen:
        grid = grid_of(n, fixtures)
        for m in range(poses.shape[1] if grid.squares.size > 0 else 0):
            x, y, heading = baked.sensor_pose(poses[n, m], lidar.mount)
            here = LidarPose(x, y, math.cos(heading), math.sin(heading))
            out = ranges[n, m]
            far = lidar.range_max
            map_kernels.map_into(out, lidar.beams, here, far, grid, lidar.exact, lanes)
            exact_kernels.finish(out, lidar.range_min, lidar.range_max)
