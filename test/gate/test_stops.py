from __future__ import annotations

import numpy as np
import pytest

from gate.rig import PERIOD_S, TICK_S, Rig, config
from nics_drl_bridge.gate.inputs import Reset
from nics_drl_bridge.interface import NS_PER_S


class Stamped(Rig):
    """A rig whose stamps go by a clock of their own.

    Attributes:
        pace: seconds of that clock per second.
        delay_s: by which data come late.
    """

    pace = 1.0
    delay_s = 0.0

    def send(self, without=""):
        self.stamp += round((self.pace - 1.0) * PERIOD_S * NS_PER_S)
        before = self.stamp
        self.stamp -= round(self.delay_s * NS_PER_S)
        super().send(without)
        self.stamp = before + round(PERIOD_S * NS_PER_S)


def driven(pace=1.0, **changes):
    rig = Stamped(config(**changes)).drive()
    rig.pace = pace
    return rig


@pytest.mark.parametrize(("step_s", "simulated"), [(0.35, False), (0.05, True)])
def test_stamps_that_run_ahead_of_time_latch_a_stop(step_s, simulated):
    rig = driven(pace=1.0 + step_s / PERIOD_S, simulated=simulated)
    ahead = (rig.pace - 1.0) * rig.until_stopped(20.0)
    assert rig.rule == "stamps_jumped"
    assert ahead <= 0.1 + step_s + 0.02
    rig.pace = 1.0
    rig.run(2.0)
    assert not rig.moves


@pytest.mark.slow
@pytest.mark.parametrize(
    "pace", [1.0 + 9e-4, pytest.param(1.0 - 9e-4, marks=pytest.mark.campaign)]
)
def test_clocks_that_drift_faster_than_real_ones_do_are_followed(pace):
    rig = driven(pace)
    rig.tick_s = PERIOD_S
    rig.run(120.0)  # by more than what an armed gate takes for the future
    assert rig.state.latched is None
    assert rig.decision.cause is None
    assert rig.state.scans.late[-1] < 1e-3


def test_a_delay_that_comes_and_stays_is_not_taken_for_the_new_normal():
    rig = driven()
    rig.delay_s = 0.4
    rig.run(1.0)
    known = len(rig.published)
    rig.run(10.0)
    assert not any(twist.any() for _, twist in rig.published[known:])
    rig.speed = 0.0
    assert rig.give(Reset()).granted
    rig.settle().run(0.5)  # after a reset the present is the normal
    assert rig.moves


def test_jitter_does_not_stop_the_robot():
    rng = np.random.default_rng(0)
    rig = driven()
    for _ in range(100):
        rig.delay_s = float(rng.uniform(0.0, 0.08))
        assert rig.run(PERIOD_S).cause is None


def test_a_simulator_that_falls_behind_real_time_goes_on_after_a_while():
    rig = driven(simulated=True)
    rig.stamp -= round(0.45 * NS_PER_S)
    rig.until_stopped(1.0)
    rig.run(3.0)
    assert rig.moves


@pytest.mark.parametrize("pace", [2.0, 0.6])
def test_stamps_of_another_pace_are_named_at_arming_and_let_pass_if_they_are_declared(
    pace,
):
    named = Stamped(config(rate_tolerance=0.9))
    named.pace = pace
    named.run(2.0)
    assert "clocks_agree: the stamps of scan run away" in named.arm().answer
    declared = Stamped(config(rate_tolerance=0.9, clock_rate=pace))
    declared.pace = pace
    declared.drive(2.0)


@pytest.mark.parametrize("hertz", [1000.0])
def test_odometry_of_any_rate_lets_the_gate_be_armed(hertz):
    rig = Rig(config(odom_rate=hertz))
    step = 1.0 / hertz
    for k in range(round(1.5 * hertz)):
        rig.now += step
        rig.odom(stamp_ns=rig.stamp + round(k * step * NS_PER_S))
        if k % round(hertz * TICK_S) == 0:
            rig.tick()
        if k % round(hertz * PERIOD_S) == 0:
            rig.scan(stamp_ns=rig.stamp + round(k * step * NS_PER_S))
            rig.send("scan odom command")
            rig.stamp -= round(PERIOD_S * NS_PER_S)
    assert rig.arm().granted, rig.decision.answer
    assert len(rig.state.odometries.marks) < 40
