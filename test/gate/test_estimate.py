from __future__ import annotations

import numpy as np
import pytest

from gate.rig import Rig, config, driving
from nics_drl_bridge.gate.estimate import WINDOW_S, compute_growth
from nics_drl_bridge.gate.inputs import (
    Arm,
    Command,
    Estimate,
    EStop,
    Odometry,
    Reset,
    Scan,
    Tick,
)
from nics_drl_bridge.gate.state import EstimateMark
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.geometry import compose, exp
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import Kind, Measurement

PERIOD_S = 0.1
REARMED_S = 300.0


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


class DeadReckoning:
    """A robot in a round of its own whose estimator hears odometry alone, and its gate."""

    def __init__(self):
        self.gate = Rig(config("differential", estimate_position=0.2))
        self.estimator = Estimator(builtin_model("differential"))
        self.steps = 0
        self.pose = np.zeros(3)
        self.std = np.zeros(2)

    def step(self, twist):
        """A period in which everything that a robot sends arrives, and the gate ticks."""
        gate = self.gate
        self.steps += 1
        self.pose = compose(self.pose, exp(np.array(twist) * PERIOD_S))
        gate.now += PERIOD_S
        gate.stamp += round(PERIOD_S * NS_PER_S)
        stamp = self.steps * round(PERIOD_S * NS_PER_S)
        self.estimator.predict(stamp)
        self.estimator.correct(
            Measurement(Kind.TWIST, np.array(twist), None, self.pose)
        )
        covariance = self.estimator.covariance[:3, :3]
        self.std = np.sqrt(
            np.array([covariance[:2, :2].diagonal().max(), covariance[2, 2]])
        )
        gate.give(Odometry(gate.stamp, self.pose.copy(), np.array(twist)))
        gate.ranges = gate.ranges + np.float32(1e-3)
        angles = gate.config.beam_angles
        gate.give(Scan(gate.stamp, gate.ranges, (angles[0], angles[1] - angles[0])))
        pose = self.estimator.belief.mean[:3].copy()
        gate.give(Estimate(np.array(twist), pose, covariance))
        gate.give(EStop(False))
        gate.give(Command(gate.stamp, np.array(twist)))
        gate.give(Tick())

    def rearm(self):
        """Stands, is reset and armed."""
        for _ in range(15):
            self.step((0.0, 0.0, 0.0))
        self.gate.give(Reset())
        decision = self.gate.give(Arm(1))
        assert decision.granted, decision.answer


@pytest.mark.parametrize(
    "hours",
    [0.25, pytest.param(2.0, marks=pytest.mark.campaign)],
    ids=["short", "two_hours"],
)
@pytest.mark.slow
def test_without_a_localiser_it_can_be_armed_again_every_five_minutes_and_drives(hours):
    robot = DeadReckoning()
    passing = 0
    for _ in range(round(hours * 3600.0 / REARMED_S)):
        robot.rearm()
        for step in range(round(REARMED_S / PERIOD_S)):
            robot.step((0.5, 0.0, 0.3 if step // 100 % 2 else -0.1))
            assert robot.gate.decision.cause is None, robot.gate.decision.cause
            passing += robot.gate.moves
    assert passing > 0.99 * hours * 3600.0 / PERIOD_S
    assert (
        robot.std.max() > 2 * 0.2
    )  # by what was counted before, it could not be armed
