"""InputCurve: what a motor makes of a command, before the kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AllowInfNan, Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]


class InputCurve(Schema):
    """A dead zone about zero, unequal gains, and saturation: a monotone curve of one command."""

    command: str
    dead: float = Field(default=0.0, ge=0.0)  # a smaller command moves nothing, in its unit
    # smaller and greater commands do no more than these, in the command's unit
    least: Annotated[float, AllowInfNan()] = Field(default=-np.inf, le=0.0)
    most: Annotated[float, AllowInfNan()] = Field(default=np.inf, ge=0.0)
    back: float = Field(default=1.0, ge=0.0)  # gain of negative commands; that of positive ones: 1

    def of(self, command: ArrayLike) -> Array:
        """Returns the commands in effect (...): beyond the dead zone, in proportion."""
        held = np.clip(np.asarray(command, dtype=np.float64), self.least, self.most)
        beyond = np.sign(held) * np.maximum(np.abs(held) - self.dead, 0.0)
        return np.where(beyond < 0.0, self.back * beyond, beyond)

    def sent(self, effect: ArrayLike) -> Array:
        """Returns the commands (...) of effects; infinite where greater ones do no more."""
        effect = np.asarray(effect, dtype=np.float64)
        gain = np.where((effect < 0.0) & (self.back > 0.0), self.back, 1.0)
        command = effect / gain + np.sign(effect) * self.dead
        command = np.where(effect <= self.of(-np.inf), -np.inf, command)
        return np.where(effect >= self.of(np.inf), np.inf, command)


def bent(command: ArrayLike, names: Sequence[str], curves: tuple[InputCurve, ...]) -> Array:
    """Returns the commands in effect (..., C) of commands with C names."""
    values = np.array(command, dtype=np.float64)
    for curve in curves:
        place = names.index(curve.command)
        values[..., place] = curve.of(values[..., place])
    return values


def curved(command: ArrayLike, spec: RobotSpec, curves: tuple[InputCurve, ...]) -> Array:
    """Returns the commands in effect (..., C) of a robot's, by its curves."""
    return bent(command, [c.name for c in spec.command], curves)
