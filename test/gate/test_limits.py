from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gate.rig import TICK_S, Rig, config, driving
from nics_drl_bridge.config import find_config, list_shipped
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import gate
from nics_drl_bridge.gate.limits import (
    Limits,
    flush_denormals,
    follow,
    is_implausible,
    is_within,
    load_limits,
    saturate,
)
from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.robot.spec import load_robot

ROBOTS = list_shipped("limits")
LIMITS = {robot: load_limits(robot, load_robot(robot)) for robot in ROBOTS}
TOLERANCE = 1e-6
WISH = st.floats(-3.0, 3.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("robot", ["differential", "mecanum"])
def test_speeds_are_scaled_by_one_factor_so_that_the_curvature_stays(robot, sign):
    limits = replace(LIMITS[robot], low=-0.5 * LIMITS[robot].high)
    command = (
        np.array([0.9, 3.0]) if robot == "differential" else np.array([1.4, -0.7, 1.0])
    )
    out = saturate(sign * command, limits)
    assert out / out[0] == pytest.approx(command / command[0])
    bounds = np.where(out > 0.0, limits.high, limits.low)
    assert (out / bounds).max() == pytest.approx(1.0)


def test_what_a_robot_can_not_do_at_all_is_dropped_and_the_rest_stays():
    forwards = replace(LIMITS["differential"], low=np.array([0.0, -2.0]))
    assert saturate(np.array([-1e-9, 1.0]), forwards).tolist() == [0.0, 1.0]


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_command_within_the_limits_stays_as_it_is(robot):
    limits = LIMITS[robot]
    command = limits.low + 0.6 * (limits.high - limits.low)
    assert saturate(command, limits).tolist() == command.tolist()
    assert not is_implausible(command, limits)


@settings(max_examples=30, deadline=None)
@given(
    robot=st.sampled_from(ROBOTS),
    steps=st.lists(
        st.tuples(WISH, WISH, WISH, st.floats(1e-3, 0.2)), min_size=5, max_size=60
    ),
)
def test_no_wish_at_any_interval_exceeds_speed_rate_or_jerk(robot, steps):
    limits = LIMITS[robot]
    size = len(limits.low)
    value = np.zeros(size)
    slope = np.zeros(size)
    last_change = np.zeros(size)
    for *wish, dt in steps:
        before = value
        value, slope = follow(
            value, slope, saturate(np.array(wish[:size]), limits), dt, limits
        )
        change = (value - before) / dt
        assert (value <= limits.high).all()
        assert (value >= limits.low).all()
        assert (np.abs(change) <= limits.rate * (1 + TOLERANCE)).all()
        assert (
            np.abs(change - last_change) <= limits.jerk * dt * (1 + TOLERANCE) + 1e-9
        ).all()
        last_change = change


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_wish_that_lasts_is_reached_exactly_and_never_overshot(robot):
    limits = LIMITS[robot]
    wish = limits.low + 0.75 * (limits.high - limits.low)
    value = slope = np.zeros(len(wish))
    for _ in range(200):
        value, slope = follow(value, slope, wish, 0.02, limits)
        assert (np.sign(wish) * value <= np.sign(wish) * wish).all()
    assert value.tolist() == wish.tolist()
    assert np.abs(slope).max() < 1e-6


def test_a_motion_too_soon_after_the_last_is_not_published():
    rig = driving()
    rig.wish = np.array([0.1, 0.0, 0.0])
    rig.command()
    rig.now += 1e-4
    assert not rig.tick().publish
    assert rig.decision.twist.any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("robot: ackermann", "robot: car"), "key 'robot'"),
        (("speed_command:", "sped_command:"), "'commands.sped_command'"),
        (("  steering_command:", "  # "), "'commands.steering_command'"),
        (("rate: 2.0, ", ""), "'commands.speed_command.rate'"),
        (("max: 1.0", "max: .inf"), "'commands.speed_command.max'"),
        (("rate: 2.0", "rate: 0.0"), "'commands.speed_command.rate'"),
        (("min: -0.5, max: 1.0", "min: 0.0, max: 0.0"), "min must be less than max"),
        (("min: -0.5, max: 1.0", "min: 0.2, max: 1.0"), "speed_command.min'"),
        (("jerk: 40.0}", "jerk: 40.0, snap: 1.0}"), "speed_command.snap'"),
        (("max: 1.0", "max: 10.0"), "speed_command.max': 10 m/s"),
        (("min: -0.5", "min: -0.6"), "speed_command.min': -0.6 m/s"),
        (("max: 0.5", "max: 0.51"), "give at most 0.5"),
        (("rate: 2.0", "rate: 76.0"), "give at most 75"),
        (("jerk: 40.0", "jerk: 3751.0"), "give at most 3750"),
        (("rate: 2.0", "rate: 9e-4"), "speed_command.rate': 0.0009"),
        (("jerk: 80.0", "jerk: 9e-5"), "steering_command.jerk': 9e-05"),
        (("min: -0.5, max: 1.0", "min: -0.001, max: 0.0099"), "could never move"),
        (("rate: 2.0, jerk: 40.0", "rate: 75.0, jerk: 3750.0"), ""),
        (("rate: 2.0, jerk: 40.0", "rate: 0.001, jerk: 2e-4"), ""),
        (("min: -0.5, max: 1.0", "min: -0.001, max: 0.01"), ""),
    ],
)
def test_a_file_of_limits_is_refused_for_the_key_that_is_wrong(tmp_path, change, words):
    text = find_config("ackermann", "limits").read_text(encoding="utf-8")
    path = tmp_path / "limits.yaml"
    assert change[0] in text
    path.write_text(text.replace(*change, 1), encoding="utf-8")
    if not words:
        load_limits(str(path), load_robot("ackermann"))
        return
    with pytest.raises(ConfigError, match=re.escape(words)) as told:
        load_limits(str(path), load_robot("ackermann"))
    assert str(path) in str(told.value)


