from __future__ import annotations

import numpy as np
import pytest

from gate.rig import TICK_S, Rig, config, driving
from nics_drl_bridge.gate.inputs import (
    Command,
    EStop,
    Odometry,
    Press,
    Reset,
    Scan,
    Tick,
)
from nics_drl_bridge.gate.stops import FROZEN_INPUTS
from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.interface import NS_PER_S

WITHIN_S = 0.40


def test_an_optional_e_stop_that_was_heard_and_falls_silent_counts_as_pressed():
    rig = Rig(config(e_stop_required=False))
    rig.run(2.0, without="e_stop")
    assert rig.arm().granted
    rig.speed = 0.5
    rig.run(1.0, without="e_stop")
    assert rig.moves  # none was ever heard
    rig.run(0.5)
    rig.until_stopped(WITHIN_S, without="e_stop")
    rig.speed = 0.0
    rig.run(2.0)
    assert rig.rule == "e_stop_silent"
    rig.run(1.0, without="e_stop")
    assert rig.give(Reset()).granted
    assert "e_stop_silent" in rig.arm().answer


def test_an_e_stop_stops_at_once_until_it_is_released_reset_and_armed():
    rig = driving()
    assert rig.give(EStop(True)).publish
    assert not rig.moves
    assert not rig.give(Reset()).granted
    assert "still pressed" in rig.decision.answer
    rig.speed = 0.0
    rig.run(2.0)
    assert rig.rule == "e_stop_pressed"
    assert rig.give(Reset()).granted
    rig.run(2.0)
    assert rig.rule == "disarmed"
    assert not rig.moves
    assert rig.arm().granted
    rig.run(0.5)
    assert rig.moves
    rig.give(Press())
    rig.run(1.0)  # its topic says that it is released
    assert rig.rule == "e_stop_pressed"
    assert rig.give(Reset()).granted


def test_a_press_by_a_call_is_no_heartbeat():
    rig = Rig()
    rig.run(1.5, without="e_stop")
    rig.give(Press())
    rig.give(Reset())
    assert "e_stop_silent" in rig.arm().answer


def test_before_the_first_command_nothing_moves():
    rig = Rig()
    rig.run(1.5, without="command")
    assert rig.arm().granted
    rig.run(0.2, without="command")
    assert rig.rule == "command_missing"


def test_a_republisher_does_not_hide_a_policy_that_hangs():
    rig = driving()
    stamp = rig.stamp
    began = rig.now
    while rig.moves:
        rig.now += TICK_S
        rig.stamp += 20_000_000
        rig.odom()
        rig.scan()
        rig.give(EStop(False))
        rig.command(stamp=stamp)
        rig.tick()
        assert rig.now - began < WITHIN_S
    assert rig.rule == "scan_behind_old"


def test_a_command_that_overtakes_its_scan_waits_for_it():
    rig = driving()
    rig.run(0.06, without="scan command")
    rig.stamp += 1
    arrival_s = rig.now
    rig.command([0.3, 0.0, 0.0])
    rig.now += TICK_S
    assert rig.tick().cause is None
    assert rig.state.command.twist[0] == 0.5
    rig.scan()
    assert rig.state.command.twist[0] == 0.3
    assert (rig.state.pending, rig.state.command_s) == (None, arrival_s)
    rig.stamp += 1
    rig.command([0.4, 0.0, 0.0])
    rig.command([np.nan, 0.0, 0.0])
    rig.scan()  # does not undo the malformed one
    assert rig.rule == "command_malformed"
    assert rig.state.command.twist[0] == 0.3
    rig.command([0.2, 0.0, 0.0])
    rig.now += TICK_S
    assert rig.tick().cause is None


@pytest.mark.parametrize(
    ("twist", "words"),
    [
        ([np.nan, 0.0, 0.1], "NaN or inf"),
        ([0.5, -np.inf, 0.1], "NaN or inf"),
        ([0.5, 0.0, np.inf], "NaN or inf"),
        ([-1e300, 0.0, 0.0], "far out of range"),
        ([0.5, 0.0, 50.0], "far out of range"),
    ],
)
def test_a_broken_command_stops_the_robot_at_once_and_feeds_no_watchdog(twist, words):
    rig = driving()
    before = rig.state.command_s
    rig.now += TICK_S
    assert words in rig.command(twist).refused
    assert rig.rule == "command_malformed"
    assert rig.decision.publish
    assert not rig.moves
    assert rig.state.command_s == before


