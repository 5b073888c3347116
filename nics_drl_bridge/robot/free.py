"""Any robot: no textbook tells where its commands lead, only its recording."""

from nics_drl_bridge.robot.kinds import RobotKind, disc
from nics_drl_bridge.robot.spec import POSE_RATES
from nics_drl_bridge.robot.template import Template

KIND = RobotKind(None, disc, Template(moves=POSE_RATES), sideways=True)
