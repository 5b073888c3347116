"""Faults around processes of gate and policy, as `nics assure` injects them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from gate.assurance.samples import PROTOCOL

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes.gate_faults import (
    CONTROLS,
    FAULTS,
    inject_trials,
)

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]
TWO = replace(PROTOCOL, faults=2, fault_kinds=tuple(FAULTS), fault_controls=CONTROLS)


def inject(tmp_path, *trials):
    lines = []
    rows = list(inject_trials(TWO, tmp_path, lines.append, list(trials)))
    assert all(row["injected"] for row in rows), lines
    return rows


def test_a_gate_stops_in_time_and_without_it_nothing_does(tmp_path):
    gated = replace(TWO, fault_kinds=("scan_silent",)).list_faults()[0]
    kept, control = inject(tmp_path, gated, gated._replace(gated=False))
    assert kept["in_time"]
    assert kept["time_s"] <= kept["limit_s"] == 0.4
    assert kept["unsafe"] == 0
    assert not control["in_time"]
    assert control["unsafe"] > 0


def test_the_policy_under_test_drives_the_robot_whose_policy_then_dies(tmp_path):
    trial = replace(TWO, fault_kinds=("policy_killed",)).list_faults()[0]
    (row,) = inject(tmp_path, trial)
    assert row["in_time"]
    assert (tmp_path / "policy_node.log").exists()


def test_the_controls_are_faults_that_are_injected():
    assert set(CONTROLS) <= FAULTS.keys()
