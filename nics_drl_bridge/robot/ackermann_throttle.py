"""A car, see `ackermann`, driven by shares of throttle and steering in [-1, 1].

Its speed comes to `speed_gain` [m/s] times the throttle, its steering angle to `greatest_steering`
[rad] times the share; drag, a dead zone and slip are for a recording to show.
"""

from nics_drl_bridge.robot.ackermann import LENGTHS, drawing
from nics_drl_bridge.robot.drivetrain import steered
from nics_drl_bridge.robot.kinds import RobotKind, Textbook
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.steering import Bicycle
from nics_drl_bridge.robot.template import SHARES, Template, names_of, usual

THROTTLE = (usual("throttle", "1", SHARES), usual("steering", "1", SHARES))
# The lag of the speed is that of rolling on, so that it is long.
PARAMETERS = {
    "speed_gain": 3.0, "greatest_steering": 0.4, "speed_lag": 0.5, "steering_lag": 0.1,
}  # fmt: skip


def kinematics(spec: RobotSpec) -> Textbook:
    """The kinematics of a car by speed and steering angle."""
    p = spec.parameters
    gain = p["speed_gain"], p["greatest_steering"]
    return steered(spec, Bicycle(p["wheelbase"]), names_of(THROTTLE), gain)


KIND = RobotKind(
    kinematics, drawing, Template((THROTTLE,), POSE_RATES, (), PARAMETERS, LENGTHS)
)  # fmt: skip
