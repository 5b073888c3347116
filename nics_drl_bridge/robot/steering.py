"""A bicycle: speed and steering angle of a car, to its body twist and back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bicycle:
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
        """Returns speeds and steering angles (...) of twists (..., 3), both 0 of a turn at rest."""
        forward, turn = twist[..., 0], twist[..., 2]
        across = self.wheelbase * turn  # speed of the front wheel to the left
        sign = np.sign(forward)
        angle = np.arctan2(across * sign, np.abs(forward))
        return (sign * np.hypot(forward, across) if self.front_drive else forward), angle