ABSURD = st.floats(1e-308, 1e308)
TWIST = st.floats(-1.8e308, 1.8e308)


@st.composite
def absurd_limits(draw):
    """Limits of two commands that no file would be let through with."""
    pairs = [[draw(ABSURD) for _ in range(2)] for _ in range(4)]
    low, high, rate, jerk = (np.array(pair) for pair in pairs)
    kinds = np.array([True, False]), np.array([False, draw(st.booleans())])
    return Limits(-low, high, rate, jerk, *kinds)


@settings(max_examples=120, deadline=None)
@given(
    limits=absurd_limits(),
    steps=st.lists(
        st.tuples(TWIST, TWIST, ABSURD | st.floats(1e-3, 0.2)), min_size=1, max_size=8
    ),
)
def test_whatever_the_limits_the_wish_and_the_interval_what_follows_is_a_number_within(
    limits, steps
):
    value = np.zeros(2)
    slope = np.zeros(2)
    with np.errstate(all="ignore"):
        for *wish, dt in steps:
            value, slope = follow(
                value, slope, saturate(np.array(wish), limits), dt, limits
            )
            assert is_within(value, limits)
            assert np.isfinite(slope).all()


@pytest.mark.parametrize("value", [np.nan, 1.1, -0.6, np.inf])
def test_a_motion_that_is_unfit_after_all_is_a_zero_that_stays(monkeypatch, value):
    rig = driving()

    def broken(config, state, motion, now):
        return replace(motion, value=np.array([value, 0.0]))

    with monkeypatch.context() as patch:
        patch.setattr(gate, "SHAPERS", (broken, gate.bound))
        decision = rig.run(TICK_S)
    assert rig.rule == "motion_unfit"
    assert decision.publish
    assert not rig.moves
    assert rig.state.latched == decision.cause


@pytest.mark.parametrize("speed", [1e-310, -5e-324])
@pytest.mark.parametrize("bicycle", [None, Bicycle(0.2)])
def test_a_denormal_speed_is_exactly_zero(speed, bicycle):
    assert not saturate(np.array([speed, speed]), LIMITS["differential"]).any()
    rig = Rig(config(bicycle=bicycle)).drive()
    rig.wish = np.array([speed, 0.0, speed])
    rig.speed = 0.0
    rig.run(2.0)
    assert (rig.decision.publish, rig.decision.cause) == (True, None)
    assert not rig.decision.twist.any()
    assert rig.state.value[0] == 0.0


def test_only_numbers_that_have_lost_digits_count_as_zero():
    tiny = float(np.finfo(np.float64).tiny)
    values = np.array([tiny, tiny / 2.0, -tiny, -tiny / 2.0])
    assert flush_denormals(values).tolist() == [tiny, 0.0, -tiny, 0.0]


def test_a_command_of_ten_times_its_limit_is_still_plausible():
    limits = LIMITS["ackermann"]
    assert not is_implausible(10.0 * limits.high, limits)
    assert is_implausible(10.1 * limits.high, limits)
