"""Any robot: the effects of its commands are known only from a recording."""

from nics_drl_bridge.robot.kinds import RobotKind, draw_disc
from nics_drl_bridge.robot.spec import POSE_RATES
from nics_drl_bridge.robot.template import Template

KIND = RobotKind(
    kinematics=None,
    drawing=draw_disc,
    template=Template(moves=POSE_RATES),
    sideways=True,
)
