"""Any robot: no textbook tells where its commands lead, only its recording."""

from nics_drl_bridge.robot.kinds import Drawing, RobotKind
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import Template


def drawing(spec: RobotSpec) -> Drawing:
    """A disc."""
    return Drawing(spec.footprint_radius, (0.0, 0.02), ())


KIND = RobotKind(None, drawing, Template(moves=POSE_RATES), sideways=True)
