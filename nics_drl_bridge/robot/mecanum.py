"""A robot on four mecanum wheels: front left, front right, rear left, rear right.

Its commands are the body twist: speeds forward and to the left [m/s], and the turn rate [rad/s].
`base_link` is the centre of the wheels; `half_length` and `half_width` lead from it to each wheel.
"""

import numpy as np

from nics_drl_bridge.robot.drivetrain import wheeled
from nics_drl_bridge.robot.kinds import Drawing, RobotKind, Textbook, Wheel
from nics_drl_bridge.robot.spec import CMD_VEL_FIELDS, POSE_RATES, RobotSpec


def kinematics(spec: RobotSpec) -> Textbook:
    """The least-squares twist of four wheels for three degrees of freedom."""
    p = spec.parameters
    arm = p["half_length"] + p["half_width"]
    inverse = np.array([[1, -1, -arm], [1, 1, arm], [1, 1, -arm], [1, -1, arm]]) / p["wheel_radius"]
    forward = np.asarray(np.linalg.pinv(inverse), dtype=np.float64)
    return wheeled(spec, inverse, forward, CMD_VEL_FIELDS, POSE_RATES)


def drawing(spec: RobotSpec) -> Drawing:
    """A box on four wheels."""
    p = spec.parameters
    length, width, radius = p["half_length"], p["half_width"], p["wheel_radius"]
    places = ((length, width), (length, -width), (-length, width), (-length, -width))
    wheels = tuple(
        Wheel(variable.name, place, radius, turns=True)
        for variable, place in zip(spec.state, places, strict=True)
    )
    return Drawing((2.0 * length + radius, 1.4 * width), (0.0, radius), wheels)


KIND = RobotKind(kinematics, drawing)
