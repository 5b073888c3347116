"""The gate's rule: which command may reach the robot now.

A pure function of (time, state, inputs), so that it is tested with any clock. Times are
seconds of a steady clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What the robot may be told.

    Attributes:
        low, high: (3,) least and greatest linear.x, linear.y, angular.z of `cmd_vel`.
        scan_age_s: a command is void once the scan behind it arrived so long ago [s].
    """

    low: Array
    high: Array
    scan_age_s: float = 0.35


@dataclass(frozen=True)
class Request:
    """A command of the policy, as the gate received it.

    Attributes:
        twist: (3,) linear.x, linear.y, angular.z.
        scan_arrival_s: when the scan behind it arrived here; None when it never did.
    """

    twist: Array
    scan_arrival_s: float | None


@dataclass(frozen=True)
class Decision:
    """What to publish, and why not what was asked.

    Attributes:
        twist: (3,) to publish.
        cause: empty when the command passed, possibly limited.
    """

    twist: Array
    cause: str = ""


def decide(now_s: float, request: Request | None, limits: Limits) -> Decision:
    """The command for now: the policy's within the limits, or zero with the cause.

    Args:
        now_s: steady time [s].
        request: the newest of the policy.
        limits: of the robot.
    """
    if request is None:
        return Decision(np.zeros(3), "no command yet")
    if not np.isfinite(request.twist).all():
        return Decision(np.zeros(3), "cmd_vel_raw holds NaN or inf")
    if request.scan_arrival_s is None:
        return Decision(np.zeros(3), "the scan behind cmd_vel_raw never arrived here")
    age = now_s - request.scan_arrival_s
    if not 0.0 <= age <= limits.scan_age_s:
        return Decision(
            np.zeros(3),
            f"the scan behind cmd_vel_raw is {age:.3f} s old, the limit is {limits.scan_age_s} s",
        )
    return Decision(np.clip(request.twist, limits.low, limits.high))
