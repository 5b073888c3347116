"""A car: the rear axle drives, the front wheels steer; `base_link` is the middle of the rear axle.

Commanded are the rear axle's speed [m/s] and the steering angle [rad] of a virtual middle wheel; of
`ackermann_throttle` shares of throttle and steering in [-1, 1]: the speed comes to `speed_gain`
[m/s] times the throttle, the steering angle to `greatest_steering` [rad] times the share; drag, a
dead zone and slip are for a recording to show.
"""

from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.robot import kinds
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import (
    SHARES,
    STEERED,
    STEERED_LAGS,
    Template,
    list_names,
    usual,
)

LENGTHS = {"wheelbase": 1.3}
TEMPLATE = Template((STEERED,), POSE_RATES, (), STEERED_LAGS, LENGTHS)
THROTTLE = (usual("throttle", "1", SHARES), usual("steering", "1", SHARES))
# The lag of the speed is that of rolling on, so that it is long.
GAINS = {
    "speed_gain": 3.0,
    "greatest_steering": 0.4,
    "speed_lag": 0.5,
    "steering_lag": 0.1,
}


def kinematics(spec: RobotSpec) -> kinds.Textbook:
    """Curvature tan(angle) / wheelbase."""
    return kinds.steered(
        spec, Bicycle(spec.parameters["wheelbase"]), list_names(STEERED)
    )


def by_throttle(spec: RobotSpec) -> kinds.Textbook:
    """The same, of shares of the greatest speed and steering angle."""
    p = spec.parameters
    gain = p["speed_gain"], p["greatest_steering"]
    return kinds.steered(spec, Bicycle(p["wheelbase"]), list_names(THROTTLE), gain)


def track_and_radius(parameters: dict[str, float]) -> tuple[float, float]:
    """Returns `track` and `wheel_radius` [m]; by default shares of the wheelbase."""
    base = parameters["wheelbase"]
    return parameters.get("track", 0.8 * base), parameters.get(
        "wheel_radius", 0.18 * base
    )


def drawing(spec: RobotSpec) -> kinds.Drawing:
    """A box on four wheels; the right front wheel follows the left one."""
    wheelbase = spec.parameters["wheelbase"]
    angle = kinds.steering_angle(spec)
    track, radius = track_and_radius(spec.parameters)
    wheels = []
    for side, y, suffix in (
        ("left", 0.5 * track, ""),
        ("right", -0.5 * track, "_right"),
    ):
        if angle:
            pivot = kinds.Pivot(f"{side}_knuckle", angle.name + suffix, angle)
        else:
            pivot = None
        wheels.append(kinds.Wheel(f"rear_{side}_wheel", (0.0, y), radius))
        wheels.append(
            kinds.Wheel(f"front_{side}_wheel", (wheelbase, y), radius, pivot=pivot)
        )
    return kinds.Drawing(
        (1.3 * wheelbase, 0.7 * track), (0.45 * wheelbase, radius), tuple(wheels)
    )


KIND = kinds.RobotKind(kinematics, drawing, TEMPLATE)
VARIANTS = {
    "ackermann_throttle": kinds.RobotKind(
        by_throttle, drawing, Template((THROTTLE,), POSE_RATES, (), GAINS, LENGTHS)
    )
}
