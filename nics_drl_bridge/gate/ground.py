"""Ground where the lidar never looks: free as far as it was seen, or the robot stood there."""

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from nics_drl_bridge.gate import shield_kernels
from nics_drl_bridge.gate.shield_kernels import Body, Cells, Look, MountedBeams
from nics_drl_bridge.gate.state import Ground, Ranges, View
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.sim.collision_kernels import Outline

CELL, CELLS = 0.05, 48
"""Width of a cell [m], and their number along each side of what is remembered."""
# time after which ground is forgotten, but for what is beside the robot [s]
REMEMBERED_S = 30.0


def look(
    before: Ground | None,
    view: View,
    lidar: MountedBeams,
    body: Body,
    far: float,
    tolerance: float,
) -> Ground:
    """Returns the ground after a view; without an earlier one that around the robot may be free.

    Args:
        before: what was known.
        view: of the newest scan.
        lidar: its beams.
        body: footprint of the robot, and the margin around it.
        far: greatest range [m].
        tolerance: margin before a return that is not free [m].
    """
    x, y, heading = view.pose.tolist()
    corner = (math.floor(x / CELL) - CELLS // 2, math.floor(y / CELL) - CELLS // 2)
    away = (corner[0] * CELL - x, corner[1] * CELL - y)
    place = Cells(*away, CELL, math.cos(heading), math.sin(heading))
    room = body.radius + body.margin + CELL
    if before is None:
        since = view.stamp_ns
        times = np.full((CELLS, CELLS), -np.inf, np.float32)
        disc = body._replace(outline=Outline(np.zeros((0, 2)), 0, 0), radius=0.0)
        shield_kernels.cover(
            times, place, disc, min(room, _find_nearest(view.ranges, lidar)), 0.0
        )
    else:
        since = before.since_ns
        moved = np.subtract(corner, before.corner)
        times = shield_kernels.shift_cells(before.times, *moved.tolist())
    now = (view.stamp_ns - since) * S_PER_NS
    given = Look(now, now - REMEMBERED_S, far, tolerance)
    sees = shield_kernels.mark_seen_cells(times, place, view.ranges, lidar, room, given)
    shield_kernels.cover(times, place, body, 0.0, now)
    return Ground(since, corner, times, shield_kernels.find_unseen(times, sees, place))


def _find_nearest(ranges: Ranges, lidar: MountedBeams) -> float:
    """Distance [m] to the nearest end of the beams (B,): the middle one of five, as one may err."""
    angles = lidar.first + lidar.step * np.arange(len(ranges)) + lidar.heading
    short = np.where(np.isneginf(ranges), 0.0, ranges)  # too close to be measured
    ends = np.hypot(lidar.x + short * np.cos(angles), lidar.y + short * np.sin(angles))
    ends[np.isnan(ends)] = np.inf  # unknown
    beside = sliding_window_view(np.pad(ends, 2, constant_values=np.inf), 5)
    return float(np.median(beside, axis=1).min(initial=np.inf))
