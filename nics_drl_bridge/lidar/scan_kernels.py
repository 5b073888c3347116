"""Scans of whole worlds: bodies of many scans are looked up together (Eq. 3 and 4).

    scan[b] = min over the bodies m of r_m(a_b)     Eq. 4, for the beam b at the angle a_b

Each r_m is a look-up of one body, Eq. 3. `baked_kernels` states it as a formula and has its steps
for one body. Here each step is a loop over all waiting bodies. Most of these loops have no
branches, so LLVM vectorises them: the time of a look-up goes into cache misses, mispredicted
branches and latencies.

`scan_worlds` selects the bodies that are visible (step 1) and puts each of them into a lane. When
the lanes are full, `look_up` takes all of them through the passes:

2. `find_polars`: distance and bearing of each body.
3. `find_cells`, `fetch_cells`: its cell in the table, and what the cell holds.
4. `find_silhouettes`, `climb_to_silhouettes`: its silhouettes.
5. `find_all_points`: the beams that hit it,
6. and its points in the table.
7. `fuse_body`: blends the range of each beam, and takes the minimum with the scan.

Bodies that are scanned exactly, and walls, are fused into each scan when its bodies are selected;
the maps come last. The minimum is the same in any order.

The passes hand on their results in lanes: one array for each type of number, with `LANES` places
for each quantity, so that LLVM can prove that quantities do not overlap. A quantity is named by its
offset: `lanes.doubles[k + DX]` is `DX` of the body in lane k.
"""

from typing import NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel, prefetch
from nics_drl_bridge.lidar import baked_kernels as baked
from nics_drl_bridge.lidar import cell_kernels, exact_kernels, map_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers, ShortIntegers, Singles
from nics_drl_bridge.lidar.baked_kernels import (
    LEFT,
    LEFT_CORNERS,
    RIGHT,
    RIGHT_CORNERS,
    BeamSpan,
    BlendWeights,
    LidarArrays,
    RowPoints,
    ShapeView,
    TableArrays,
)
from nics_drl_bridge.lidar.cell_kernels import BodyCells
from nics_drl_bridge.lidar.exact_kernels import (
    COS,
    HEADING,
    RADIUS,
    SHAPE,
    SIN,
    Beams,
    LidarPose,
    X,
    Y,
)
from nics_drl_bridge.lidar.fixture_kernels import Fixtures, grid_of, walls_of

# Beams of a body are fused in blocks of so many.
BLOCK = 16
BLOCK_SHIFT = np.int32(4)  # log2 of BLOCK
FEWEST_BLOCKS = np.int32(2)  # see `find_body_points`
# Table rows are prefetched so many bodies before they are fused.
PREFETCHED_AHEAD = 8
# Bodies looked up together: few enough for their scans to stay in the L1 cache.
LANES = 9 * BLOCK

# Quantities in `ScanLanes.doubles`.
DOUBLES = 21
(
    DX,  # of the body from the lidar, along the axes of the world [m]
    DY,
    BODY_HEADING,  # in the world [rad]
    BODY_COS,
    BODY_SIN,
    BODY_RADIUS,  # of the circle around the body [m]
    ROUND_RADIUS,  # radius of a body that is a circle [m], 0 for any other
    LIDAR_HEADING,  # in the world [rad]
    SCAN_START,  # index of the scan's first range in memory
    FUSED_FROM,  # index of the first range to fuse
    CENTRE_BEAM,  # bearing and silhouettes of the body, see `BeamSpan`
    RIGHT_BEAM,
    LEFT_BEAM,
    RIGHT_X,  # the two corners that may be the right silhouette [m]
    RIGHT_Y,
    RIGHT_X2,
    RIGHT_Y2,
    LEFT_X,  # the same for the left silhouette
    LEFT_Y,
    LEFT_X2,
    LEFT_Y2,
) = (np.uintp(k * LANES) for k in range(DOUBLES))

