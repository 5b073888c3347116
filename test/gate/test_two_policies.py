from __future__ import annotations

import numpy as np
import pytest

from gate.rig import TICK_S, Rig, driving
from nics_drl_bridge.gate.inputs import Command, Reset
from nics_drl_bridge.gate.stops import SOURCE_S

TWIST = np.array([0.5, 0.0, 0.1])


def command(rig, source="", publishers=1):
    """A command of a publisher, as fresh as the others."""
    return rig.give(Command(rig.stamp, TWIST, source, publishers))


def named(rig, source):
    """Commands come from a publisher from now on."""
    rig.command = lambda stamp=None: rig.give(Command(stamp, TWIST, source))


def test_one_policy_whose_name_is_known_drives():
    rig = driving()
    named(rig, "/policy_node")
    assert rig.run(3.0).cause is None
    assert rig.moves


@pytest.mark.parametrize("apart_s", [TICK_S, 0.5])
def test_a_second_policy_that_joins_stops_the_robot_for_good_and_both_are_named(
    apart_s,
):
    rig = driving()
    named(rig, "/policy_node")
    rig.run(1.0)
    rig.run(apart_s)
    decision = command(rig, "/other")
    assert decision.publish
    assert not rig.moves
    assert rig.rule == "two_policies"
    assert "/policy_node and /other both publish on cmd_vel_raw" in decision.cause.line
    rig.speed = 0.0
    rig.run(2.0)
    assert not rig.moves


def test_as_long_as_both_command_it_is_not_armed_and_says_so():
    rig = driving()
    named(rig, "/policy_node")
    rig.run(0.5)
    command(rig, "/other")
    rig.speed = 0.0
    rig.run(1.5)
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


def test_where_messages_do_not_tell_their_publisher_the_number_of_publishers_counts():
    rig = driving()
    assert command(rig).cause is None
    decision = command(rig, publishers=2)
    assert rig.rule == "two_policies"
    assert "2 nodes publish on cmd_vel_raw" in decision.cause.line


def test_a_command_that_is_refused_counts_as_one_of_its_publisher():
    rig = driving()
    named(rig, "/policy_node")
    rig.run(0.5)
    rig.give(Command(rig.stamp, np.full(3, np.nan), "/other"))
    assert rig.rule == "two_policies"


def test_a_gate_that_is_not_armed_does_not_latch_what_two_policies_do():
    rig = Rig()
    rig.run(0.5)
    command(rig, "/one")
    command(rig, "/other")
    assert rig.rule == "disarmed"
    rig.run(1.5)
    assert rig.arm().granted
