from __future__ import annotations

import numpy as np

from gate.rig import driving
from nics_drl_bridge.gate.inputs import Command, Reset
from nics_drl_bridge.gate.stops import SOURCE_S

TWIST = np.array([0.5, 0.0, 0.1])


def command(rig, source="", publishers=1):
    """A command of a publisher, as fresh as the others."""
    return rig.give(Command(rig.stamp, TWIST, source, publishers))


def named(rig, source):
    """Commands come from a publisher from now on."""
    rig.command = lambda stamp=None: rig.give(Command(stamp, TWIST, source))


def test_a_second_policy_that_joins_stops_the_robot_for_good_and_both_are_named():
    rig = driving()
    named(rig, "/policy_node")
    rig.run(1.0)
    decision = command(rig, "/other")
    assert decision.publish
    assert not rig.moves
    assert rig.rule == "two_policies"
    assert "/policy_node and /other both publish on cmd_vel_raw" in decision.cause.line
    rig.speed = 0.0
    rig.run(2.0)
    assert not rig.moves
    rig.give(Reset())
    rig.run(1.5)
    command(rig, "/other")
    answer = rig.arm().answer
    assert answer.startswith("one_policy: /policy_node and /other both publish")
    rig.run(1.5)
    assert rig.arm().granted


def test_a_policy_that_is_started_after_the_other_has_ended_may_drive():
    rig = driving()
    named(rig, "/policy_node")
    rig.run(1.0)
    rig.run(SOURCE_S + 0.1, without="command")
    named(rig, "/policy_node (another process)")
    assert rig.run(1.0).cause is None
    assert rig.moves
