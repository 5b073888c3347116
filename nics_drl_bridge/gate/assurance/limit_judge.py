"""Compares what a gate publishes with its limits, with independent code.

The gate itself reports which decisions brake or stop and may therefore change faster.
"""

import numpy as np

from nics_drl_bridge.gate.limits import Limits
from nics_drl_bridge.gate.state import Decision
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.spec import RobotSpec

VIOLATIONS = ("value", "rate", "jerk", "stop", "odd", "unused")
# relative error of a finite difference: rounding of the values, divided by the interval
TOLERANCE = 1e-6


class LimitJudge:
    """Counts how often each limit is exceeded, by finite differences.

    Braking, by the shield or to a stop, has no limit. Without `slopes`, only values are
    judged.
    """

    def __init__(self, robot: RobotSpec, limits: Limits, slopes: bool = True) -> None:
        self.limits = limits
        self.sane = True  # the newest command is plausible, so a motion may follow
        self.violations = dict.fromkeys(VIOLATIONS, 0)
        self._robot = robot
        self._slopes = slopes
        self._value = np.zeros(len(limits.low))
        self._slope = np.zeros(len(limits.low))
        self._time = -np.inf
        self._shielded = False

    def see(self, decision: Decision, now: float) -> None:
        """Judges a decision at a time [s]."""
        if not decision.publish:
            return
        value = self._robot.from_cmd_vel(decision.twist)
        unused = not np.allclose(self._robot.to_cmd_vel(value), decision.twist)
        self._count("unused", unused)
        self._count("odd", not self.sane and decision.twist.any())
        slope = np.zeros_like(value)
        if decision.cause is not None:
            self._count("stop", decision.twist.any())
        else:
            inside = (value >= self.limits.low) & (value <= self.limits.high)
            self._count("value", not inside.all())  # NaN is not inside
            if self._slopes:
                slope = self._judge_slope(value, now - self._time, decision.shielded)
        self._value = value
        self._slope = slope
        self._time = now
        self._shielded = decision.shielded

    def _judge_slope(self, value: Array, passed: float, shielded: bool) -> Array:
        slope = (value - self._value) / passed
        size = np.abs(slope)
        if shielded:  # only away from zero
            size = (np.abs(value) - np.abs(self._value)) / passed
        self._count("rate", not (size <= self.limits.rate * (1 + TOLERANCE)).all())
        if not (shielded or self._shielded):
            change = np.abs(slope - self._slope) / passed
            is_smooth = change <= self.limits.jerk * (1 + TOLERANCE)
            self._count("jerk", not is_smooth.all())
        return slope

    def _count(self, name: str, violated: object) -> None:
        self.violations[name] += bool(violated)
