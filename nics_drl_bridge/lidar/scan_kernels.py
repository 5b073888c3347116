"""Scans of whole worlds: the bodies of several scans are looked up together.

`look_up` is Eq. 3 (the ranges of a body, from the table) and Eq. 4 (the minimum per beam). Its
steps are those of `baked_kernels`, which are written for one body. Here each step runs over all
waiting bodies in a loop without branches, which LLVM vectorises: a look-up's time goes into cache
misses, mispredicted branches and latencies. Steps hand on their results in lanes: one array per
type of number, with `LANES` places for each quantity, so that LLVM can prove that they do not
overlap.
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

# Beams of a body are fused in blocks of so many.
BLOCK = 16
# Table rows are prefetched so many bodies before they are fused.
PREFETCHED_AHEAD = 8
# Bodies looked up together: few enough for their scans to stay in the L1 cache.
LANES = 9 * BLOCK

# Quantities in `ScanLanes.wide`: the body relative to the lidar.
DX, DY, BODY_HEADING, BODY_COS, BODY_SIN, BODY_RADIUS = (
    np.uintp(k * LANES) for k in range(6)
)
# Bearing of beam 0, and index of the scan's first range in memory.
LIDAR_HEADING, FIRST_RANGE = (np.uintp(k * LANES) for k in range(6, 8))
# The body's centre and its right and left silhouette [beams]; index of the first range to fuse.
CENTRE_BEAM, RIGHT_BEAM, LEFT_BEAM, FUSED_FROM = (
    np.uintp(k * LANES) for k in range(8, 12)
)
# Of either silhouette, the two corners of the hull that it may be.
RIGHT_X, RIGHT_Y, RIGHT_X2, RIGHT_Y2, LEFT_X, LEFT_Y, LEFT_X2, LEFT_Y2 = (
    np.uintp(k * LANES) for k in range(12, 20)
)
# Quantities in `ScanLanes.single`; the weights of the farther row and of the next point.
DISTANCE, BEARING, ROW_WEIGHT, POINT_WEIGHT = (np.uintp(k * LANES) for k in range(4))
# Quantities in `ScanLanes.whole`: the table's cell and the hull's first corner;
BODY_SHAPE, CELL, HULL = (np.uintp(k * LANES) for k in range(3))
# negative where two corners do not determine a silhouette;
CLIMBS = np.uintp(3 * LANES)
# where the row below the distance and the one above it start, and which beams they hold;
ROW_START, ROW_BEAMS, FAR_ROW_START, FAR_ROW_BEAMS = (
    np.uintp(k * LANES) for k in range(4, 8)
)
# blocks to fuse (0: beam by beam), beams that hit, and beams before them in the first block;
BLOCKS, HITS, LEADING = (np.uintp(k * LANES) for k in range(8, 11))
# the points around a beam, in the row and in the farther one.
POINT, NEXT_POINT, FAR_POINT, FAR_NEXT_POINT = (
    np.uintp(k * LANES) for k in range(11, 15)
)


class ScanLanes(NamedTuple):
    """Scratch memory of the scans of one thread."""

    wide: NDArray[np.float64]
    single: NDArray[np.float32]
    whole: NDArray[np.int32]
    walls: NDArray[np.float64]


def scan_lanes() -> ScanLanes:
    """Allocate the memory that one thread needs to scan."""
    return ScanLanes(
        np.zeros(20 * LANES),
        np.zeros(4 * LANES, np.float32),
        np.zeros(15 * LANES, np.int32),
        np.zeros(11 * exact_kernels.TOGETHER),
    )


@kernel
def scan_worlds(ranges, poses, chosen, bodies, first, fixtures, lidar, cells, lanes):  # type: ignore[no-untyped-def]
    """Scan from the robots of the worlds `chosen` (n,), at poses (N, M, 3), into ranges (N, M, B).

    The bodies (N, K, 7) from index `first` on are the robots', or none where `first` is -1.
    `fixtures` are walls and maps, `cells` (`BodyCells`) says which bodies are near. Bodies wait in
    the lanes, across scans and worlds, and are looked up when the lanes are full.
    """
    robots = poses.shape[1]
    in_use = 0
    for n in chosen:
        walls = walls_of(n, fixtures)
        for m in range(robots):
            out = ranges[n, m]
            own_body = first + m if first >= 0 else -1
            for i in range(out.shape[0]):
                out[i] = np.float32(np.inf)
            x, y, heading = baked.sensor_pose(poses[n, m], lidar.mount)
            lidar_pose = LidarPose(x, y, math.cos(heading), math.sin(heading))
            at = (n * robots + m) * out.shape[0]
            count = cell_kernels.around(n, x, y, lidar.range_max, cells)
            begin = 0
            computed = 0
            while begin < count:
                end = min(count, begin + LANES - in_use)
                near = cells.found[begin:end]
                in_use, rest = select_bodies(
                    in_use,
                    near,
                    bodies[n],
                    own_body,
                    lidar_pose,
                    heading,
                    at,
                    lidar,
                    lanes,
                )
                begin = end
                computed = computed + rest
                if in_use == LANES:
                    look_up(in_use, ranges, lidar, lanes)
                    in_use = 0
            if computed > 0 or walls.shape[0] > 0:
                near = cells.found[: count if computed > 0 else 0]
                baked.compute(
                    out,
                    lidar_pose,
                    bodies[n],
                    own_body,
                    near,
                    walls,
                    lidar,
                    lanes.walls,
                )
    look_up(in_use, ranges, lidar, lanes)
    if fixtures.squares.size > 0:
        add_maps(ranges, poses, chosen, fixtures, lidar, lanes)


@kernel(contracts=True, inline=True)
def select_bodies(in_use, near, bodies, own, lidar_pose, heading, at, lidar, lanes):  # type: ignore[no-untyped-def]
    """Put the visible ones of the bodies `near` into lanes; return lanes in use, bodies to compute.

    A body is computed instead of looked up where the table is too coarse, see `way_of`.
    """
    wide = lanes.wide
    computed = 0
    behind = lidar.beams.behind
    for j in range(near.shape[0]):
        b = np.uintp(near[j])
        k = np.uintp(in_use)
        dx = bodies[b, X] - lidar_pose.x
        dy = bodies[b, Y] - lidar_pose.y
        radius = bodies[b, RADIUS]
        d2 = dx * dx + dy * dy
        reach = lidar.range_max + radius
        shape = np.int32(bodies[b, SHAPE])
        wide[k + DX] = dx
        wide[k + DY] = dy
        wide[k + BODY_HEADING] = bodies[b, HEADING]
        wide[k + BODY_COS] = bodies[b, COS]
        wide[k + BODY_SIN] = bodies[b, SIN]
        wide[k + BODY_RADIUS] = radius
        wide[k + LIDAR_HEADING] = heading
        wide[k + FIRST_RANGE] = at
        lanes.whole[k + BODY_SHAPE] = shape
        h = np.uintp(shape)
        ahead = lidar_pose.c * dx + lidar_pose.s * dy
        aside = lidar_pose.c * dy - lidar_pose.s * dx
        is_behind = (behind[0, 0] * ahead + behind[0, 1] * aside >= radius) & (
            behind[1, 0] * ahead + behind[1, 1] * aside >= radius
        )
        is_other = (radius > 0.0) & (near[j] != own)
        is_visible = (d2 <= reach * reach) & is_other & (not is_behind)
        is_in_table = is_visible & (d2 >= radius * radius)
        is_in_table &= (d2 >= lidar.between[h, 0]) & (d2 <= lidar.between[h, 1])
        # The lane counts only if its body is looked up; else the next body overwrites it.
        in_use += is_in_table
        computed += is_visible & (not is_in_table)
    return in_use, computed


@kernel
def look_up(in_use, ranges, lidar, lanes):  # type: ignore[no-untyped-def]
    """Look up the bodies in the lanes (Eq. 3) and fuse them into their scans (N, M, B) (Eq. 4)."""
    wide = lanes.wide
    table = lidar.table
    flat = ranges.reshape(-1).view(np.int32)
    padded = (in_use + BLOCK - 1) // BLOCK * BLOCK
    full_turn = 2.0 * math.pi / lidar.beams.step  # [beams]
    beam_count = np.int32(ranges.shape[2])
    compute_polar(padded, lanes)
    find_cells(in_use, table, lanes)
    fetch_cells(in_use, table, lanes)
    find_silhouettes(padded, lidar.beams, lanes)
    for j in range(in_use):
        if lanes.whole[np.uintp(j) + CLIMBS] < 0:
            climb_to_silhouettes(np.uintp(j), lidar, lanes)
    find_all_points(padded, beam_count, np.int32(table.shift), lanes)
    for j in range(in_use):
        upcoming = np.uintp(min(j + PREFETCHED_AHEAD, in_use - 1))
        for row in (POINT, FAR_POINT):
            prefetch(table.rows, np.intp(lanes.whole[upcoming + row]))
            prefetch(table.rows, np.intp(lanes.whole[upcoming + row] + BLOCK))
        fuse(flat, np.uintp(j), lidar, lanes)
    for j in range(in_use):
        # A body that spans the last beam and the first is fused again, a full turn on.
        if wide[np.uintp(j) + LEFT_BEAM] >= full_turn:
            find_points(
                np.uintp(j), full_turn, beam_count, np.int32(table.shift), lanes
            )
            fuse(flat, np.uintp(j), lidar, lanes)


@kernel(contracts=True)
def compute_polar(padded, lanes):  # type: ignore[no-untyped-def]
    """Compute distance and bearing of each body; unused lanes hold old values."""
    for j in range(padded):
        k = np.uintp(j)
        distance, bearing = baked.polar(lanes.wide[k + DX], lanes.wide[k + DY])
        lanes.single[k + DISTANCE] = distance
        lanes.single[k + BEARING] = bearing


@kernel(contracts=True)
def find_cells(in_use, table, lanes):  # type: ignore[no-untyped-def]
    """Find the table's cell for each body, and the first corner of its hull."""
    wide = lanes.wide
    single = lanes.single
    whole = lanes.whole
    for j in range(in_use):
        k = np.uintp(j)
        shape = table.shapes[np.uintp(whole[k + BODY_SHAPE])]
        distance = single[k + DISTANCE]
        whole[k + CELL], whole[k + HULL], single[k + ROW_WEIGHT] = baked.nearest_cell(
            distance,
            single[k + BEARING],
            wide[k + BODY_RADIUS],
            wide[k + BODY_HEADING],
            shape,
            table,
        )
        wide[k + BODY_RADIUS] = shape.round_radius


