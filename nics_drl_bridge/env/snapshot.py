"""Snapshot: everything that a picture of one world shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.lidar.spec import LidarSpec


@dataclass(frozen=True)
class Snapshot:
    """One world with its M robots at one time; unknown values are None."""

    poses: Array  # (M, 3) x [m], y [m], heading [rad] in `map`; the truth if known
    ranges: Singles  # (M, B) [m], REP-117
    bodies: Array  # (K, 7) obstacles, see `sim.scenes.Scene`
    goals: Array  # (G, 2) [m]
    member: int = 0  # member of a world set
    step: int = 0  # control periods since the start of the episode
    estimates: Array | None = None  # (M, 3) poses that the robots estimate
    covariance: Array | None = None  # (M, 3, 3) of the estimates [m, rad]
    commands: Array | None = None  # (M, C) commands that the robots follow
    # gate rule that stopped the command, such as `shield`; "" if none did
    gate: str | None = None


def find_goals(memory: Mapping[str, NDArray[Any]], n: int = 0) -> Array:
    """Copies the goals (G, 2) of world n from a task's memory, possibly none."""
    goals = memory["goal"][n] if "goal" in memory else ()
    return np.array(goals, np.float64).reshape(-1, 2)


def find_gate(info: Mapping[str, Any]) -> str | None:
    """Returns `Snapshot.gate` from the `info` of a step; None without a gate."""
    if "stopped_by" not in info:
        return None
    if info["stopped_by"]:
        return str(info["stopped_by"])
    return "shield" if info["shielded"] else ""


def locate_hits(lidar: LidarSpec, pose: Array, ranges: Singles) -> Array:
    """Returns the points (n, 2) in `map` [m] that a scan (B,) hits from a robot's pose (3,)."""
    mount = geometry.compose(pose, lidar.mount)
    there = np.isfinite(ranges)
    angles = mount[2] + lidar.angles[there]
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(mount[:2] + ranges[there, None] * directions)
