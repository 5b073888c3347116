from __future__ import annotations

import numpy as np
import pytest

from gate.rig import PERIOD_S, Rig, config, driving
from nics_drl_bridge.gate.estimate import WINDOW_S, compute_growth
from nics_drl_bridge.gate.inputs import Estimate, Reset
from nics_drl_bridge.gate.state import EstimateMark
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import Kind, Measurement


@pytest.mark.parametrize(
    ("std", "fine"),
    [
        ((0.45, 0.0, 0.0), True),
        ((0.55, 0.0, 0.0), False),
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


@pytest.mark.parametrize(
    ("added", "rule"),
    [([0.05, 0.05, 0.0], "estimate_lost"), ([0.002, 0.002, 2e-4], "")],
)
def test_uncertainty_is_counted_over_ten_seconds_not_since_the_start(added, rule):
    rig = driving()
    for _ in range(round(4 * WINDOW_S / 0.1)):
        rig.covariance = rig.covariance + np.diag(added)
        rig.run(0.1)
        if not rig.moves:
            break
    assert rig.rule == rule
    assert rig.covariance[0, 0] > 0.5**2  # in all


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


class DeadReckoning(Rig):
    """A robot whose estimator hears odometry alone."""

    tick_s = PERIOD_S

    def __init__(self):
        super().__init__(config("differential", estimate_position=0.1))
        self.estimator = Estimator(builtin_model("differential"))
        self.estimator.reset(round(self.now * NS_PER_S), np.zeros(3))

    def send(self, without=""):
        twist = np.array([self.speed, 0.0, 0.0])
        self.estimator.predict(round(self.now * NS_PER_S))
        self.estimator.correct(Measurement(Kind.TWIST, twist, None, self.pose))
        self.covariance = self.estimator.covariance[:3, :3]
        super().send(without)


@pytest.mark.parametrize("rounds", [2, pytest.param(200, marks=pytest.mark.campaign)])
def test_without_a_localiser_it_can_be_armed_again_and_again_and_drives(rounds):
    rig = DeadReckoning()
    for _ in range(rounds):
        rig.give(Reset())
        rig.speed = 0.0
        rig.drive(40.0)
    assert np.sqrt(rig.covariance.max()) > 2 * rig.config.estimate_position
