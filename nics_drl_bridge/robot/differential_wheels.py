"""A differential robot, see `differential`, driven by the speeds of its wheels [rad/s]."""

from nics_drl_bridge.robot.differential import LENGTHS, drawing, kinematics
from nics_drl_bridge.robot.kinds import RobotKind
from nics_drl_bridge.robot.template import LAGS, WHEELS, Template

KIND = RobotKind(kinematics, drawing, Template((WHEELS,), (), (), LAGS, LENGTHS))