@pytest.mark.parametrize(
    ("topic", "changes"),
    [
        ("scan", {"ranges": np.ones(7, np.float32)}),
        ("scan", {"ranges": np.full(720, np.nan, np.float32)}),
        ("scan", {"angles": (0.0, 2 * np.pi / 720)}),
        ("scan", {"angles": (-np.pi, 0.5)}),
        ("scan", {"angles": (np.nan, np.nan)}),
        ("odom", {"pose": np.array([np.nan, 0.0, 0.0])}),
        ("odom", {"twist": np.array([0.0, np.inf, 0.0])}),
        ("odom", {"twist": np.array([1e6, 0.0, 0.0])}),
        ("scan", {"stamp_ns": 0}),  # that of the newest
        ("odom", {"stamp_ns": 0}),
    ],
)
def test_data_that_are_none_of_this_robot_are_refused_and_feed_no_watchdog(
    topic, changes
):
    rig = driving()
    rig.now += TICK_S
    rig.stamp += 1
    before = (rig.state.scans, rig.state.odometries)
    if "stamp_ns" in changes:
        changes = {"stamp_ns": rig.stamp - 1}
    assert getattr(rig, topic)(**changes).refused
    assert (rig.state.scans, rig.state.odometries) == before


@pytest.mark.parametrize("jump_s", [3600.0, 10.0, 0.8, -10.0, -3600.0])
@pytest.mark.parametrize("topic", ["scan", "odom"])
def test_stamps_that_jump_latch_a_stop(jump_s, topic):
    rig = driving()
    rig.now += TICK_S
    getattr(rig, topic)(stamp_ns=rig.stamp + round(jump_s * NS_PER_S))
    assert (rig.rule, rig.decision.cause.topic) == ("stamps_jumped", topic)
    assert rig.state.latched is not None


@pytest.mark.parametrize("now", [np.nan, np.inf, -np.inf, 0.0, 99.0])
def test_a_clock_that_tells_nonsense_or_runs_back_stops_the_robot(now):
    rig = driving()
    assert rig.give(Tick(), now).cause.rule == "own_clock"
    assert not rig.moves


def test_a_clock_that_stands_still_for_twenty_inputs_stops_the_robot():
    rig = driving()
    stopped = [rig.tick().cause is not None for _ in range(FROZEN_INPUTS)]
    assert stopped == [False] * (FROZEN_INPUTS - 1) + [True]


@pytest.mark.parametrize("first", ["scan", "odom", "command", "e_stop", "tick"])
def test_the_first_word_of_a_gate_that_was_asleep_is_a_zero_whatever_wakes_it(first):
    rig = driving()
    rig.now += 0.25
    rig.stamp += round(0.05 * NS_PER_S)
    known = len(rig.published)
    inputs = {
        "scan": rig.scan,
        "odom": rig.odom,
        "command": rig.command,
        "tick": rig.tick,
        "e_stop": lambda: rig.give(EStop(False)),
    }
    assert inputs[first]().cause.rule == "own_clock"
    assert len(rig.published) == known + 1
    assert not rig.published[-1][1].any()
    rig.speed = 0.0
    rig.run(0.18)  # for one zero may be lost
    assert not rig.moves
    rig.run(0.5)
    assert rig.moves


@pytest.mark.parametrize("simulated", [False, True])
def test_data_that_queued_up_while_the_gate_was_asleep_latch_nothing(simulated):
    """The first of them are late, but not because the simulator lost time."""
    rig = driving(simulated=simulated)
    slept = 10
    rig.now += 0.1 * slept
    before = rig.stamp
    for queued in range(5):
        rig.stamp = before + (slept - 4 + queued) * NS_PER_S // 10
        rig.odom()
        rig.scan()
    rig.give(EStop(False))
    rig.command()
    assert rig.tick().cause.rule == "own_clock"
    assert rig.state.latched is None
    rig.speed = 0.0
    assert rig.run(0.5).cause is None


