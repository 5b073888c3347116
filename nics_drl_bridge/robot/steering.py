"""A bicycle: speed and steering angle of a car, to its body twist and back."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Bicycle(NamedTuple):
    """Geometry of a robot that steers; `base_link` is the middle of the unsteered axle."""

    wheelbase: float  # [m]
    front_drive: bool = False  # the speed is that of the steered wheel, along its own direction

    def twist(self, speed: Array, angle: Array) -> Array:
        """Returns the body twist (..., 3) of speeds [m/s] and steering angles [rad] (...)."""
        if self.front_drive:
            forward, turn = speed * np.cos(angle), speed * np.sin(angle) / self.wheelbase
        else:
            forward, turn = speed, speed * np.tan(angle) / self.wheelbase
        return np.stack([forward, np.zeros_like(forward), turn], axis=-1)

    def command(self, twist: Array) -> tuple[Array, Array]:
        """Returns speeds and steering angles (...) of twists (..., 3): both 0 for a turn at rest.

        As of the curvature alone, an angle is within a right angle; a car at rest holds 0 [rad].
        """
        forward, turn = twist[..., 0], twist[..., 2]
        moving = forward != 0.0
        bend = np.divide(turn, forward, out=np.zeros(np.shape(forward)), where=moving)
        angle = np.arctan(self.wheelbase * bend)
        return (forward / np.cos(angle) if self.front_drive else forward), angle
