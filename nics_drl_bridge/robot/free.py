"""Any robot: no textbook tells where its commands lead, only its recording."""

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import Drawing, RobotKind, Textbook
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.template import Template


def kinematics(spec: RobotSpec) -> Textbook:
    """Raises ConfigError."""
    fault = "no textbook tells where the commands of a robot of the kind 'free' lead"
    fix = "do without, by a recording and its model, or choose another kind"
    raise ConfigError(f"robot {spec.name!r}: {fault}; {fix}.")


def drawing(spec: RobotSpec) -> Drawing:
    """A disc."""
    return Drawing(spec.footprint_radius, (0.0, 0.02), ())


KIND = RobotKind(kinematics, drawing, Template(moves=POSE_RATES), sideways=True)