@kernel
def fetch_cells(in_use, table, lanes):  # type: ignore[no-untyped-def]
    """Fetch cells and corners: most cache misses occur here, where no arithmetic waits for them."""
    wide = lanes.wide
    whole = lanes.whole
    for j in range(in_use):
        k = np.uintp(j)
        hull = whole[k + HULL]
        cell = np.uintp(whole[k + CELL])
        near = table.cells[cell]
        far = table.cells[cell + np.uintp(1)]
        whole[k + ROW_START] = near[0]
        whole[k + ROW_BEAMS] = near[1]
        whole[k + FAR_ROW_START] = far[0]
        whole[k + FAR_ROW_BEAMS] = far[1]
        whole[k + CLIMBS] = (near[2] | near[3]) >> 16
        for pair, at in ((near[2], RIGHT_X), (near[3], LEFT_X)):
            corner = table.hulls[np.uintp(hull + (pair & 0xFFFF))]
            corner2 = table.hulls[np.uintp(hull + max(pair >> 16, 0))]
            wide[k + at] = corner[0]
            wide[k + at + np.uintp(LANES)] = corner[1]
            wide[k + at + np.uintp(2 * LANES)] = corner2[0]
            wide[k + at + np.uintp(3 * LANES)] = corner2[1]


@kernel(contracts=True)
def find_silhouettes(padded, beams, lanes):  # type: ignore[no-untyped-def]
    """Find centre and silhouettes of each body in beams, from the outer of two corners."""
    wide = lanes.wide
    for j in range(padded):
        k = np.uintp(j)
        seen = baked.seen_at(
            wide[k + DX], wide[k + DY], wide[k + BODY_COS], wide[k + BODY_SIN]
        )
        radius = wide[k + BODY_RADIUS]
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
        ahead = wide[k + LIDAR_HEADING]
        wide[k + CENTRE_BEAM], wide[k + RIGHT_BEAM], wide[k + LEFT_BEAM] = (
            baked.in_beams(right, left, bearing, ahead, beams)
        )


