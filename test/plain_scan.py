"""A scan of one robot body by body, in the plainest order: what `scan_kernels` has to equal."""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import exact_kernels
from nics_drl_bridge.lidar.baked_kernels import (
    LOOKED_UP,
    beams_between,
    blended,
    compute,
    in_beams,
    nearest_cell,
    points_of,
    polar,
    seen_at,
    sensor_pose,
    silhouette,
    way_of,
)
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


@kernel(allocates=True)
def scan_robot(out, pose, bodies, me, walls, lidar):  # type: ignore[no-untyped-def]
    """One scan (B,): the minimum over all bodies (K, 7) but the robot's own, and walls (Eq. 4)."""
    for i in range(out.shape[0]):
        out[i] = np.float32(np.inf)
    x, y, heading = sensor_pose(pose, lidar.mount)
    for k in range(bodies.shape[0]):
        if k != me and way_of(bodies[k], x, y, lidar) == LOOKED_UP:
            look_up(out, x, y, heading, bodies[k], lidar)
    here = LidarPose(x, y, math.cos(heading), math.sin(heading))
    found = np.zeros(11 * exact_kernels.TOGETHER)
    compute(out, here, bodies, me, range(bodies.shape[0]), walls, lidar, found)


@kernel(contracts=True, inline=True)
def look_up(out, x, y, heading, body, lidar):  # type: ignore[no-untyped-def]
    """Fuses one body into a scan (B,) by the table row of its nearest relative pose (Eq. 3)."""
    table = lidar.table
    shape = table.shapes[np.uintp(np.int32(body[SHAPE]))]
    dx = body[X] - x
    dy = body[Y] - y
    distance, bearing = polar(dx, dy)
    cell, hull, blend = nearest_cell(
        distance, bearing, body[RADIUS], body[HEADING], shape, table
    )
    near = table.cells[np.uintp(cell)]
    far = table.cells[np.uintp(cell + 1)]
    seen = seen_at(dx, dy, body[COS], body[SIN])
    right = silhouette(near[2], hull, shape, table.hulls, seen, 1.0)
    left = silhouette(near[3], hull, shape, table.hulls, seen, -1.0)
    middle, low, high = in_beams(right, left, bearing, heading, lidar.beams)
    fuse(out, middle, low, high, near, far, blend, lidar)
    turn = 2.0 * math.pi / lidar.beams.step
    if high >= turn:  # across the seam of the circle
        fuse(out, middle - turn, low - turn, high - turn, near, far, blend, lidar)


@kernel(contracts=True, inline=True)
def fuse(out, middle, low, high, near, far, blend, lidar):  # type: ignore[no-untyped-def]
    """Lowers the beams from `low` to `high` to two blended rows, of cells (4,) (Eq. 4)."""
    rows = lidar.table.rows
    shift = lidar.table.shift
    begin, hits, point, share = beams_between(middle, low, high, out.shape[0], shift)
    one, two = points_of(near[0], near[1], point, shift, hits)
    other, other2 = points_of(far[0], far[1], point, shift, hits)
    range_min = np.float32(lidar.range_min)
    range_max = np.float32(lidar.range_max)
    for j in range(hits):
        value = blended(
            rows,
            one + j,
            two + j,
            other + j,
            other2 + j,
            share,
            blend,
            range_min,
            range_max,
        )
        out[begin + j] = min(out[begin + j], value)
