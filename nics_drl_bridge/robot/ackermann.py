"""A car: the rear axle drives, the front wheels steer; `base_link` is the middle of the rear axle.

Its commands are the rear axle's speed [m/s] and the steering angle [rad] of a virtual middle wheel.
The commands of `ackermann_throttle` are throttle and steering in [-1, 1]: its speed tends to
`speed_gain` [m/s] times the throttle, its steering angle to `greatest_steering` [rad] times the
steering. Only a recording can add drag, a dead zone or slip.
"""

from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.robot import kinds
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import (
    RATIO_RANGE,
    STEERED,
    STEERED_LAGS,
    Template,
    list_names,
    make_command,
)

LENGTHS = {"wheelbase": 1.3}
TEMPLATE = Template(
    commands=(STEERED,),
    moves=POSE_RATES,
    parameters=STEERED_LAGS,
    lengths=LENGTHS,
)
THROTTLE = (
    make_command("throttle", "1", RATIO_RANGE),
    make_command("steering", "1", RATIO_RANGE),
)
# The lag of the speed is long because a car coasts.
GAINS = {
    "speed_gain": 3.0,
    "greatest_steering": 0.4,
    "speed_lag": 0.5,
    "steering_lag": 0.1,
}


def derive_kinematics(spec: RobotSpec) -> kinds.Textbook:
    """Returns kinematics whose curvature is tan(angle) / wheelbase."""
    return kinds.make_steered(
        spec, Bicycle(spec.parameters["wheelbase"]), list_names(STEERED)
    )


def derive_throttle_kinematics(spec: RobotSpec) -> kinds.Textbook:
    """Returns the same kinematics for throttle and steering, as fractions of their maxima."""
    bicycle = Bicycle(spec.parameters["wheelbase"])
    gain = (spec.parameters["speed_gain"], spec.parameters["greatest_steering"])
    return kinds.make_steered(spec, bicycle, list_names(THROTTLE), gain)


def track_and_radius(parameters: dict[str, float]) -> tuple[float, float]:
    """Returns `track` and `wheel_radius` [m], by default in proportion to the wheelbase."""
    wheelbase = parameters["wheelbase"]
    track = parameters.get("track", 0.8 * wheelbase)
    radius = parameters.get("wheel_radius", 0.18 * wheelbase)
    return track, radius


def draw(spec: RobotSpec) -> kinds.Drawing:
    """Draws a box on four wheels; the right front wheel follows the left one."""
    wheelbase = spec.parameters["wheelbase"]
    angle = kinds.find_steering_angle(spec)
    track, radius = track_and_radius(spec.parameters)
    wheels = []
    for side, y, suffix in (
        ("left", 0.5 * track, ""),
        ("right", -0.5 * track, "_right"),
    ):
        pivot = None
        if angle is not None:
            pivot = kinds.Pivot(f"{side}_knuckle", angle.name + suffix, angle)
        rear = kinds.Wheel(f"rear_{side}_wheel", (0.0, y), radius)
        front = kinds.Wheel(f"front_{side}_wheel", (wheelbase, y), radius, pivot=pivot)
        wheels += [rear, front]
    return kinds.Drawing(
        body=(1.3 * wheelbase, 0.7 * track),
        centre=(0.45 * wheelbase, radius),
        wheels=tuple(wheels),
    )


KIND = kinds.RobotKind(derive_kinematics, draw, TEMPLATE)
VARIANTS = {
    "ackermann_throttle": kinds.RobotKind(
        kinematics=derive_throttle_kinematics,
        drawing=draw,
        template=Template(
            commands=(THROTTLE,),
            moves=POSE_RATES,
            parameters=GAINS,
            lengths=LENGTHS,
        ),
    )
}
