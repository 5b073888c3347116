from __future__ import annotations

import numpy as np
import pytest

from gate.rig import TICK_S, Rig, config
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


def test_a_gate_that_knows_nothing_names_every_check_that_fails():
    known = {name for name, _ in CHECKS}
    names = failed(Rig(config(limits=None, sensors=("rear",))), publishers=2)
    assert names == known - {"nothing_latched", "one_policy"}  # nothing has come yet


@pytest.mark.parametrize(
    ("silent", "names"),
    [
        ("scan", {"scan_fresh", "scan_rate", "clocks_agree"}),
        ("odom", {"odom_fresh", "odom_rate", "standing_still", "clocks_agree"}),
        ("estimate", {"estimator_converged"}),
        ("e_stop", {"e_stop_released"}),
        ("command", None),
    ],
)
def test_a_silent_topic_is_named(silent, names):
    rig = settled(without=silent)
    if names is None:
        assert rig.arm().granted
    else:
        assert failed(rig) == names


@pytest.mark.parametrize("topic", ["scan", "odom"])
def test_fresh_for_less_than_a_second_is_not_enough(topic):
    assert f"{topic}_fresh" in failed(settled(0.9))


@pytest.mark.parametrize(
    ("changes", "faults"),
    [
        ({}, set()),
        ({"scan_rate": 5.0}, {"scan_rate"}),
        ({"scan_rate": 20.0}, {"scan_rate"}),
        ({"odom_rate": 5.0}, {"odom_rate"}),
        ({"odom_rate": 20.0}, {"odom_rate"}),
        ({"odom_rate": 5.0, "odom_rate_declared": False}, set()),
        ({"odom_rate": 20.0, "odom_rate_declared": False}, {"odom_rate"}),
    ],
)
def test_a_rate_other_than_declared_is_named(changes, faults):
    """Where none is declared for odometry, more than is needed is as good."""
    rig = settled(**changes)
    if faults:
        assert failed(rig) == faults
    else:
        assert rig.arm().granted
        assert rig.decision.answer == "armed"


def test_a_simulation_that_runs_at_double_speed_keeps_its_declared_rates():
    rig = Rig(config(clock_rate=2.0))
    for _ in range(60):
        for _ in range(2):
            rig.now += 0.025
            rig.tick()
        rig.send()
    assert rig.arm().granted, rig.decision.answer


@pytest.mark.parametrize("off_s", [3600.0, -3600.0, 0.55, -0.55, 0.45, -0.45])
def test_stamps_of_scan_and_odometry_that_are_far_apart_are_named(off_s):
    rig = Rig()
    scan = rig.scan
    rig.scan = lambda: scan(stamp_ns=rig.stamp + round(off_s * NS_PER_S))
    rig.run(1.5)
    if abs(off_s) < 0.5:
        assert rig.arm().granted
    else:
        assert failed(rig) == {"clocks_agree"}


def test_an_estimate_that_moves_while_odometry_stands_is_named():
    rig = settled()
    rig.give(Estimate(np.array([0.3, 0.0, 0.0]), np.zeros(3), np.zeros((3, 3))))
    assert failed(rig) == {"estimator_converged"}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_estimate_that_is_no_number_is_refused(bad):
    rig = settled(without="estimate")
    zeros = np.zeros(3)
    nothing = np.zeros((3, 3))
    assert rig.give(Estimate(np.full(3, bad), zeros, nothing)).refused
    assert rig.give(Estimate(zeros, np.full(3, bad), nothing)).refused
    assert rig.give(Estimate(zeros, zeros, np.full((3, 3), bad))).refused
    assert rig.give(Estimate(zeros, zeros, np.diag([0.1, 0.1, -0.1]))).refused
    assert failed(rig) == {"estimator_converged"}


@pytest.mark.parametrize("publishers", [0, 2])
def test_a_second_publisher_on_cmd_vel_is_named(publishers):
    assert failed(settled(), publishers=publishers) == {"one_publisher"}


def test_a_robot_that_moved_within_the_last_second_is_named():
    rig = settled()
    rig.speed = 0.1
    rig.run(0.2)
    rig.speed = 0.0
    rig.run(0.6)
    assert failed(rig) == {"standing_still"}


def test_a_pressed_e_stop_is_named_until_it_is_released_and_reset():
    rig = settled()
    rig.give(EStop(True))
    assert failed(rig) == {"e_stop_released"}
    rig.give(EStop(False))
    assert failed(rig) == {"e_stop_released"}
    assert rig.give(Reset()).granted
    assert rig.arm().granted


def test_the_refusal_for_want_of_an_e_stop_names_the_setting_of_a_simulation():
    never_heard = settled(without="e_stop").arm().answer
    assert "no e_stop was ever heard" in never_heard
    assert "in a simulation start the gate with e_stop_required:=false" in never_heard
    pressed = settled()
    pressed.give(EStop(True))
    assert "e_stop_required" not in pressed.arm().answer


def test_a_latched_stop_is_named():
    rig = settled()
    assert rig.arm().granted
    rig.now += TICK_S
    rig.scan(stamp_ns=rig.stamp + 60 * NS_PER_S)
    rig.stamp += 60 * NS_PER_S
    rig.run(2.0)
    assert failed(rig) == {"nothing_latched"}
    assert rig.give(Reset()).granted
    assert rig.arm().granted


def test_a_robot_with_noisy_odometry_stands_still_although_it_seems_to_move():
    noisy, quiet = (Rig(config(odom_std=std)) for std in ((0.03, 0.1), (0.0, 0.0)))
    for rig in (noisy, quiet):
        rig.speed = 0.08
        rig.run(1.5)
    assert noisy.arm().granted
    assert "standing_still" in failed(quiet)
