"""A robot that moves in every direction, on wheels of any sort, by its body twist as commands."""

import numpy as np

from nics_drl_bridge.robot.kinds import RobotKind, Textbook, disc, wheeled
from nics_drl_bridge.robot.spec import CMD_VEL_FIELDS, POSE_RATES, POSE_UNITS, RobotSpec
from nics_drl_bridge.robot.template import LAGS, Template, usual

REACH = (1.0, 1.0, 2.0)
COMMANDS = tuple(map(usual, POSE_RATES, POSE_UNITS, REACH, CMD_VEL_FIELDS))


def kinematics(spec: RobotSpec) -> Textbook:
    """Its twist follows its commands, with the lag of its wheels."""
    return wheeled(spec, np.eye(3), np.eye(3), POSE_RATES, POSE_RATES)


KIND = RobotKind(
    kinematics, disc, Template((COMMANDS,), POSE_RATES, (), LAGS), sideways=True
)
