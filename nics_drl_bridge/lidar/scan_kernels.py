"""Scans of whole worlds: the minimum over all bodies, walls and the map, for each beam (Eq. 4)."""

from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import map_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers, ShortIntegers, Singles
from nics_drl_bridge.lidar.beam_kernels import (
    INF_BITS,
    Beams,
    LidarPose,
    locate_lidar,
)
from nics_drl_bridge.lidar.exact_kernels import (
    RADIUS,
    SHAPE,
    OutlineArrays,
    X,
    Y,
    scan_body,
    scan_walls,
)
from nics_drl_bridge.lidar.lookup_kernels import (
    LEAST_FUSED,
    LOOK_UP,
    TableArrays,
    fuse_look_ups,
    look_up_body,
)

# Look-ups that are fused together: while one waits for memory, the next ones proceed.
MOST_FOUND = 64


class LidarArrays(NamedTuple):
    """A lidar with its table, for the kernels."""

    mount: Array  # (3,) pose on the robot
    beams: Beams
    range_min: float  # [m]
    range_max: float  # [m]
    sweep_time: float  # duration of a sweep [s]
    # (H, 2) squared minimum and maximum distance of a look-up, per shape [m^2]
    between: Array
    outlines: OutlineArrays  # of the shapes
    table: TableArrays
    exact: bool  # True if maps are scanned exactly, from cell to cell


class ScanScratch(NamedTuple):
    """Scratch memory of the scans of one thread."""

    scan: ShortIntegers  # the scan while it is made, see `beam_kernels`
    found: Any  # (MOST_FOUND,) of `LOOK_UP`
    singles: Singles  # of `map_kernels`
    integers: ShortIntegers


def scan_scratch(beam_count: int) -> ScanScratch:
    """Allocate the memory that one thread needs to scan."""
    return ScanScratch(
        np.zeros(beam_count + max(LEAST_FUSED, map_kernels.LANES), np.int32),
        np.zeros(MOST_FOUND, LOOK_UP),
        np.zeros(map_kernels.SINGLES * map_kernels.LANES, np.float32),
        np.zeros(map_kernels.INTEGERS * map_kernels.LANES, np.int32),
    )


@kernel
def scan_worlds(
    ranges: Singles,
    robot_poses: Array,
    chosen: Integers,
    bodies: Array,
    nearby: ShortIntegers,
    first_robot: int,
    fixtures: map_kernels.Fixtures,
    lidar: LidarArrays,
    scratch: ScanScratch,
) -> None:
    """Scan from all robots of some worlds.

    Args:
        ranges: (N, M, B) the scans [m], which are overwritten.
        robot_poses: (N, M, 3).
        chosen: (n,) the worlds to scan.
        bodies: (N, K, 7).
        nearby: indices of the bodies to consider.
        first_robot: index of the body of the first robot; those of the other robots
            follow. -1 if robots have no bodies.
        fixtures: walls and maps of the worlds.
        lidar: the lidar of every robot.
        scratch: scratch memory.
    """
    for n in chosen:
        for m in range(robot_poses.shape[1]):
            own_body = -1
            if first_robot >= 0:
                own_body = first_robot + m
            pose = locate_lidar(robot_poses[n, m], lidar.mount)
            scan_robot(
                ranges[n, m],
                n,
                pose,
                bodies[n],
                nearby,
                own_body,
                fixtures,
                lidar,
                scratch,
            )


@kernel
def scan_robot(
    ranges: Singles,
    n: int,
    pose: LidarPose,
    bodies: Array,
    nearby: ShortIntegers,
    own_body: int,
    fixtures: map_kernels.Fixtures,
    lidar: LidarArrays,
    scratch: ScanScratch,
) -> None:
    """Scan from one robot of the world n.

    Args:
        ranges: (B,) the scan [m], which is overwritten.
        n: the world in `fixtures`.
        pose: of the lidar.
        bodies: (K, 7) of the world.
        nearby: indices of the bodies to consider.
        own_body: index of the robot's own body, which is skipped; -1 for none.
        fixtures: walls and maps.
        lidar: the lidar.
        scratch: scratch memory.
    """
    scan = scratch.scan
    for i in range(len(scan)):
        scan[i] = INF_BITS
    count = 0
    rows = lidar.table.rows
    for k in nearby:
        body = bodies[np.uintp(k)]
        is_visible, is_looked_up = classify_body(body, pose, lidar)
        if not is_visible or k == own_body:
            continue
        if not is_looked_up:
            scan_body(scan, lidar.beams, pose, body, lidar.outlines)
            continue
        if count > MOST_FOUND - 2:
            fuse_look_ups(scan, rows, scratch.found[:count])
            count = 0
        count = look_up_body(body, pose, lidar.beams, lidar.table, scratch.found, count)
    fuse_look_ups(scan, rows, scratch.found[:count])
    scan_walls(
        scan, lidar.beams, pose, map_kernels.walls_of(n, fixtures), lidar.range_max
    )
    if fixtures.squares.size > 0:
        map_kernels.scan_map(
            scan,
            lidar.beams,
            pose,
            lidar.range_max,
            map_kernels.grid_of(n, fixtures),
            lidar.exact,
            scratch.singles,
            scratch.integers,
        )
    _write_ranges(ranges, scan.view(np.float32), lidar)


@kernel(inline=True)
def _write_ranges(ranges: Singles, distances: Singles, lidar: LidarArrays) -> None:
    """Write a scan (B,): `inf` for what is too far, `-inf` for what is too close (REP-117)."""
    low = np.float32(lidar.range_min)
    high = np.float32(lidar.range_max)
    for b in range(len(ranges)):
        beam = np.uintp(b)
        value = distances[beam]
        value = value if value <= high else np.float32(np.inf)
        ranges[beam] = value if value >= low else np.float32(-np.inf)


@kernel(contracts=True, inline=True)
def classify_body(
    body: Array, pose: LidarPose, lidar: LidarArrays
) -> tuple[bool, bool]:
    """Return whether a body (7,) is visible, and whether to look it up.

    It is visible unless it is absent, out of range, or behind all beams. A visible body that is not
    looked up is scanned exactly: the lidar is within its circle, or the table is too coarse.
    """
    dx = body[X] - pose.x
    dy = body[Y] - pose.y
    radius = body[RADIUS]
    distance2 = dx * dx + dy * dy
    reach = lidar.range_max + radius
    ahead = pose.c * dx + pose.s * dy
    aside = pose.c * dy - pose.s * dx
    behind = lidar.beams.behind
    is_behind = (behind[0, 0] * ahead + behind[0, 1] * aside >= radius) & (
        behind[1, 0] * ahead + behind[1, 1] * aside >= radius
    )
    is_visible = (distance2 <= reach * reach) & (radius > 0.0) & (not is_behind)
    h = np.uintp(np.int32(body[SHAPE]))
    is_in_table = (distance2 >= lidar.between[h, 0]) & (
        distance2 <= lidar.between[h, 1]
    )
    return is_visible, is_visible & (distance2 >= radius * radius) & is_in_table
