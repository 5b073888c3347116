"""The configuration of a gate in process for a shipped robot and any lidar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import GateConfig
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec


def gate_config(robot: RobotSpec, lidar: LidarSpec, **changes: object) -> GateConfig:
    """The gate of a shipped robot, without emergency stop and middleware around it."""
    given = GateConfig(
        fields=tuple(
            int(i)
            for i in np.flatnonzero(robot.to_cmd_vel(np.ones(len(robot.command))))
        ),
        limits=load_limits(robot.name, robot),
        beam_angles=lidar.angles,
        mount=lidar.mount,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        scan_rate=lidar.rate,
        odom_rate=lidar.rate,
        e_stop_required=False,
        estimate_required=False,
    )
    return replace(given, **changes)  # type: ignore[arg-type]
