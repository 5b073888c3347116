"""Interfaces of what learns: RobotView, and Backend for whatever moves the robot."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypedDict, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
NS_PER_S = 1_000_000_000
S_PER_NS = 1e-9


@dataclass(frozen=True)
class RobotView:
    """All that a task or a policy may know about a robot, or about a batch of robots.

    The leading dimensions `...` are empty for one robot and (N, M) in a vector simulator. The stamp
    is the newest data's, ages are at the time of the view; a range of NaN is unknown.
    """

    pose: Array  # (..., 3) estimate of x [m], y [m], heading [rad] of `base_link` in `map`
    twist: Array  # (..., 3) estimate of vx [m/s], vy [m/s], wz [rad/s] in `base_link`
    ranges: NDArray[
        np.float32
    ]  # (..., B) [m], REP-117: `inf` no return, `-inf` too close
    stamp_s: float
    scan_age_s: float
    odom_age_s: float
    # Name of a further sensor -> (..., S) its reading, see `lidar.sensor`; and the greatest age.
    sensed: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    sensed_age_s: float = 0.0


def stack_views(views: Sequence[RobotView]) -> RobotView:
    """Stacks the views of M robots into one with a leading (M,); stamp and ages are the maxima."""
    sensed = {
        name: np.stack([view.sensed[name] for view in views])
        for name in views[0].sensed
    }
    known: dict[str, Any] = {"sensed": sensed}
    for name in ("pose", "twist", "ranges"):
        known[name] = np.stack([getattr(view, name) for view in views])
    for name in ("stamp_s", "scan_age_s", "odom_age_s", "sensed_age_s"):
        known[name] = max(getattr(view, name) for view in views)
    return RobotView(**known)


@dataclass(frozen=True)
class Start:
    """Start of an episode, whose scene and noise a simulator draws from its seed."""

    seed: int
    pose: Array  # (3,) x [m], y [m], heading [rad] in `map`; (M, 3) for a team


class BackendFacts(TypedDict, total=False):
    """Facts that a backend alone knows; those that it does not know are left out."""

    true_pose: Array  # (3,) x [m], y [m], heading [rad] in `map` now; (M, 3) of a team
    true_collision: bool | NDArray[np.bool_]  # True after a contact; (M,) of a team
    bodies: Array  # (K, 7) obstacles where they are now, see `sim.scenes.Scene`
    randomisation: dict[
        str, Any
    ]  # name -> value that was drawn for the episode, where any was
    scenes: Callable[
        [ArrayLike], Any
    ]  # gives scenes for seeds (n,), if the world alone does not


@runtime_checkable
class Backend(Protocol):
    """Access to a robot: a simulator in process, or whatever is behind ROS 2 topics."""

    def reset(self, start: Start) -> RobotView:
        """Begins an episode and returns its first view."""

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Applies a command (C,) of the RobotSpec for one period: view at its end, and `info`."""

    def facts(self) -> BackendFacts:
        """Returns what this backend alone knows at present; it may be called at any time."""

    def halt(self) -> None:
        """Stops the robot and ends the episode, at any time: after an error, twice, when closed."""

    def close(self) -> None:
        """Stops the robot with a zero command and frees all resources."""
