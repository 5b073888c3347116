from __future__ import annotations

import numpy as np
import pytest

from gate.rig import Rig, driving
from nics_drl_bridge.gate.estimate import WINDOW_S, compute_growth
from nics_drl_bridge.gate.inputs import (
    Estimate,
    Reset,
)
from nics_drl_bridge.gate.state import EstimateMark


@pytest.mark.parametrize(
    ("std", "fine"),
    [
        ((0.45, 0.0, 0.0), True),
        ((0.0, 0.45, 0.0), True),
        ((0.0, 0.0, 0.27), True),
        ((0.55, 0.0, 0.0), False),
        ((0.0, 0.55, 0.0), False),
        ((0.0, 0.0, 0.33), False),
    ],
)
def test_an_estimate_that_becomes_uncertain_stops_the_robot_and_names_the_remedy(
    std, fine
):
    rig = driving()
    rig.covariance = np.diag(std) ** 2
    rig.run(0.3)
    assert rig.rule == ("" if fine else "estimate_lost")
    if fine:
        return
    assert "initialpose" in rig.decision.cause.line
    assert "middleware_node/~/reset" in rig.decision.cause.line
    rig.speed = 0.0
    rig.run(2.0)
    assert rig.rule == "estimate_lost"
    assert rig.give(Reset()).granted
    assert rig.arm().granted, rig.decision.answer


@pytest.mark.parametrize(("added", "rule"), [(0.05, "estimate_lost"), (0.002, "")])
def test_uncertainty_is_counted_over_some_seconds(added, rule):
    rig = driving()
    for _ in range(80):
        rig.covariance = rig.covariance + np.diag([added, added, 0.0])
        rig.run(0.1)
        if not rig.moves:
            break
    assert rig.rule == rule


def test_a_gate_that_is_not_armed_names_a_fault_of_a_moment_ago_and_then_forgets_it():
    rig = Rig()
    rig.run(1.5)
    rig.covariance = 9.0 * np.eye(3)
    rig.run(0.2)
    answer = rig.arm().answer
    assert "estimator_converged" in answer
    assert "the limits are 0.5 m and 0.3 rad" in answer
    assert "initialpose" in answer
    rig.settle()


def test_what_an_uncertain_heading_does_over_the_way_driven_is_no_growth():
    mark = EstimateMark(0.0, np.array([1.0, 2.0, 0.3]), np.diag([0.2, 0.3, 0.25]))
    away = np.array([10.0, -5.0])
    carried = np.array([[1.0, 0.0, -away[1]], [0.0, 1.0, away[0]], [0.0, 0.0, 1.0]])
    pose = np.array([*(mark.pose[:2] + away), 1.0])
    grown = carried @ mark.covariance @ carried.T + np.diag([0.04, 0.01, 0.09])
    found = compute_growth(mark, Estimate(np.zeros(3), pose, grown))
    assert found == pytest.approx((0.2, 0.3))
    assert compute_growth(mark, Estimate(np.zeros(3), mark.pose, 1e-4 * np.eye(3))) == (
        0.0,
        0.0,
    )


def test_uncertainty_is_counted_over_some_seconds_not_since_the_last_hour():
    rig = driving()
    for _ in range(round(4 * WINDOW_S / 0.5)):
        rig.covariance = rig.covariance + np.diag([0.01, 0.01, 0.001])  # 0.45 m in 10 s
        assert rig.run(0.5).cause is None
    assert rig.covariance[0, 0] > 0.5**2
