"""The seams between what knows about robots and what learns: RobotView and Backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class RobotView:
    """All that a task or a policy may know about a robot, or about a batch of robots.

    The leading dimensions `...` are empty for one robot and (N, M) in a vector simulator.

    Attributes:
        pose: (..., 3) estimate of x [m], y [m], heading [rad] of `base_link` in `map`.
        twist: (..., 3) estimate of vx [m/s], vy [m/s], wz [rad/s] in `base_link`.
        ranges: (..., B) scan [m], float32, REP-117: `inf` no return, `-inf` too close,
            NaN unknown.
        stamp_s: time of the newest datum [s].
        scan_age_s: how old the scan is at the time of the view [s].
        odom_age_s: how old the newest odometry is at the time of the view [s].
    """

    pose: NDArray[np.float64]
    twist: NDArray[np.float64]
    ranges: NDArray[np.float32]
    stamp_s: float
    scan_age_s: float
    odom_age_s: float


@dataclass(frozen=True)
class Start:
    """How an episode begins.

    Attributes:
        seed: names the episode; a simulator draws its scene and its noise from it.
        pose: (3,) where the robot stands: x [m], y [m], heading [rad] in `map`.
    """

    seed: int
    pose: NDArray[np.float64]


@runtime_checkable
class Backend(Protocol):
    """Where a robot lives: a simulator in process, or whatever is behind ROS 2 topics."""

    def reset(self, start: Start) -> RobotView:
        """Begins an episode and returns the first view of it."""
        ...

    def step(self, command: NDArray[np.float64]) -> tuple[RobotView, dict[str, Any]]:
        """Applies a command for one control period.

        Args:
            command: (C,) in the units and the order of the RobotSpec.

        Returns:
            The view at the end of the period, and facts for `info` (stamps, sequence
            numbers, and the true pose where a simulator knows it).
        """
        ...

    def close(self) -> None:
        """Leaves the robot with a zero command and frees everything."""
        ...
