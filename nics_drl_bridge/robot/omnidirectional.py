"""A robot that moves in all directions, on any wheels; its commands are its body twist."""

import numpy as np

from nics_drl_bridge.robot.kinds import RobotKind, Textbook, draw_disc, make_wheeled
from nics_drl_bridge.robot.spec import CMD_VEL_FIELDS, POSE_RATES, POSE_UNITS, RobotSpec
from nics_drl_bridge.robot.template import LAGS, Template, make_command

MAX_TWIST = (1.0, 1.0, 2.0)
TEMPLATE = Template(
    commands=(
        tuple(map(make_command, POSE_RATES, POSE_UNITS, MAX_TWIST, CMD_VEL_FIELDS)),
    ),
    moves=POSE_RATES,
    parameters=LAGS,
)


def derive_kinematics(spec: RobotSpec) -> Textbook:
    """Returns kinematics whose twist follows the commands with the lag of the wheels."""
    return make_wheeled(spec, np.eye(3), np.eye(3), POSE_RATES, POSE_RATES)


KIND = RobotKind(derive_kinematics, draw_disc, TEMPLATE, sideways=True)
