"""Finds which axis of an IMU points up from gravity, for any mounting."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array

AXES = "xyz"
# Range of accelerations at rest [m/s^2]; otherwise gravity was removed or nothing was
# measured
GRAVITY = (7.0, 13.0)
UPRIGHT = 0.85  # minimum fraction of gravity along the axis that points up
# number of messages over which the acceleration is averaged while a robot drives
REMEMBERED = 200


class UpAxis(NamedTuple):
    """The axis of an IMU that points up, or down if the sign is -1."""

    place: int = 2  # index among x, y, z
    sign: float = 1.0

    @property
    def name(self) -> str:
        """Name of the axis, such as `-y`."""
        return f"{'-' if self.sign < 0.0 else ''}{AXES[self.place]}"

    @property
    def is_usual(self) -> bool:
        """True if z points up."""
        return self == UpAxis()


def find_up_axis(acceleration: Array) -> UpAxis:
    """Returns the axis that points up by a mean acceleration (3,) [m/s^2]; z if it is unclear."""
    size = float(np.linalg.norm(acceleration))
    if not GRAVITY[0] < size < GRAVITY[1]:
        return UpAxis()
    index = int(np.argmax(np.abs(acceleration)))
    if abs(acceleration[index]) < UPRIGHT * size:
        return UpAxis()
    return UpAxis(index, 1.0 if acceleration[index] > 0.0 else -1.0)


def find_table_axis(read: Callable[[str], Array]) -> UpAxis:
    """Returns the axis of an IMU's messages that points up; `read` reads one of their fields."""
    means = [np.nanmedian(read(f"linear_acceleration.{axis}")) for axis in AXES]
    return find_up_axis(np.array(means))


def to_array(vector: Any) -> Array:
    """Returns a message's vector as an array (3,)."""
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


class GyroReader:
    """Reads yaw rates from the messages of an IMU in any mounting."""

    def __init__(self) -> None:
        self._acceleration = np.zeros(3)
        self._count = 0

    def read(self, message: Any) -> tuple[float, float] | None:
        """Returns yaw rate [rad/s] and its variance [rad^2/s^2]; None if none is measured."""
        covariance = message.angular_velocity_covariance
        if covariance[0] == -1.0:
            return None
        acceleration = to_array(message.linear_acceleration)
        if (
            np.isfinite(acceleration).all()
            and message.linear_acceleration_covariance[0] != -1.0
        ):
            self._count = min(self._count + 1, REMEMBERED)
            self._acceleration = self._acceleration + (
                acceleration - self._acceleration
            ) / float(self._count)
        axis = find_up_axis(self._acceleration)
        rate = axis.sign * float(getattr(message.angular_velocity, AXES[axis.place]))
        return rate, float(covariance[4 * axis.place])