# Quantities in `ScanLanes.singles`.
SINGLES = 4
(
    DISTANCE,  # of the body from the lidar [m]
    BEARING,  # of the body in the world [rad]
    FAR_WEIGHT,  # of the far row
    NEXT_WEIGHT,  # of the next point in each row
) = (np.uintp(k * LANES) for k in range(SINGLES))

# Quantities in `ScanLanes.integers`. The near row is that of the grid distance below the body's
# distance, the far row that of the next grid distance.
INTEGERS = 15
(
    BODY_SHAPE,  # index of the body's shape
    CELL,  # index of its cell in the table
    HULL,  # index from which the cell's corners are counted
    CLIMBS,  # negative if two corners do not determine a silhouette
    NEAR_START,  # where the near row starts
    NEAR_EXTENT,  # its beams, see `unpack_extent`
    FAR_START,
    FAR_EXTENT,
    BLOCKS,  # number of blocks to fuse; 0: fuse beam by beam
    HITS,  # number of beams that hit
    LEADING,  # beams that are fused before the first one that hits
    NEAR_POINT,  # indices of the points of the first beam to fuse, see `RowPoints`
    NEAR_NEXT,
    FAR_POINT,
    FAR_NEXT,
) = (np.uintp(k * LANES) for k in range(INTEGERS))


class ScanLanes(NamedTuple):
    """Scratch memory of the scans of one thread."""

    doubles: Array  # (DOUBLES * LANES,)
    singles: Singles  # (SINGLES * LANES,)
    integers: ShortIntegers  # (INTEGERS * LANES,)
    walls: Array  # for `exact_kernels.walls_into`


def scan_lanes() -> ScanLanes:
    """Allocate the memory that one thread needs to scan."""
    return ScanLanes(
        np.zeros(DOUBLES * LANES),
        np.zeros(SINGLES * LANES, np.float32),
        np.zeros(INTEGERS * LANES, np.int32),
        np.zeros(11 * exact_kernels.TOGETHER),
    )


@kernel
def scan_worlds(
    ranges: Singles,
    robot_poses: Array,
    chosen: Integers,
    bodies: Array,
    first_robot: int,
    fixtures: Fixtures,
    lidar: LidarArrays,
    cells: BodyCells,
    lanes: ScanLanes,
) -> None:
    """Scan from all robots of some worlds.

    Args:
        ranges: (N, M, B) the scans [m], which are overwritten.
        robot_poses: (N, M, 3).
        chosen: (n,) the worlds to scan.
        bodies: (N, K, 7).
        first_robot: index of the first robot's own body, which the other robots' follow; -1 if
            robots have no bodies.
        fixtures: walls and maps of the worlds.
        lidar: the lidar of every robot.
        cells: which bodies are near a place.
        lanes: scratch memory. Bodies wait there, across scans and worlds, until it is full.
    """
    robots = robot_poses.shape[1]
    in_use = 0
    for n in chosen:
        walls = walls_of(n, fixtures)
        for m in range(robots):
            scan = ranges[n, m]
            for i in range(scan.shape[0]):
                scan[i] = np.float32(np.inf)
            lidar_pose, heading = baked.locate_lidar(robot_poses[n, m], lidar.mount)
            own_body = -1
            if first_robot >= 0:
                own_body = first_robot + m
            scan_start = (n * robots + m) * scan.shape[0]
            nearby_count = cell_kernels.around(
                n, lidar_pose.x, lidar_pose.y, lidar.range_max, cells
            )
            begin = 0
            exact_count = 0
            while begin < nearby_count:
                end = min(nearby_count, begin + LANES - in_use)
                in_use, not_looked_up = select_bodies(
                    bodies[n],
                    cells.found[begin:end],
                    own_body,
                    lidar_pose,
                    heading,
                    scan_start,
                    lidar,
                    lanes,
                    in_use,
                )
                begin = end
                exact_count = exact_count + not_looked_up
                if in_use == LANES:
                    look_up(ranges, lidar, lanes, in_use)
                    in_use = 0
            if exact_count > 0 or walls.shape[0] > 0:
                baked.scan_exactly(
                    scan,
                    lidar_pose,
                    bodies[n],
                    cells.found[: nearby_count if exact_count > 0 else 0],
                    own_body,
                    walls,
                    lidar,
                    lanes.walls,
                )
    look_up(ranges, lidar, lanes, in_use)
    if fixtures.squares.size > 0:
        add_maps(ranges, robot_poses, chosen, fixtures, lidar, lanes)


