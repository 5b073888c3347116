"""A scan of one robot body by body, in the plainest order: what `scan_kernels` has to equal."""

import math

import numpy as np

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar import exact_kernels
from nics_drl_bridge.lidar.baked_kernels import (
    LEFT,
    LEFT_CORNERS,
    RIGHT,
    RIGHT_CORNERS,
    ROW_EXTENT,
    ROW_START,
    BeamSpan,
    BlendWeights,
    RowPoints,
    blend_range,
    classify_body,
    convert_to_beams,
    find_cell,
    find_hits,
    find_points,
    find_polar,
    find_silhouette,
    locate_lidar,
    scan_exactly,
    view_shape,
)
from nics_drl_bridge.lidar.exact_kernels import COS, HEADING, RADIUS, SHAPE, SIN, X, Y


@kernel(allocates=True)
def scan_robot(ranges, robot_pose, bodies, own_body, walls, lidar):  # type: ignore[no-untyped-def]
    """One scan (B,): the minimum over all bodies (K, 7) but the robot's own, and walls (Eq. 4)."""
    for i in range(ranges.shape[0]):
        ranges[i] = np.float32(np.inf)
    lidar_pose, heading = locate_lidar(robot_pose, lidar.mount)
    for k in range(bodies.shape[0]):
        _, is_looked_up = classify_body(bodies[k], lidar_pose, lidar)
        if k != own_body and is_looked_up:
            look_up(ranges, lidar_pose, heading, bodies[k], lidar)
    scratch = np.zeros(11 * exact_kernels.TOGETHER)
    near = range(bodies.shape[0])
    scan_exactly(ranges, lidar_pose, bodies, near, own_body, walls, lidar, scratch)


@kernel(contracts=True, inline=True)
def look_up(ranges, lidar_pose, lidar_heading, body, lidar):  # type: ignore[no-untyped-def]
    """Fuses one body into a scan (B,) by the table rows of its relative pose (Eq. 3)."""
    table = lidar.table
    shape = table.shapes[np.uintp(np.int32(body[SHAPE]))]
    dx = body[X] - lidar_pose.x
    dy = body[Y] - lidar_pose.y
    distance, bearing = find_polar(dx, dy)
    cell = find_cell(distance, bearing, body[RADIUS], body[HEADING], shape, table)
    near = table.cells[np.uintp(cell.place)]
    far = table.cells[np.uintp(cell.place + 1)]
    view = view_shape(dx, dy, body[COS], body[SIN])
    hulls = table.hulls
    right = find_silhouette(view, near[RIGHT_CORNERS], cell.hull, hulls, shape, RIGHT)
    left = find_silhouette(view, near[LEFT_CORNERS], cell.hull, hulls, shape, LEFT)
    span = convert_to_beams(bearing, right, left, lidar_heading, lidar.beams)
    fuse(ranges, span, near, far, cell.far_weight, lidar)
    turn = 2.0 * math.pi / lidar.beams.step
    if span.left >= turn:  # across the seam of the circle
        turned = BeamSpan(span.centre - turn, span.right - turn, span.left - turn)
        fuse(ranges, turned, near, far, cell.far_weight, lidar)


@kernel(contracts=True, inline=True)
def fuse(ranges, span, near, far, far_weight, lidar):  # type: ignore[no-untyped-def]
    """Lowers the beams of a span to two blended rows, of cells (4,) (Eq. 4)."""
    shift = lidar.table.shift
    hits = find_hits(span, ranges.shape[0], shift)
    near_points = find_points(near[ROW_START], near[ROW_EXTENT], hits, shift)
    far_points = find_points(far[ROW_START], far[ROW_EXTENT], hits, shift)
    points = RowPoints(near_points[0], near_points[1], far_points[0], far_points[1])
    weights = BlendWeights(hits.next_weight, far_weight)
    range_min = np.float32(lidar.range_min)
    range_max = np.float32(lidar.range_max)
    for j in range(hits.beams):
        value = blend_range(lidar.table.rows, points, j, weights, range_min, range_max)
        ranges[hits.first_beam + j] = min(ranges[hits.first_beam + j], value)
