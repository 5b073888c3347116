"""Drives of textbook robots, disturbed in known ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.kinematics.recording import Recording, Stream
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.textbook import record


def drive(
    spec: RobotSpec,
    seed: int = 0,
    duration: float = 40.0,
    latency: float = 0.0,
    pose_clock_ahead: float = 0.0,
    rotation: float = 0.0,
    lever: tuple[float, float] = (0.0, 0.0),
    noise: tuple[float, float] = (0.0, 0.0),
    burst: float = 0.0,
    measured_state: bool = True,
) -> Recording:
    """A random drive.

    Args:
        latency: from a command's stamp to its effect [s].
        pose_clock_ahead: what the pose's clock shows more than the commands' [s].
        rotation: heading of base_link less that of the tracked body [rad].
        lever: the tracked point seen from base_link [m].
        noise: of position [m] and heading [rad].
        burst: period of the bursts in which poses arrive [s]; 0 for none.
    """
    rng = np.random.default_rng(seed)
    clean = record(spec, rng, duration)
    tracked = geometry.compose(clean.pose.values, np.array([*lever, -rotation]))
    tracked = tracked + rng.normal(0.0, 1.0, tracked.shape) * np.array([noise[0], noise[0], noise[1]])
    t = clean.pose.t
    arrival = np.ceil(t / max(burst, 1e-9) - 1e-6) * burst
    stamps = t if burst == 0.0 else arrival + (arrival - t) * -1e-3 + 1e-3 * burst
    different = pose_clock_ahead != 0.0
    return Recording(
        command=replace(clean.command, t=t - latency),
        pose=Stream(stamps + pose_clock_ahead, tracked, "mocap" if different else "robot"),
        state=clean.state if measured_state else None,
        source="disturbed drive",
    )
