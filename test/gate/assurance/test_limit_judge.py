from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.gate.assurance.limit_judge import LimitJudge
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import Cause, Decision
from nics_drl_bridge.robot.spec import load_robot

ROBOT = load_robot("differential")  # up to 1 m/s, by 2 m/s^2 and 40 m/s^3
STEP_S = 0.02
STOPPED = Cause("scan_silent", "scan", "")


def judge(*decisions):
    """The violations by name of decisions at every step, after a robot at rest."""
    seen = LimitJudge(ROBOT, load_limits("differential", ROBOT))
    for step, decision in enumerate([say(0.0), *decisions]):
        seen.see(decision, step * STEP_S)
    return {name: count for name, count in seen.violations.items() if count}


def say(speed, cause=None, shielded=False, sideways=0.0):
    twist = np.array([speed, sideways, 0.0])
    return Decision(twist, publish=True, cause=cause, shielded=shielded)


def test_a_command_within_all_limits_violates_none():
    assert judge(say(0.01), say(0.03), say(0.06)) == {}


@pytest.mark.parametrize(
    ("decisions", "name"),
    [
        ([say(1.5)], "value"),
        ([say(float("nan"))], "value"),
        ([say(0.5)], "rate"),
        ([say(0.04), say(0.0)], "jerk"),
        ([say(0.01, cause=STOPPED)], "stop"),
        ([say(0.01, sideways=0.1)], "unused"),
    ],
)
def test_each_limit_is_seen_to_be_exceeded(decisions, name):
    assert name in judge(*decisions)


def test_braking_may_be_as_hard_as_it_needs_to_be():
    faster = [say(0.01), say(0.03), say(0.06), say(0.1)]
    assert judge(*faster, say(0.0, shielded=True)) == {}
    assert judge(*faster, say(0.0, cause=STOPPED)) == {}
    assert set(judge(*faster, say(0.0))) == {"rate", "jerk"}


def test_a_shield_does_not_excuse_a_command_that_grows_too_fast():
    assert set(judge(say(0.5, shielded=True))) == {"rate"}
