"""A robot with two driven wheels on one axle, left and right; `base_link` is the axle's middle.

Its commands are the base's forward speed [m/s] and turn rate [rad/s]. The commands of
`differential_wheels` are the speeds of both wheels [rad/s].
"""

import numpy as np

from nics_drl_bridge.robot.kinds import (
    Drawing,
    RobotKind,
    Textbook,
    make_wheeled,
    place_wheels,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.template import LAGS, TWIST, WHEELS, Template, list_names

MOVES = ("vx", "wz")
LENGTHS = {"track": 1.4, "wheel_radius": 0.3}
BY_TWIST = Template(
    commands=(TWIST,),
    moves=MOVES,
    parameters=LAGS,
    lengths=LENGTHS,
)
BY_WHEELS = Template(
    commands=(WHEELS,),
    parameters=LAGS,
    lengths=LENGTHS,
)


def derive_kinematics(spec: RobotSpec, slip: float = 1.0) -> Textbook:
    """Returns differential kinematics, with the turn rate scaled by `slip`."""
    half = spec.parameters["track"] / 2
    inverse = np.array([[1, -half], [1, half]]) / spec.parameters["wheel_radius"]
    forward = np.zeros((3, 2))
    forward[[0, 2]] = np.linalg.inv(inverse)
    return make_wheeled(spec, inverse, forward, MOVES, list_names(WHEELS), slip)


def draw(spec: RobotSpec) -> Drawing:
    """Draws a disc between two wheels."""
    track = spec.parameters["track"]
    radius = spec.parameters["wheel_radius"]
    places = ((0.0, 0.5 * track), (0.0, -0.5 * track))
    wheels = place_wheels(spec, places, radius, list_names(WHEELS))
    return Drawing(0.4 * track, (0.0, radius), wheels)


KIND = RobotKind(derive_kinematics, draw, BY_TWIST)
VARIANTS = {"differential_wheels": RobotKind(derive_kinematics, draw, BY_WHEELS)}
