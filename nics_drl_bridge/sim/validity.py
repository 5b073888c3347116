"""Validity: warns of commands outside the range that the model's recording covered."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Array = NDArray[np.float64]

TOLERANCE = 0.05
"""Tolerance beyond the recorded range, as a share of the command's limits."""
EVERY = 16
"""Commands are checked in the first step after a reset and then at this interval [steps]."""


class OutsideValidityWarning(UserWarning):
    """Commands lie outside the range that the model's recording covered."""


def warn(message: str) -> None:
    """Issues an OutsideValidityWarning to the caller that steps the simulator."""
    warnings.warn(message, OutsideValidityWarning, stacklevel=4)


class CommandBox:
    """The range of commands that a model was fitted to.

    Variables whose effect was assumed, not learnt, are not checked.

    Args:
        model: the kinematics.
        robot: names and limits of the commands.
        tell: called with the message of a warning.
    """

    def __init__(
        self, model: TaylorModel, robot: RobotSpec, tell: Callable[[str], None] = warn
    ) -> None:
        self._tell = tell
        margin = TOLERANCE * (robot.command_high - robot.command_low)
        first = len(robot.state)
        self._low: Array = model.low[first:] - margin
        self._high: Array = model.high[first:] + margin
        assumed = _assumed(model)
        for i, name in enumerate(robot.variable_names[first:]):
            if name in assumed:
                self._low[i], self._high[i] = -np.inf, np.inf
        self._names = robot.variable_names[first:]
        self._range = model.low[first:], model.high[first:]
        self._steps, self._armed = 0, True

    def begin(self) -> None:
        """Begins an episode: the next step is checked, and one warning may be issued."""
        self._steps, self._armed = 0, True

    def check(self, commands: Array) -> None:
        """Warns once per episode if commands (..., C) are outside the range."""
        steps, self._steps = self._steps, self._steps + 1
        if not self._armed or steps % EVERY:
            return
        flat = commands.reshape(-1, commands.shape[-1])
        least, most = flat.min(axis=0), flat.max(axis=0)
        outside = (least < self._low) | (most > self._high)
        if outside.any():
            self._armed = False
            i = int(np.argmax(outside))
            value = least[i] if least[i] < self._low[i] else most[i]
            self._tell(
                f"{self._names[i]} is {value:.4g}, but the model was fitted to "
                f"{self._range[0][i]:.4g} to {self._range[1][i]:.4g} only: its motion there is "
                "extrapolated; record a drive that covers it."
            )


def require_sane_speed(model: TaylorModel, robot: RobotSpec, extent: tuple[float, ...]) -> None:
    """Raises ConfigError if a robot could cross a whole world in one step of its kinematics.

    Args:
        model: the kinematics.
        robot: limits of the commands.
        extent: least x, least y, greatest x, greatest y of the world [m].
    """
    first = len(robot.state)
    most = np.maximum(np.abs(model.low), np.abs(model.high))
    limits = np.maximum(np.abs(robot.command_low), np.abs(robot.command_high))
    most[first:] = np.maximum(most[first:], limits)
    products = np.prod(most**model.powers, axis=1)
    step = float((np.abs(model.coefficients[:2]) @ products).max() * model.dt)
    least = min(extent[2] - extent[0], extent[3] - extent[1])
    if not step < least:
        raise ConfigError(
            f"the robot {robot.name!r} could drive {step:.3g} m in a step of {model.dt:g} s, "
            f"across a world of {least:.3g} m; lower the limits of its commands, or generate its "
            "model with a shorter step."
        )


def _assumed(model: TaylorModel) -> set[str]:
    """Names of the variables in assumed terms."""
    powers = [taylor.parse_term(term, model.variables) for _, term in model.assumed]
    return {model.variables[v] for row in powers for v in np.flatnonzero(row)}