@kernel(contracts=True, inline=True)
def select_bodies(
    bodies: Array,
    nearby: ShortIntegers,
    own_body: int,
    lidar_pose: LidarPose,
    lidar_heading: float,
    scan_start: int,
    lidar: LidarArrays,
    lanes: ScanLanes,
    in_use: int,
) -> tuple[int, int]:
    """Put those bodies that one scan looks up into lanes (step 1).

    Args:
        bodies: (K, 7) of the lidar's world.
        nearby: indices of the bodies to consider, at most as many as lanes are left.
        own_body: index of the robot's own body, which it does not see; -1 for none.
        lidar_pose: of the lidar.
        lidar_heading: of the lidar [rad].
        scan_start: index of the scan's first range in memory.
        lidar: the lidar.
        lanes: where the bodies are put.
        in_use: number of lanes in use before.

    Returns:
        The number of lanes in use, and of visible bodies that have to be scanned exactly.
    """
    doubles = lanes.doubles
    exact_count = 0
    for j in range(nearby.shape[0]):
        body = bodies[np.uintp(nearby[j])]
        is_visible, is_looked_up = baked.classify_body(body, lidar_pose, lidar)
        is_other = nearby[j] != own_body
        k = np.uintp(in_use)
        doubles[k + DX] = body[X] - lidar_pose.x
        doubles[k + DY] = body[Y] - lidar_pose.y
        doubles[k + BODY_HEADING] = body[HEADING]
        doubles[k + BODY_COS] = body[COS]
        doubles[k + BODY_SIN] = body[SIN]
        doubles[k + BODY_RADIUS] = body[RADIUS]
        doubles[k + LIDAR_HEADING] = lidar_heading
        doubles[k + SCAN_START] = scan_start
        lanes.integers[k + BODY_SHAPE] = np.int32(body[SHAPE])
        # The lane counts only if its body is looked up; else the next body overwrites it.
        in_use += is_looked_up & is_other
        exact_count += is_visible & is_other & (not is_looked_up)
    return in_use, exact_count


@kernel
def look_up(ranges: Singles, lidar: LidarArrays, lanes: ScanLanes, in_use: int) -> None:
    """Look up the bodies in the lanes (Eq. 3) and fuse them into their scans (N, M, B) (Eq. 4)."""
    table = lidar.table
    shift = np.int32(table.shift)
    flat_ranges = ranges.reshape(-1).view(np.int32)
    padded = (in_use + BLOCK - 1) // BLOCK * BLOCK
    full_turn = 2.0 * np.pi / lidar.beams.step  # [beams]
    beam_count = np.int32(ranges.shape[2])
    find_polars(padded, lanes)
    find_cells(in_use, table, lanes)
    fetch_cells(in_use, table, lanes)
    find_silhouettes(padded, lidar.beams, lanes)
    for j in range(in_use):
        if lanes.integers[np.uintp(j) + CLIMBS] < 0:
            climb_to_silhouettes(np.uintp(j), lidar, lanes)
    find_all_points(padded, beam_count, shift, lanes)
    for j in range(in_use):
        upcoming = np.uintp(min(j + PREFETCHED_AHEAD, in_use - 1))
        for point in (NEAR_POINT, FAR_POINT):
            prefetch(table.rows, np.intp(lanes.integers[upcoming + point]))
            prefetch(table.rows, np.intp(lanes.integers[upcoming + point] + BLOCK))
        fuse_body(flat_ranges, np.uintp(j), lidar, lanes)
    for j in range(in_use):
        # A body that spans the last beam and the first is fused again, a full turn on.
        if lanes.doubles[np.uintp(j) + LEFT_BEAM] >= full_turn:
            find_body_points(np.uintp(j), full_turn, beam_count, shift, lanes)
            fuse_body(flat_ranges, np.uintp(j), lidar, lanes)


