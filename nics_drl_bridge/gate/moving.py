"""What of a scan moves: it stands where, a moment ago, the robot looked through.

The newest scan is laid over some older ones, by odometry. So it is known of each beam whether the
place where it ends was seen to be free before; what is there now has come there, and comes on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.gate import moving_kernels
from nics_drl_bridge.gate.inputs import Scan
from nics_drl_bridge.gate.state import GateConfig, GateState, ShieldConfig, View
from nics_drl_bridge.interface import S_PER_NS

MEMORY_S, SPACING_S = 0.45, 0.09
"""So old is a scan at most that the newest is compared with, and so far are they apart [s]."""
TOLERANCE_M, DEVIATIONS = 0.03, 3.0
"""A place is free up to this, and so many standard deviations of the ranges, before its end [m]."""


def remember(config: GateConfig, state: GateState, scan: Scan) -> tuple[View, ...]:
    """The views of before that still count, oldest first, and that of a new scan at the end."""
    if config.shield is None or state.odometry is None:
        return ()
    late = np.clip((scan.stamp_ns - state.odometry.stamp_ns) * S_PER_NS, -MEMORY_S, MEMORY_S)
    pose = geometry.compose(state.odometry.pose, geometry.exp(late * state.odometry.twist))
    newest = View(scan.stamp_ns, pose, scan.ranges)
    kept: list[View] = []
    for view in state.views:
        young = (scan.stamp_ns - view.stamp_ns) * S_PER_NS <= MEMORY_S
        if young and (not kept or (view.stamp_ns - kept[-1].stamp_ns) * S_PER_NS >= SPACING_S):
            kept.append(view)
    return (*kept, newest)


def movers(config: GateConfig, shield: ShieldConfig, views: tuple[View, ...]) -> NDArray[np.bool_]:
    """(B,) which beams of the newest view end on something that moves.

    One beam alone is noise: a neighbour has to say the same.
    """
    newest = views[-1]
    marked = np.zeros(len(newest.ranges), np.bool_)
    angles = config.beam_angles
    if len(angles) < 2 or shield.obstacle_speed == 0.0:
        return marked
    lidar = (float(angles[0]), float(angles[1] - angles[0]), *config.mount)
    noise, share = (DEVIATIONS * std for std in shield.range_noise)
    for view in views[:-1]:
        moved = geometry.between(view.pose, newest.pose)
        moving_kernels.entered(
            marked, newest.ranges, view.ranges, lidar, moved, shield.range_max,
            (TOLERANCE_M + noise, share),
        )  # fmt: skip
    beside = np.zeros_like(marked)
    beside[1:] |= marked[:-1]
    beside[:-1] |= marked[1:]
    return marked & beside


def rehearse() -> None:
    """Compiles what `movers` calls."""
    lidar, scan = (0.0, 0.1, 0.0, 0.0, 0.0), np.ones(1, np.float32)
    moving_kernels.entered(np.zeros(1, np.bool_), scan, scan, lidar, np.zeros(3), 1.0, (0.0, 0.0))
