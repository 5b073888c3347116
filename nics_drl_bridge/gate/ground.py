"""Ground where the lidar never looks: free as far as it was seen, or the robot stood there."""

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from nics_drl_bridge.gate import shield_kernels
from nics_drl_bridge.gate.shield_kernels import Body, Cells, Look, MountedBeams
from nics_drl_bridge.gate.state import Ground, Ranges, View
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.sim.collision_kernels import Outline

CELL = 0.05  # width of a cell [m]
CELLS = 48  # minimum number of cells along each side of the ground that is remembered
# Ground is remembered at least this far beyond the robot and its margin [m].
REACH_BEYOND = 0.6
# time after which ground is forgotten, except beside the robot [s]
REMEMBERED_S = 30.0


def look(
    before: Ground | None,
    view: View,
    lidar: MountedBeams,
    body: Body,
    range_max: float,
    tolerance: float,
) -> Ground:
    """Returns the ground after a view; without earlier ground, that around the robot may be free.

    Args:
        before: the ground after the view before.
        view: of the newest scan.
        lidar: its beams.
        body: footprint of the robot, and the margin around it.
        range_max: of the lidar [m].
        tolerance: margin before a return that is not free [m].
    """
    x, y, heading = view.pose.tolist()
    kept_radius = body.radius + body.margin + CELL
    count = max(CELLS, 2 * math.ceil((kept_radius + REACH_BEYOND) / CELL))
    corner = (math.floor(x / CELL) - count // 2, math.floor(y / CELL) - count // 2)
    corner_x = corner[0] * CELL - x
    corner_y = corner[1] * CELL - y
    cells = Cells(corner_x, corner_y, CELL, math.cos(heading), math.sin(heading))
    if before is None:
        since_ns = view.stamp_ns
        times = np.full((count, count), -np.inf, np.float32)
        point = body._replace(outline=Outline(np.zeros((0, 2)), 0, 0), radius=0.0)
        free_radius = min(kept_radius, _find_nearest(view.ranges, lidar))
        shield_kernels.cover(times, cells, point, free_radius, 0.0)
    else:
        since_ns = before.since_ns
        columns_moved, rows_moved = np.subtract(corner, before.corner).tolist()
        times = shield_kernels.shift_cells(before.times, columns_moved, rows_moved)
    now = (view.stamp_ns - since_ns) * S_PER_NS
    terms = Look(now, now - REMEMBERED_S, range_max, tolerance)
    is_seen = shield_kernels.mark_seen_cells(
        times, cells, view.ranges, lidar, kept_radius, terms
    )
    shield_kernels.cover(times, cells, body, 0.0, now)
    unseen = shield_kernels.find_unseen(times, is_seen, cells)
    return Ground(since_ns, corner, times, unseen)


def _find_nearest(ranges: Ranges, lidar: MountedBeams) -> float:
    """Returns the distance [m] to the nearest end of the beams (B,).

    It is the smallest median of five neighbours, because a single beam may err.
    """
    angles = lidar.first + lidar.step * np.arange(len(ranges)) + lidar.heading
    # Beams that are too close to measure end at the lidar.
    lengths = np.where(np.isneginf(ranges), 0.0, ranges)
    ends = np.hypot(
        lidar.x + lengths * np.cos(angles), lidar.y + lengths * np.sin(angles)
    )
    ends[np.isnan(ends)] = np.inf
    windows = sliding_window_view(np.pad(ends, 2, constant_values=np.inf), 5)
    return float(np.median(windows, axis=1).min(initial=np.inf))