@kernel(contracts=True)
def find_polars(padded: int, lanes: ScanLanes) -> None:
    """Find distance and bearing of each body (step 2); unused lanes hold old values."""
    for j in range(padded):
        k = np.uintp(j)
        distance, bearing = baked.find_polar(
            lanes.doubles[k + DX], lanes.doubles[k + DY]
        )
        lanes.singles[k + DISTANCE] = distance
        lanes.singles[k + BEARING] = bearing


@kernel(contracts=True)
def find_cells(in_use: int, table: TableArrays, lanes: ScanLanes) -> None:
    """Find the cell in the table for each body (step 3)."""
    doubles = lanes.doubles
    singles = lanes.singles
    integers = lanes.integers
    for j in range(in_use):
        k = np.uintp(j)
        shape = table.shapes[np.uintp(integers[k + BODY_SHAPE])]
        cell = baked.find_cell(
            singles[k + DISTANCE],
            singles[k + BEARING],
            doubles[k + BODY_RADIUS],
            doubles[k + BODY_HEADING],
            shape,
            table,
        )
        integers[k + CELL] = cell.place
        integers[k + HULL] = cell.hull
        singles[k + FAR_WEIGHT] = cell.far_weight
        doubles[k + ROUND_RADIUS] = shape.round_radius


@kernel
def fetch_cells(in_use: int, table: TableArrays, lanes: ScanLanes) -> None:
    """Fetch rows and corners of each cell (step 3).

    Most cache misses occur here, where no arithmetic waits for them.
    """
    doubles = lanes.doubles
    integers = lanes.integers
    for j in range(in_use):
        k = np.uintp(j)
        hull = integers[k + HULL]
        cell = np.uintp(integers[k + CELL])
        near = table.cells[cell]
        far = table.cells[cell + np.uintp(1)]
        integers[k + NEAR_START] = near[baked.ROW_START]
        integers[k + NEAR_EXTENT] = near[baked.ROW_EXTENT]
        integers[k + FAR_START] = far[baked.ROW_START]
        integers[k + FAR_EXTENT] = far[baked.ROW_EXTENT]
        _, right_second = baked.unpack_corners(near[RIGHT_CORNERS])
        _, left_second = baked.unpack_corners(near[LEFT_CORNERS])
        integers[k + CLIMBS] = right_second | left_second
        for packed, x_lane in (
            (near[RIGHT_CORNERS], RIGHT_X),
            (near[LEFT_CORNERS], LEFT_X),
        ):
            first, second = baked.unpack_corners(packed)
            corner = table.hulls[np.uintp(hull + first)]
            corner2 = table.hulls[np.uintp(hull + max(second, 0))]
            doubles[k + x_lane] = corner[0]
            doubles[k + x_lane + np.uintp(LANES)] = corner[1]
            doubles[k + x_lane + np.uintp(2 * LANES)] = corner2[0]
            doubles[k + x_lane + np.uintp(3 * LANES)] = corner2[1]


@kernel(contracts=True)
def find_silhouettes(padded: int, beams: Beams, lanes: ScanLanes) -> None:
    """Find the silhouettes of each body (step 4), the outer of two corners, in beams (step 5)."""
    doubles = lanes.doubles
    for j in range(padded):
        k = np.uintp(j)
        view = view_body(k, lanes)
        round_radius = doubles[k + ROUND_RADIUS]
        right = baked.find_tangent(
            view,
            doubles[k + RIGHT_X],
            doubles[k + RIGHT_Y],
            doubles[k + RIGHT_X2],
            doubles[k + RIGHT_Y2],
            round_radius,
            RIGHT,
        )
        left = baked.find_tangent(
            view,
            doubles[k + LEFT_X],
            doubles[k + LEFT_Y],
            doubles[k + LEFT_X2],
            doubles[k + LEFT_Y2],
            round_radius,
            LEFT,
        )
        store_span(k, right, left, beams, lanes)


