"""Models whose state is the robot's own motion, identified from drives of other simulators."""

from __future__ import annotations

from functools import cache

from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.robot.spec import build_robot

from .projection import Found

DURATIONS_S = {"throttle_car": 30.0, "skid_steer": 20.0, "ticks": 20.0}
SEED = 11
"""Of the drives. Other drives of the throttle car leave a corner of an input curve undecided: there
a change of 1e-12 m in the poses, or another processor, moves the errors by up to a third."""


@cache
def identify_robot(name: str) -> Identified:
    """Identifies a robot of `measuring.foreign_robots` from one short drive."""
    from measuring.foreign_robots import ROBOTS, foreign_drive

    robot = ROBOTS[name]
    drive = foreign_drive(robot, SEED, DURATIONS_S[name])
    spec = build_robot(robot.robot, robot.commands)
    return identify(drive.recording(), spec, alpha=0.99)


def motion_state_errors() -> Found:
    """Mean position errors on data held out [m], by horizon."""
    found: Found = {}
    for name in DURATIONS_S:
        for errors in identify_robot(name).judgement:
            found[f"{name} after {errors.horizon_s:g} s"] = [errors.model.position_m]
    return found


def motion_state_terms() -> Found:
    """The terms that each model kept, by rate."""
    found: Found = {}
    for name in DURATIONS_S:
        for rate, terms in identify_robot(name).model.named.terms.items():
            found[f"{name} {rate}"] = sorted(terms)
    return found
