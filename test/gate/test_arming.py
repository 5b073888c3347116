"""A request to arm is granted, or names every check that fails."""

from __future__ import annotations

import numpy as np
import pytest

from gate.rig import Rig, config
from nics_drl_bridge.gate.arming import CHECKS
from nics_drl_bridge.gate.inputs import Estimate, EStop, Reset
from nics_drl_bridge.interface import NS_PER_S


def failed(rig, **how):
    decision = rig.arm(**how)
    assert not decision.granted
    rig.run(0.1)
    assert not rig.moves
    return {sentence.partition(":")[0] for sentence in decision.answer.split("; ")}


def settled(seconds=1.5, without="", **changes):
    rig = Rig(config(**changes))
    rig.run(seconds, without)
    return rig


def assert_fails(rig, faults, **how):
    if faults:
        assert failed(rig, **how) == set(faults.split())
    else:
        assert rig.arm(**how).granted, rig.decision.answer


def test_a_gate_that_knows_nothing_names_every_check_that_fails():
    names = failed(Rig(config(limits=None, sensors=("rear",))), publishers=2)
    assert names == CHECKS.keys() - {
        "nothing_latched",
        "one_policy",
    }  # nothing came yet


@pytest.mark.parametrize(
    ("changes", "faults"),
    [
        ({"without": "scan"}, "scan_fresh scan_rate clocks_agree"),
        ({"without": "odom"}, "odom_fresh odom_rate standing_still clocks_agree"),
        ({"without": "estimate"}, "estimator_converged"),
        ({"without": "e_stop"}, "e_stop_released"),
        ({"without": "command"}, ""),
        ({"scan_rate": 5.0}, "scan_rate"),
        ({"scan_rate": 20.0}, "scan_rate"),
        ({"odom_rate": 5.0}, "odom_rate"),
        ({"odom_rate": 20.0}, "odom_rate"),
        ({"odom_rate": 5.0, "odom_rate_declared": False}, ""),
        ({"odom_rate": 20.0, "odom_rate_declared": False}, "odom_rate"),
    ],
)
def test_a_topic_that_is_silent_or_of_another_rate_is_named(changes, faults):
    assert_fails(settled(**changes), faults)


def test_a_simulation_that_runs_at_double_speed_keeps_its_declared_rates():
    rig = Rig(config(clock_rate=2.0))
    for _ in range(60):
        for _ in range(2):
            rig.now += 0.025
            rig.tick()
        rig.send()
    assert rig.arm().granted, rig.decision.answer


def test_an_estimate_that_moves_while_odometry_stands_is_named():
    rig = settled()
    rig.give(Estimate(np.array([0.3, 0.0, 0.0]), np.zeros(3), np.zeros((3, 3))))
    assert_fails(rig, "estimator_converged")


@pytest.mark.parametrize(
    "changes",
    [
        {"twist": np.full(3, np.nan)},
        {"pose": np.full(3, np.inf)},
        {"covariance": np.full((3, 3), np.nan)},
        {"covariance": np.diag([0.1, 0.1, -0.1])},
    ],
)
def test_an_estimate_that_can_not_be_is_refused(changes):
    rig = settled(without="estimate")
    fine = {"twist": np.zeros(3), "pose": np.zeros(3), "covariance": np.zeros((3, 3))}
    assert rig.give(Estimate(**fine | changes)).refused
    assert_fails(rig, "estimator_converged")


@pytest.mark.parametrize("publishers", [0, 2])
def test_a_second_publisher_on_cmd_vel_is_named(publishers):
    assert_fails(settled(), "one_publisher", publishers=publishers)


@pytest.mark.parametrize(
    ("odom_std", "speed", "stood_s", "faults"),
    [
        ((0.0, 0.0), 0.1, 0.6, "standing_still"),
        ((0.0, 0.0), 0.08, 0.0, "standing_still estimator_converged"),
        ((0.03, 0.1), 0.08, 0.0, ""),  # as its noise seems
    ],
)
def test_a_robot_that_moved_within_the_last_second_is_named(
    odom_std, speed, stood_s, faults
):
    rig = settled(odom_std=odom_std)
    rig.speed = speed
    rig.run(0.2)
    if stood_s:
        rig.speed = 0.0
    rig.run(stood_s)
    assert_fails(rig, faults)


def test_a_pressed_e_stop_is_named_until_it_is_released_and_reset():
    rig = settled()
    for pressed in (True, False):
        rig.give(EStop(pressed))
        assert_fails(rig, "e_stop_released")
    assert "e_stop_required" not in rig.decision.answer
    assert rig.give(Reset()).granted
    assert rig.arm().granted


def test_the_refusal_for_want_of_an_e_stop_names_the_setting_of_a_simulation():
    never_heard = settled(without="e_stop").arm().answer
    assert "no e_stop was ever heard" in never_heard
    assert "in a simulation start the gate with e_stop_required:=false" in never_heard


def test_a_latched_stop_is_named_until_it_is_reset():
    rig = settled()
    assert rig.arm().granted
    rig.scan(stamp_ns=rig.stamp + 60 * NS_PER_S)
    rig.stamp += 60 * NS_PER_S
    rig.run(2.0)
    assert_fails(rig, "nothing_latched")
    assert rig.give(Reset()).granted
    assert rig.arm().granted
