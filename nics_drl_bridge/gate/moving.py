"""Detection of motion in a scan: objects where the robot saw free space a moment ago.

The newest scan is compared with some older ones by odometry. So for each beam it is known whether
the place where it ends was seen to be free before; what is there now has moved there, and may
approach.
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
"""Greatest age of a scan that the newest is compared with, and least time between them [s]."""
TOLERANCE_M, DEVIATIONS = 0.03, 3.0
"""Margin before the end of an old beam [m], plus this many standard deviations of its range."""


def remember(config: GateConfig, state: GateState, scan: Scan) -> tuple[View, ...]:
    """Returns the earlier views that still count, oldest first, then that of a new scan."""
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
    """Returns which beams (B,) of the newest view end on something that moves.

    A single beam is noise: a neighbour has to agree.
    """
    newest = views[-1]
    marked = np.zeros(len(newest.ranges), np.bool_)
    angles = config.beam_angles
    if len(angles) < 2 or shield.obstacle_speed == 0.0:
        return marked
    lidar = moving_kernels.MountedBeams(
        float(angles[0]), float(angles[1] - angles[0]), *config.mount
    )
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
    """Compiles the kernel that `movers` calls."""
    lidar, scan = moving_kernels.MountedBeams(0.0, 0.1, 0.0, 0.0, 0.0), np.ones(1, np.float32)
    moving_kernels.entered(np.zeros(1, np.bool_), scan, scan, lidar, np.zeros(3), 1.0, (0.0, 0.0))
