"""A robot with two driven wheels on one axle, left and right; `base_link` is the axle's middle.

Its commands are the base's forward speed [m/s] and turn rate [rad/s]; of `differential_wheels` the
speeds of both wheels [rad/s].
"""

import numpy as np

from nics_drl_bridge.robot.kinds import (
    Drawing,
    RobotKind,
    Textbook,
    place_wheels,
    wheeled,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.template import LAGS, TWIST, WHEELS, Template, list_names

MOVES = ("vx", "wz")
LENGTHS = {"track": 1.4, "wheel_radius": 0.3}


def kinematics(spec: RobotSpec, slip: float = 1.0) -> Textbook:
    """The mean of the wheels drives, their difference over the track turns, by a factor `slip`."""
    p = spec.parameters
    inverse = np.array([[1, -p["track"] / 2], [1, p["track"] / 2]]) / p["wheel_radius"]
    forward = np.zeros((3, 2))
    forward[[0, 2]] = np.linalg.inv(inverse)
    return wheeled(spec, inverse, forward, ("vx", "wz"), list_names(WHEELS), slip)


def drawing(spec: RobotSpec) -> Drawing:
    """A disc between two wheels."""
    track = spec.parameters["track"]
    radius = spec.parameters["wheel_radius"]
    places = ((0.0, 0.5 * track), (0.0, -0.5 * track))
    return Drawing(
        0.4 * track,
        (0.0, radius),
        place_wheels(spec, places, radius, list_names(WHEELS)),
    )


KIND = RobotKind(kinematics, drawing, Template((TWIST,), MOVES, (), LAGS, LENGTHS))
BY_WHEELS = Template((WHEELS,), (), (), LAGS, LENGTHS)
VARIANTS = {"differential_wheels": RobotKind(kinematics, drawing, BY_WHEELS)}