@kernel(contracts=True)
def climb_to_silhouettes(k, lidar, lanes):  # type: ignore[no-untyped-def]
    """Find the silhouettes of a body that two corners do not determine."""
    wide = lanes.wide
    whole = lanes.whole
    table = lidar.table
    seen = baked.seen_at(
        wide[k + DX], wide[k + DY], wide[k + BODY_COS], wide[k + BODY_SIN]
    )
    shape = table.shapes[np.uintp(whole[k + BODY_SHAPE])]
    cell = table.cells[np.uintp(whole[k + CELL])]
    right = baked.silhouette(cell[2], whole[k + HULL], shape, table.hulls, seen, 1.0)
    left = baked.silhouette(cell[3], whole[k + HULL], shape, table.hulls, seen, -1.0)
    bearing = lanes.single[k + BEARING]
    ahead = wide[k + LIDAR_HEADING]
    wide[k + CENTRE_BEAM], wide[k + RIGHT_BEAM], wide[k + LEFT_BEAM] = baked.in_beams(
        right, left, bearing, ahead, lidar.beams
    )


@kernel(contracts=True, inline=True)
def find_points(k, turned_by, beam_count, shift, lanes):  # type: ignore[no-untyped-def]
    """Find the beams that hit one body, and its points in the table.

    A body across the seam of the circle is fused twice, the second time `turned_by` a full turn.
    Whole blocks of beams are fused, at least two, which most bodies need: a varying number would
    often mispredict a branch. Where blocks would end beyond the last beam, they start `LEADING`
    beams earlier.
    """
    wide = lanes.wide
    whole = lanes.whole
    zero = np.int32(0)
    centre = wide[k + CENTRE_BEAM] - turned_by
    right = wide[k + RIGHT_BEAM] - turned_by
    left = wide[k + LEFT_BEAM] - turned_by
    first_beam, hits, point, weight = baked.beams_between(
        centre, right, left, beam_count, shift
    )
    width = np.int32(
        max(np.int32(hits + BLOCK - 1) & np.int32(-BLOCK), np.int32(2 * BLOCK))
    )
    leading = np.int32(max(np.int32(first_beam + width - beam_count), zero))
    near, near_next = baked.points_of(
        whole[k + ROW_START], whole[k + ROW_BEAMS], point, shift, hits
    )
    far, far_next = baked.points_of(
        whole[k + FAR_ROW_START], whole[k + FAR_ROW_BEAMS], point, shift, hits
    )
    lowest = np.int32(
        min(min(near, near_next), min(min(far, far_next), first_beam)) - leading
    )
    blocks = np.int32(
        max(np.int32(hits + leading + BLOCK - 1) >> np.int32(4), np.int32(2))
    )
    whole[k + HITS] = hits
    whole[k + LEADING] = leading
    wide[k + FUSED_FROM] = wide[k + FIRST_RANGE] + (first_beam - leading)
    whole[k + POINT] = np.int32(near - leading)
    whole[k + NEXT_POINT] = np.int32(near_next - leading)
    whole[k + FAR_POINT] = np.int32(far - leading)
    whole[k + FAR_NEXT_POINT] = np.int32(far_next - leading)
    # Blocks must not reach before the start of the table.
    whole[k + BLOCKS] = blocks if (lowest >= 0) & (hits > 0) else zero
    lanes.single[k + POINT_WEIGHT] = weight


