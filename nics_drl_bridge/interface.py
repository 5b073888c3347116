"""The interface to a robot: RobotView for its data, Backend for whatever moves it."""

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
    """Everything that a task or a policy may know about a robot or a batch of robots.

    The leading dimensions `...` are empty for one robot and (N, M) in a vector simulator. The stamp
    is that of the newest data; ages are at the time of the view. NaN is an unknown range.
    """

    pose: Array  # (..., 3) estimate of x [m], y [m], heading [rad] of `base_link` in `map`
    twist: Array  # (..., 3) estimate of vx [m/s], vy [m/s], wz [rad/s] in `base_link`
    # (..., B) [m], REP-117: `inf` no return, `-inf` too close
    ranges: NDArray[np.float32]
    stamp_s: float = 0.0
    scan_age_s: float = 0.0
    odom_age_s: float = 0.0
    # name of an additional sensor -> reading (..., S), see `lidar.sensor`
    sensed: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    sensed_age_s: float = 0.0  # maximum age of these readings


def stack_views(views: Sequence[RobotView]) -> RobotView:
    """Stacks the views of M robots into one with a leading (M,); stamp and ages are the maxima."""
    sensed = {}
    for name in views[0].sensed:
        sensed[name] = np.stack([view.sensed[name] for view in views])
    fields: dict[str, Any] = {"sensed": sensed}
    for name in ("pose", "twist", "ranges"):
        fields[name] = np.stack([getattr(view, name) for view in views])
    for name in ("stamp_s", "scan_age_s", "odom_age_s", "sensed_age_s"):
        fields[name] = max(getattr(view, name) for view in views)
    return RobotView(**fields)


@dataclass(frozen=True)
class Start:
    """Start of an episode; a simulator draws its scene and noise from the seed."""

    seed: int
    pose: Array  # (3,) x [m], y [m], heading [rad] in `map`; (M, 3) for a team


class BackendFacts(TypedDict, total=False):
    """Facts that only a backend knows; a backend leaves out those that it does not know."""

    true_pose: Array  # (3,) x [m], y [m], heading [rad] in `map` now; (M, 3) for a team
    true_collision: bool | NDArray[np.bool_]  # True after a contact; (M,) for a team
    bodies: Array  # (K, 7) obstacles at their present places, see `sim.scenes.Scene`
    randomisation: dict[str, Any]  # name -> value drawn for the episode, if any
    # draws scenes for seeds (n,), if the world alone can't
    scenes: Callable[[ArrayLike], Any]


@runtime_checkable
class Backend(Protocol):
    """Access to a robot: an in-process simulator, or whatever is behind ROS 2 topics."""

    def reset(self, start: Start) -> RobotView:
        """Starts an episode and returns its first view."""

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Applies a command (C,) for one period; returns the view at its end and `info`."""

    def facts(self) -> BackendFacts:
        """Returns what only this backend currently knows; may be called at any time."""

    def halt(self) -> None:
        """Stops the robot and ends the episode; may be called at any time, even when closed."""

    def close(self) -> None:
        """Stops the robot with a zero command and frees all resources."""
