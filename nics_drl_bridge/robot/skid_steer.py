"""A robot whose wheels or tracks on either side turn alike, so that it skids when it turns.

Its commands are its body twist, or the speeds of both sides [rad/s]. It turns by the distance
`effective_track` between the centres about which its sides turn, no less than its `track` [m], by
which its drive makes wheel speeds of a turn rate (Mandow et al. 2007). Its four wheels stand at
`half_length` and `half_width` [m] from `base_link`, half a track if they are not given.
"""

from nics_drl_bridge.robot import differential
from nics_drl_bridge.robot.kinds import (
    Drawing,
    RobotKind,
    Textbook,
    Wheel,
    places_of_four,
)
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import LAGS, TWIST, WHEELS, Template

TEMPLATE = Template(
    commands=(TWIST, WHEELS),
    moves=POSE_RATES,
    parameters=LAGS,
    lengths={"track": 1.3, "effective_track": 2.0, "wheel_radius": 0.3},
)


def kinematics(spec: RobotSpec) -> Textbook:
    """A differential robot's kinematics, of which the effective track takes a share."""
    slip = spec.parameters["track"] / spec.parameters["effective_track"]
    return differential.kinematics(spec, slip)


def drawing(spec: RobotSpec) -> Drawing:
    """A box on four wheels, which stand still."""
    places = places_of_four(spec.parameters)
    radius = spec.parameters["wheel_radius"]
    x, y = places["front_left"]
    wheels = (Wheel(f"{name}_wheel", at, radius) for name, at in places.items())
    return Drawing((2.0 * (x + radius), 1.6 * y), (0.0, 1.2 * radius), tuple(wheels))


KIND = RobotKind(kinematics, drawing, TEMPLATE, slips=True)
