"""Warnings about commands outside the range that a model's recording covered."""

import warnings
from collections.abc import Callable

import numpy as np

from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

TOLERANCE = 0.05  # tolerated excess over the recorded range, as a fraction of a command's limits


class OutsideValidityWarning(UserWarning):
    """Commands lie outside the range that the model's recording covered."""


def warn_caller(message: str) -> None:
    """Issue an OutsideValidityWarning at the line that steps the simulator."""
    warnings.warn(message, OutsideValidityWarning, stacklevel=5)


class CommandRange:
    """The range of commands to which a model was fitted; reports each command that leaves it once.

    A command whose effect was assumed, not fitted, may have any value.
    """

    def __init__(
        self,
        model: TaylorModel,
        robot: RobotSpec,
        tell: Callable[[str], None] = warn_caller,
    ) -> None:
        self._tell = tell
        self._names = robot.variable_names[model.state_size :]
        fitted = np.stack([model.low, model.high])[:, model.state_size :]
        # The model's range is of commands in effect; the checked ones are those sent.
        for curve in model.inputs:
            c = self._names.index(curve.command)
            fitted[:, c] = curve.invert(fitted[:, c])
        self._fitted: Array = fitted
        margin = TOLERANCE * (robot.command_high - robot.command_low)
        self._low: Array = fitted[0] - margin
        self._high: Array = fitted[1] + margin
        for _, term in model.assumed:
            powers = taylor.parse_term(term, model.variables)
            assumed = powers[model.state_size :] > 0
            self._low[assumed] = -np.inf
            self._high[assumed] = np.inf
        # A dict, because `pop` is atomic: parts of the worlds are checked by several threads.
        self._unreported = dict.fromkeys(self._names, True)

    def check(self, commands: Array) -> None:
        """Report which of the commands (..., C) leave the range, each of the C commands once."""
        if not self._unreported:
            return
        flat = commands.reshape(-1, commands.shape[-1])
        lowest = flat.min(axis=0)
        highest = flat.max(axis=0)
        outside = (lowest < self._low) | (highest > self._high)
        if not outside.any():
            return
        for c in np.flatnonzero(outside).tolist():
            name = self._names[c]
            if not self._unreported.pop(name, False):
                continue
            value = lowest[c] if lowest[c] < self._low[c] else highest[c]
            low, high = self._fitted[:, c]
            self._tell(
                f"{name} is {value:.4g}, but the model was fitted to {low:.4g} to {high:.4g} only: "
                "its motion there is extrapolated; record a drive that covers it."
            )
