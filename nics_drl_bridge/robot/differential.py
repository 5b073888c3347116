"""A robot with two driven wheels on one axle, left and right; `base_link` is the axle's middle.

Its commands are the base's forward speed [m/s] and turn rate [rad/s].
"""

import numpy as np

from nics_drl_bridge.robot.drivetrain import wheeled
from nics_drl_bridge.robot.kinds import Drawing, RobotKind, Textbook, Wheel
from nics_drl_bridge.robot.spec import RobotSpec


def kinematics(spec: RobotSpec) -> Textbook:
    """The mean of the wheels drives, their difference over the track turns."""
    p = spec.parameters
    inverse = np.array([[1, -p["track"] / 2], [1, p["track"] / 2]]) / p["wheel_radius"]
    forward = np.zeros((3, 2))
    forward[[0, 2]] = np.linalg.inv(inverse)
    return wheeled(spec, inverse, forward, ("linear.x", "angular.z"), ("vx", "wz"))


def drawing(spec: RobotSpec) -> Drawing:
    """A disc between two wheels."""
    track, radius = spec.parameters["track"], spec.parameters["wheel_radius"]
    wheels = tuple(
        Wheel(variable.name, (0.0, y), radius, turns=True)
        for variable, y in zip(spec.state, (0.5 * track, -0.5 * track), strict=True)
    )
    return Drawing(0.4 * track, (0.0, radius), wheels)


KIND = RobotKind(kinematics, drawing)
