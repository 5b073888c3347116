"""Faults around processes of gate and policy, as `nics assure` injects them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gate.assurance.samples import PROTOCOL

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.nodes.gate_faults import (
    CONTROLS,
    FAULTS,
    find_reach,
    inject_trials,
)
from nics_drl_bridge.robot.spec import load_robot

pytestmark = pytest.mark.ros
TWO = replace(PROTOCOL, faults=2, fault_kinds=tuple(FAULTS), fault_controls=CONTROLS)


def inject(tmp_path, *trials):
    lines = []
    rows = list(inject_trials(TWO, tmp_path, lines.append, list(trials)))
    assert len(rows) == len(trials), lines
    return rows


@pytest.mark.process
@pytest.mark.slow
def test_a_gate_stops_in_time_and_without_it_nothing_does(tmp_path):
    gated = replace(TWO, fault_kinds=("scan_silent",)).list_faults()[0]
    kept, control = inject(tmp_path, gated, gated._replace(gated=False))
    assert kept["in_time"]
    assert kept["time_s"] <= kept["limit_s"] == 0.4
    assert kept["unsafe"] == 0
    assert not control["in_time"]
    assert control["unsafe"] > 0


@pytest.mark.process
@pytest.mark.slow
def test_the_policy_under_test_drives_the_robot_whose_policy_then_dies(tmp_path):
    trial = replace(TWO, fault_kinds=("policy_killed",)).list_faults()[0]
    (row,) = inject(tmp_path, trial)
    assert row["in_time"]
    assert (tmp_path / "policy_node.log").exists()


@pytest.mark.parametrize("textbook", ["ackermann", "tricycle"])
def test_what_a_car_may_be_told_by_turn_rate_is_within_reach(textbook):
    car = load_robot(textbook).model_copy(update={"angular_is": "turn_rate"})
    limits = load_limits(textbook, car)
    low, high = find_reach(car, limits)
    shares = np.random.default_rng(0).uniform(size=(100, 2))
    told = car.to_cmd_vel(limits.low + shares * (limits.high - limits.low))
    assert ((low <= told) & (told <= high)).all()
    assert low[2] == -high[2] < 0.0


def test_the_controls_are_faults_that_are_injected():
    assert set(CONTROLS) <= FAULTS.keys()
