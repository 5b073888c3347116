"""InputCurve: what a motor makes of a command, before the kinematics."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.robot.spec import RobotSpec


class InputCurve(Schema):
    """A dead zone about zero, and saturation: a monotone curve of one command, in its unit."""

    command: str
    dead: float = Field(default=0.0, ge=0.0)  # a smaller command moves nothing
    least: float = -np.inf  # smaller and greater commands do no more than these
    most: float = np.inf

    def of(self, command: ArrayLike) -> NDArray[np.float64]:
        """Returns the commands in effect (...): beyond the dead zone, in proportion."""
        held = np.clip(np.asarray(command, dtype=np.float64), self.least, self.most)
        return np.asarray(np.sign(held) * np.maximum(np.abs(held) - self.dead, 0.0))


def curved(
    command: ArrayLike, spec: RobotSpec, curves: tuple[InputCurve, ...]
) -> NDArray[np.float64]:
    """Returns the commands in effect (..., C) of a robot's, by its curves."""
    values = np.array(command, dtype=np.float64)
    names = [c.name for c in spec.command]
    for curve in curves:
        place = names.index(curve.command)
        values[..., place] = curve.of(values[..., place])
    return values
