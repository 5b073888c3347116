"""A robot whose wheels or tracks on each side turn together, so that it skids when it turns.

Its commands are its body twist, or the speeds of both sides [rad/s]. Its drive converts turn rates
to wheel speeds by the `track` [m]. Its actual turn rate follows from the `effective_track` [m]: the
distance between the centres about which its sides turn, which is at least the track (Mandow et al.
2007). Its four wheels are at `half_length` and `half_width` [m] from `base_link`, by
default half a track each.
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


def derive_kinematics(spec: RobotSpec) -> Textbook:
    """Returns a differential robot's kinematics with a turn rate reduced by the effective track."""
    slip = spec.parameters["track"] / spec.parameters["effective_track"]
    return differential.derive_kinematics(spec, slip)


def draw(spec: RobotSpec) -> Drawing:
    """Draws a box on four wheels, which do not roll."""
    places = places_of_four(spec.parameters)
    radius = spec.parameters["wheel_radius"]
    x, y = places["front_left"]
    wheels = tuple(
        Wheel(f"{name}_wheel", place, radius) for name, place in places.items()
    )
    return Drawing((2.0 * (x + radius), 1.6 * y), (0.0, 1.2 * radius), wheels)


KIND = RobotKind(derive_kinematics, draw, TEMPLATE, slips=True)
