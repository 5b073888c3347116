"""Ground outside the lidar's view: free where it was seen, or covered by the robot.

It is stored in square cells in the frame of odometry, each with the time when it was
last known to be free. A new scan changes them in these steps:

1. Shift the cells to centre them on the robot.
2. Forget cells that were seen too long ago, except next to the robot.
3. Mark cells that the scan shows as free, and cells where beams end as not free.
4. Mark cells under the robot as free.
5. Find the border of what is known, which counts as an obstacle.
"""

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from nics_drl_bridge.gate import ground_kernels
from nics_drl_bridge.gate.evidence import TOLERANCE, get_beams
from nics_drl_bridge.gate.evidence_kernels import MountedBeams
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.ground_kernels import Grid
from nics_drl_bridge.gate.shield_kernels import Body
from nics_drl_bridge.gate.state import GateConfig, Ground, Ranges, View
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.sim.collision_kernels import Outline

CELL = 0.05  # width of a cell [m]
CELLS = 48  # minimum number of cells along each side of the ground that is remembered
# Ground is remembered at least this far beyond the robot and its margin [m].
REACH_BEYOND = 0.6
# time after which ground is forgotten, except next to the robot [s]
REMEMBERED_S = 30.0
MEDIAN_BEAMS = 5  # number of beams in a median, because a single one may be wrong
NO_OUTLINE = Outline(np.zeros((0, 2)), 0, 0)  # of a body that is a circle


def update_ground(
    config: GateConfig, views: tuple[View, ...], before: Ground | None
) -> Ground | None:
    """Returns the ground known after the newest view; None if the lidar covers the full circle.

    Without earlier ground, the area around the robot is assumed to be free.
    """
    shield = config.shield
    if shield is None or not views:
        return None
    lidar = get_beams(config)
    blind_angle = 2.0 * np.pi - abs(lidar.step) * len(config.beam_angles)
    if blind_angle < shield.unknown_share * shield.unknown_width:
        return None  # too little to count as unknown
    return observe_ground(before, views[-1], lidar, get_body(shield), shield.range_max)


def observe_ground(
    before: Ground | None,
    view: View,
    lidar: MountedBeams,
    body: Body,
    range_max: float,
) -> Ground:
    """Returns the ground after a view.

    Args:
        before: the ground after the view before; None at the first one.
        view: of the newest scan.
        lidar: its beams.
        body: footprint of the robot, and the margin around it.
        range_max: of the lidar [m].
    """
    kept_radius = body.radius + body.margin + CELL
    count = max(CELLS, 2 * math.ceil((kept_radius + REACH_BEYOND) / CELL))
    corner, grid = _centre_cells(view.pose, count)
    if before is None:
        since_ns = view.stamp_ns
        times = np.full((count, count), -np.inf, np.float32)
        free_radius = min(kept_radius, _find_nearest(view.ranges, lidar))
        circle = body._replace(outline=NO_OUTLINE, radius=free_radius)
        ground_kernels.mark_covered(times, grid, circle, 0.0)
    else:
        since_ns = before.since_ns
        moved = np.subtract(corner, before.corner).tolist()
        times = ground_kernels.shift_cells(before.times, *moved)
    now = (view.stamp_ns - since_ns) * S_PER_NS
    ground_kernels.forget_old(times, grid, kept_radius, now, now - REMEMBERED_S)
    is_seen = ground_kernels.mark_seen(
        times, grid, view.ranges, lidar, range_max, TOLERANCE, now
    )
    ground_kernels.mark_covered(times, grid, body, now)
    unseen = ground_kernels.find_unseen(times, is_seen, grid)
    return Ground(since_ns, corner, times, unseen)


def _centre_cells(pose: Array, count: int) -> tuple[tuple[int, int], Grid]:
    """Returns the first of `count` cells along each axis around a pose (3,), and their grid."""
    x, y, heading = pose.tolist()
    corner = (math.floor(x / CELL) - count // 2, math.floor(y / CELL) - count // 2)
    grid = Grid(
        x=corner[0] * CELL - x,
        y=corner[1] * CELL - y,
        width=CELL,
        cosine=math.cos(heading),
        sine=math.sin(heading),
    )
    return corner, grid


def _find_nearest(ranges: Ranges, lidar: MountedBeams) -> float:
    """Returns the distance [m] from the robot to the nearest end of the beams (B,).

    It is the smallest median of neighbours, so that a single wrong beam does not
    matter.
    """
    angles = lidar.first + lidar.step * np.arange(len(ranges)) + lidar.heading
    # Beams that are too close to measure end at the lidar.
    lengths = np.where(np.isneginf(ranges), 0.0, ranges)
    ends = np.hypot(
        lidar.x + lengths * np.cos(angles), lidar.y + lengths * np.sin(angles)
    )
    ends[np.isnan(ends)] = np.inf
    padded = np.pad(ends, MEDIAN_BEAMS // 2, constant_values=np.inf)
    windows = sliding_window_view(padded, MEDIAN_BEAMS)
    return float(np.median(windows, axis=1).min(initial=np.inf))