@kernel(contracts=True)
def find_all_points(padded, beam_count, shift, lanes):  # type: ignore[no-untyped-def]
    """Find the beams and the points of each body, see `find_points`."""
    for j in range(padded):
        find_points(np.uintp(j), 0.0, beam_count, shift, lanes)


@kernel(contracts=True, inline=True)
def fuse_beam(flat, place, i, is_hit, rows, points, weights, limits):  # type: ignore[no-untyped-def]
    """Lower the range of one beam at `place`, the i-th of a body, if it hits (Eq. 4).

    Ranges are compared as integers, because LLVM would mask the store of a float's minimum. Both
    orders agree: ranges are positive, or -inf, which as an integer is below all others.
    """
    value = baked.blended(
        rows,
        points[0] + i,
        points[1] + i,
        points[2] + i,
        points[3] + i,
        weights[0],
        weights[1],
        limits[0],
        limits[1],
    )
    value = value if is_hit else np.float32(np.inf)
    flat[place] = min(flat[place], np.float32(value).view(np.int32))


@kernel(contracts=True, inline=True)
def fuse(flat, k, lidar, lanes):  # type: ignore[no-untyped-def]
    """Fuse one body into its scan, in blocks of beams or, where none fits, beam by beam."""
    whole = lanes.whole
    rows = lidar.table.rows
    blocks = whole[k + BLOCKS]
    hits = whole[k + HITS]
    leading = whole[k + LEADING]
    weights = (lanes.single[k + POINT_WEIGHT], lanes.single[k + ROW_WEIGHT])
    limits = (np.float32(lidar.range_min), np.float32(lidar.range_max))
    skipped = np.int64(0 if blocks > 0 else leading)
    points = (
        np.uintp(whole[k + POINT] + skipped),
        np.uintp(whole[k + NEXT_POINT] + skipped),
        np.uintp(whole[k + FAR_POINT] + skipped),
        np.uintp(whole[k + FAR_NEXT_POINT] + skipped),
    )
    if blocks > 0:
        fused_from = np.uintp(lanes.wide[k + FUSED_FROM])
        hit = np.int32(-leading)
        for j in range(blocks * BLOCK):
            i = np.uintp(j)
            # An unsigned comparison covers both ends: beams before the first hit are negative.
            is_hit = np.uint32(hit) < np.uint32(hits)
            fuse_beam(flat, fused_from + i, i, is_hit, rows, points, weights, limits)
            hit = np.int32(hit + np.int32(1))  # 32 bits wide, like the ranges
    else:
        fused_from = np.uintp(lanes.wide[k + FUSED_FROM] + leading)
        for j in range(hits):
            i = np.uintp(j)
            fuse_beam(flat, fused_from + i, i, True, rows, points, weights, limits)


@kernel
def add_maps(ranges, poses, chosen, fixtures, lidar, lanes):  # type: ignore[no-untyped-def]
    """Fuse static maps into the scans of some worlds, see `scan_worlds`."""
    for n in chosen:
        grid = grid_of(n, fixtures)
        for m in range(poses.shape[1] if grid.squares.size > 0 else 0):
            x, y, heading = baked.sensor_pose(poses[n, m], lidar.mount)
            lidar_pose = LidarPose(x, y, math.cos(heading), math.sin(heading))
            out = ranges[n, m]
            far = lidar.range_max
            map_kernels.map_into(
                out, lidar.beams, lidar_pose, far, grid, lidar.exact, lanes
            )
            exact_kernels.finish(out, lidar.range_min, lidar.range_max)
