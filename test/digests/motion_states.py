"""Models whose state is the robot's own motion, identified from drives of other simulators."""

from __future__ import annotations

from functools import cache

from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.robot.spec import build_robot

from .projection import Found

DURATION_S = 20.0
ROBOT_NAMES = ("skid_steer", "ticks")
SEED = 11  # of the drives


@cache
def identify_robot(name: str) -> Identified:
    """Identifies a robot of `measuring.foreign_robots` from one short drive."""
    from measuring.foreign_robots import ROBOTS, foreign_drive

    robot = ROBOTS[name]
    drive = foreign_drive(robot, SEED, DURATION_S)
    spec = build_robot(robot.robot, robot.commands)
    return identify(drive.recording(), spec, alpha=0.99)


def motion_state_errors() -> Found:
    """Mean position errors on data held out [m], by horizon."""
    found: Found = {}
    for name in ROBOT_NAMES:
        for errors in identify_robot(name).judgement:
            found[f"{name} after {errors.horizon_s:g} s"] = [errors.model.position_m]
    return found


def motion_state_terms() -> Found:
    """The terms that each model kept, by rate."""
    found: Found = {}
    for name in ROBOT_NAMES:
        for rate, terms in identify_robot(name).model.named.terms.items():
            found[f"{name} {rate}"] = sorted(terms)
    return found
