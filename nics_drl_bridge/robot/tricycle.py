"""A tricycle: the front wheel drives and steers, two roll; `base_link` is amid the rear axle.

Its commands are the front wheel's speed along its own direction [m/s] and steering angle [rad].
"""

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.robot.drivetrain import steered, steering_angle
from nics_drl_bridge.robot.kinds import Drawing, Pivot, RobotKind, Textbook, Wheel
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]


def kinematics(spec: RobotSpec) -> Textbook:
    """The front wheel pulls forward by its cosine, and turns the base by its sine."""
    wheelbase = spec.parameters["wheelbase"]

    def twist(speed: Array, angle: Array) -> Array:
        forward, turn = speed * np.cos(angle), speed * np.sin(angle) / wheelbase
        return np.stack([forward, np.zeros_like(speed), turn], axis=-1)

    return steered(spec, twist)


def drawing(spec: RobotSpec) -> Drawing:
    """A box on three wheels of one size."""
    p, angle = spec.parameters, steering_angle(spec)
    wheelbase, track, radius = p["wheelbase"], p["track"], p["wheel_radius"]
    fork = Pivot("fork", angle.name, angle)
    wheels = (
        Wheel("rear_left_wheel", (0.0, 0.5 * track), radius),
        Wheel("rear_right_wheel", (0.0, -0.5 * track), radius),
        Wheel("front_wheel", (wheelbase, 0.0), radius, pivot=fork),
    )
    return Drawing((wheelbase, 0.7 * track), (0.4 * wheelbase, 1.5 * radius), wheels)


KIND = RobotKind(kinematics, drawing)