@kernel(contracts=True)
def climb_to_silhouettes(k: int, lidar: LidarArrays, lanes: ScanLanes) -> None:
    """Find the silhouettes of a body that two corners do not determine (steps 4 and 5)."""
    integers = lanes.integers
    table = lidar.table
    view = view_body(k, lanes)
    shape = table.shapes[np.uintp(integers[k + BODY_SHAPE])]
    cell = table.cells[np.uintp(integers[k + CELL])]
    hull = integers[k + HULL]
    right = baked.find_silhouette(
        view, cell[RIGHT_CORNERS], hull, table.hulls, shape, RIGHT
    )
    left = baked.find_silhouette(
        view, cell[LEFT_CORNERS], hull, table.hulls, shape, LEFT
    )
    store_span(k, right, left, lidar.beams, lanes)


@kernel(contracts=True, inline=True)
def view_body(k: int, lanes: ScanLanes) -> ShapeView:
    """Return the view of the body in a lane."""
    doubles = lanes.doubles
    view: ShapeView = baked.view_shape(
        doubles[k + DX], doubles[k + DY], doubles[k + BODY_COS], doubles[k + BODY_SIN]
    )
    return view


@kernel(contracts=True, inline=True)
def store_span(
    k: int, right: float, left: float, beams: Beams, lanes: ScanLanes
) -> None:
    """Store bearing and silhouettes of the body in a lane, as beams."""
    doubles = lanes.doubles
    bearing = lanes.singles[k + BEARING]
    heading = doubles[k + LIDAR_HEADING]
    span = baked.convert_to_beams(bearing, right, left, heading, beams)
    doubles[k + CENTRE_BEAM] = span.centre
    doubles[k + RIGHT_BEAM] = span.right
    doubles[k + LEFT_BEAM] = span.left


@kernel(contracts=True)
def find_all_points(padded: int, beam_count: int, shift: int, lanes: ScanLanes) -> None:
    """Find the beams that hit each body, and its points in the table (steps 5 and 6)."""
    for j in range(padded):
        find_body_points(np.uintp(j), 0.0, beam_count, shift, lanes)


@kernel(contracts=True, inline=True)
def find_body_points(
    k: int, turned_by: float, beam_count: int, shift: int, lanes: ScanLanes
) -> None:
    """Find the beams that hit one body, and its points in the table (steps 5 and 6).

    A body across the seam of the circle is fused twice, the second time `turned_by` a full turn
    [beams]. Whole blocks of beams are fused, at least two, which most bodies need: a varying number
    would often mispredict a branch. Where blocks would end beyond the last beam, they start
    `LEADING` beams earlier.
    """
    doubles = lanes.doubles
    integers = lanes.integers
    zero = np.int32(0)
    span = BeamSpan(
        doubles[k + CENTRE_BEAM] - turned_by,
        doubles[k + RIGHT_BEAM] - turned_by,
        doubles[k + LEFT_BEAM] - turned_by,
    )
    hits = baked.find_hits(span, beam_count, shift)
    near, near_next = baked.find_points(
        integers[k + NEAR_START], integers[k + NEAR_EXTENT], hits, shift
    )
    far, far_next = baked.find_points(
        integers[k + FAR_START], integers[k + FAR_EXTENT], hits, shift
    )
    width = np.int32(
        max(
            np.int32(hits.beams + BLOCK - 1) & np.int32(-BLOCK),
            np.int32(FEWEST_BLOCKS * BLOCK),
        )
    )
    leading = np.int32(max(np.int32(hits.first_beam + width - beam_count), zero))
    blocks = np.int32(
        max(np.int32(hits.beams + leading + BLOCK - 1) >> BLOCK_SHIFT, FEWEST_BLOCKS)
    )
    # Blocks must start neither before the table nor before the scan.
    lowest = np.int32(
        min(min(near, near_next), min(min(far, far_next), hits.first_beam)) - leading
    )
    integers[k + BLOCKS] = blocks if (lowest >= 0) & (hits.beams > 0) else zero
    integers[k + HITS] = hits.beams
    integers[k + LEADING] = leading
    integers[k + NEAR_POINT] = np.int32(near - leading)
    integers[k + NEAR_NEXT] = np.int32(near_next - leading)
    integers[k + FAR_POINT] = np.int32(far - leading)
    integers[k + FAR_NEXT] = np.int32(far_next - leading)
    lanes.singles[k + NEXT_WEIGHT] = hits.next_weight
    doubles[k + FUSED_FROM] = doubles[k + SCAN_START] + (hits.first_beam - leading)


