"""A tricycle: the front wheel drives and steers; `base_link` is the middle of the rear axle.

Its commands are the front wheel's speed along its own direction [m/s] and steering angle [rad].
"""

from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.robot import kinds
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.template import (
    STEERED,
    STEERED_LAGS,
    STEERED_STATE,
    Template,
    list_names,
)

TEMPLATE = Template(
    commands=(STEERED,),
    state=STEERED_STATE,
    parameters=STEERED_LAGS,
    lengths={"wheelbase": 1.0, "track": 0.8, "wheel_radius": 0.2},
    words={"traction": "speed_command", "steering": "steering_command"},
)


def derive_kinematics(spec: RobotSpec) -> kinds.Textbook:
    """Returns the kinematics of a bicycle that its front wheel drives."""
    bicycle = Bicycle(spec.parameters["wheelbase"], front_drive=True)
    return kinds.make_steered(spec, bicycle, list_names(STEERED))


def draw(spec: RobotSpec) -> kinds.Drawing:
    """Draws a box on three wheels of one size."""
    wheelbase = spec.parameters["wheelbase"]
    track = spec.parameters["track"]
    radius = spec.parameters["wheel_radius"]
    angle = kinds.find_steering_angle(spec)
    fork = kinds.Pivot("fork", angle.name, angle) if angle else None
    wheels = (
        kinds.Wheel("rear_left_wheel", (0.0, 0.5 * track), radius),
        kinds.Wheel("rear_right_wheel", (0.0, -0.5 * track), radius),
        kinds.Wheel("front_wheel", (wheelbase, 0.0), radius, pivot=fork),
    )
    return kinds.Drawing(
        (wheelbase, 0.7 * track), (0.4 * wheelbase, 1.5 * radius), wheels
    )


KIND = kinds.RobotKind(derive_kinematics, draw, TEMPLATE, front_drive=True)