def test_identical_scans_of_a_robot_that_stands_still_are_fine():
    rig = Rig()
    rig.wish = np.zeros(3)
    rig.frozen = True
    rig.run(2.0)
    assert rig.arm().granted
    rig.run(3.0)
    assert rig.decision.cause is None


def test_odometry_whose_noise_looks_like_motion_does_not_hide_a_robot_that_is_stuck():
    rng, rig = np.random.default_rng(0), driving()
    rig.speed = 0.0
    odom = rig.odom
    rig.odom = lambda: odom(twist=rng.normal(scale=0.05, size=3))
    rig.until_stopped(2.1)
    assert rig.rule == "no_motion"


def test_a_robot_that_wags_need_not_get_anywhere():
    rig = Rig(config("differential"))
    rig.wish = np.array([0.0, 0.0, 1.0])
    rig.settle()
    for _ in range(20):
        rig.wish = -rig.wish
        assert rig.run(0.2).cause is None


def test_a_car_that_only_steers_need_not_move():
    rig = Rig()
    rig.wish = np.array([0.0, 0.0, 0.3])
    rig.run(2.0)
    assert rig.arm().granted
    assert rig.run(3.0).cause is None
    assert rig.moves


def test_only_a_tick_publishes_a_motion():
    rig = driving()
    for event in (Command(rig.stamp, rig.wish), EStop(False)):
        assert not rig.give(event).publish


def test_a_scan_that_arrives_late_is_as_old_as_it_is():
    rig = driving()
    rig.run(0.3, without="scan command")
    rig.scan(stamp_ns=rig.stamp - round(0.3 * NS_PER_S) + 1)  # held back for 0.3 s
    rig.command(stamp=rig.state.scans.stamps_ns[-1])
    rig.run(0.08, without="scan command")
    assert rig.rule == "scan_silent"


def test_a_car_that_takes_turn_rates_is_limited_by_its_steering_angle():
    rig = Rig(config(bicycle=Bicycle(0.2)))
    rig.wish = np.array([0.5, 0.0, 0.3])
    rig.drive()
    assert rig.decision.twist.tolist() == pytest.approx([0.5, 0.0, 0.3])
    assert rig.state.value.tolist() == pytest.approx([0.5, np.arctan(0.2 * 0.3 / 0.5)])
    rig.wish = np.array([0.5, 0.0, 30.0])
    rig.run(2.0)
    assert rig.decision.twist[2] == pytest.approx(
        0.5 * np.tan(rig.config.limits.high[1]) / 0.2
    )


def test_whatever_comes_in_what_goes_out_is_finite_within_limits_and_zero_when_stopped():
    rng = np.random.default_rng(0)
    odd = np.array([np.nan, np.inf, -np.inf, 1e308, 5e-324, 0.0, -1.0, 0.3])
    for _ in range(4):
        rig = driving()
        low = rig.config.limits.low
        high = rig.config.limits.high
        for _ in range(150):
            rig.run(TICK_S, without=str(rng.choice(["", "scan", "odom", "command"])))
            stamp = int(rng.choice([rig.stamp, 0, -1, rig.stamp + 10**12]))
            twist = np.where(
                rng.random(3) < 0.2, rng.choice(odd, 3), rng.normal(size=3)
            )
            event = [
                Command(stamp, twist),
                Scan(
                    stamp,
                    rng.choice(odd[odd < 1e30], 720).astype(np.float32),
                    (-np.pi, np.pi / 360),
                ),
                Odometry(stamp, twist, twist),
                Tick(),
            ][rng.integers(4)]
            now = float(rng.choice([rig.now, np.nan, 0.0], p=[0.9, 0.05, 0.05]))
            decision = rig.give(event, now)
            value = decision.twist[list(rig.config.fields)]
            assert np.isfinite(decision.twist).all()
            assert (value >= low).all()
            assert (value <= high).all()
            assert decision.twist[1] == 0.0
            if decision.cause is not None:
                assert not decision.twist.any()