@kernel(contracts=True, inline=True)
def fuse_body(
    flat_ranges: ShortIntegers, k: int, lidar: LidarArrays, lanes: ScanLanes
) -> None:
    """Fuse one body into its scan (step 7), in blocks of beams or, where none fits, beam by beam.

    `flat_ranges` are the ranges of all scans, see `fuse_beam`.
    """
    integers = lanes.integers
    blocks = integers[k + BLOCKS]
    hits = integers[k + HITS]
    leading = integers[k + LEADING]
    weights = BlendWeights(
        lanes.singles[k + NEXT_WEIGHT], lanes.singles[k + FAR_WEIGHT]
    )
    skipped = np.int64(0 if blocks > 0 else leading)
    points = RowPoints(
        np.uintp(integers[k + NEAR_POINT] + skipped),
        np.uintp(integers[k + NEAR_NEXT] + skipped),
        np.uintp(integers[k + FAR_POINT] + skipped),
        np.uintp(integers[k + FAR_NEXT] + skipped),
    )
    if blocks > 0:
        fused_from = np.uintp(lanes.doubles[k + FUSED_FROM])
        hit = np.int32(-leading)
        for j in range(blocks * BLOCK):
            # An unsigned comparison covers both ends: beams before the first hit are negative.
            is_hit = np.uint32(hit) < np.uint32(hits)
            fuse_beam(
                flat_ranges, fused_from, np.uintp(j), is_hit, points, weights, lidar
            )
            hit = np.int32(hit + np.int32(1))  # 32 bits wide, like the ranges
    else:
        fused_from = np.uintp(lanes.doubles[k + FUSED_FROM] + leading)
        for j in range(hits):
            fuse_beam(
                flat_ranges, fused_from, np.uintp(j), True, points, weights, lidar
            )


@kernel(contracts=True, inline=True)
def fuse_beam(
    flat_ranges: ShortIntegers,
    fused_from: int,
    offset: int,
    is_hit: bool,
    points: RowPoints,
    weights: BlendWeights,
    lidar: LidarArrays,
) -> None:
    """Lower the range of the beam at `fused_from + offset` to the body's, if it hits (Eq. 4).

    Ranges are compared as integers, because LLVM would mask the store of a float's minimum. Both
    orders agree: ranges are positive, or -inf, which as an integer is below all others.
    """
    value = baked.blend_range(
        lidar.table.rows,
        points,
        offset,
        weights,
        np.float32(lidar.range_min),
        np.float32(lidar.range_max),
    )
    value = value if is_hit else np.float32(np.inf)
    i = fused_from + offset
    flat_ranges[i] = min(flat_ranges[i], np.float32(value).view(np.int32))


@kernel
def add_maps(
    ranges: Singles,
    robot_poses: Array,
    chosen: Integers,
    fixtures: Fixtures,
    lidar: LidarArrays,
    lanes: ScanLanes,
) -> None:
    """Fuse static maps into the scans of some worlds, see `scan_worlds`."""
    for n in chosen:
        grid = grid_of(n, fixtures)
        for m in range(robot_poses.shape[1] if grid.squares.size > 0 else 0):
            lidar_pose, _ = baked.locate_lidar(robot_poses[n, m], lidar.mount)
            map_kernels.map_into(
                ranges[n, m],
                lidar.beams,
                lidar_pose,
                lidar.range_max,
                grid,
                lidar.exact,
                lanes,
            )
            exact_kernels.finish(ranges[n, m], lidar.range_min, lidar.range_max)
