"""A robot on four mecanum wheels: front left, front right, rear left, rear right.

Its commands are the body twist: speeds forward and to the left [m/s], and the turn rate [rad/s].
`base_link` is the centre of the wheels, which are at `half_length` and `half_width` [m]
from it.
"""

import numpy as np

from nics_drl_bridge.robot.kinds import (
    Drawing,
    RobotKind,
    Textbook,
    make_wheeled,
    place_wheels,
)
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import (
    FOUR_WHEELS,
    LAGS,
    SIDEWAYS,
    TWIST,
    Template,
    list_names,
)

TEMPLATE = Template(
    commands=((TWIST[0], SIDEWAYS, TWIST[1]), FOUR_WHEELS),
    moves=POSE_RATES,
    lengths={"half_length": 0.6, "half_width": 0.6, "wheel_radius": 0.3},
    parameters=LAGS,
)


def derive_kinematics(spec: RobotSpec) -> Textbook:
    """Returns kinematics whose twist is the least-squares solution for four wheel speeds."""
    p = spec.parameters
    arm = p["half_length"] + p["half_width"]
    inverse = (
        np.array([[1, -1, -arm], [1, 1, arm], [1, 1, -arm], [1, -1, arm]])
        / p["wheel_radius"]
    )
    forward = np.asarray(np.linalg.pinv(inverse), dtype=np.float64)
    return make_wheeled(spec, inverse, forward, POSE_RATES, list_names(FOUR_WHEELS))


def draw(spec: RobotSpec) -> Drawing:
    """Draws a box on four wheels."""
    p = spec.parameters
    length = p["half_length"]
    width = p["half_width"]
    radius = p["wheel_radius"]
    places = ((length, width), (length, -width), (-length, width), (-length, -width))
    wheels = place_wheels(spec, places, radius, list_names(FOUR_WHEELS))
    return Drawing((2.0 * length + radius, 1.4 * width), (0.0, radius), wheels)


KIND = RobotKind(derive_kinematics, draw, TEMPLATE, sideways=True)
