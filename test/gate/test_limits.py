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
from nics_drl_bridge.gate.inputs import Command
from nics_drl_bridge.gate.limits import (
    Limits,
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


@pytest.mark.parametrize("robot", ["differential", "mecanum"])
def test_speeds_are_scaled_by_one_factor_so_that_the_curvature_stays(robot):
    limits = LIMITS[robot]
    command = (
        np.array([0.9, 3.0]) if robot == "differential" else np.array([1.4, -0.7, 1.0])
    )
    out = saturate(command, limits)
    assert out / out[0] == pytest.approx(command / command[0])
    assert (np.abs(out) / limits.high).max() == pytest.approx(1.0)


def test_a_car_keeps_its_steering_when_its_speed_is_cut():
    assert saturate(np.array([3.0, 0.2]), LIMITS["ackermann"]).tolist() == [1.0, 0.2]
    assert saturate(np.array([0.5, 0.9]), LIMITS["ackermann"]).tolist() == [0.5, 0.5]


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


def test_a_robot_that_speeds_up_is_on_its_curve_from_the_start():
    limits = LIMITS["differential"]
    wish = np.array([0.8, 0.8])
    value = slope = np.zeros(2)
    for _ in range(30):
        value, slope = follow(value, slope, wish, 0.02, limits)
        assert value[1] == pytest.approx(value[0], rel=0.2)


def test_the_gate_speeds_up_within_rate_and_jerk_and_cuts_what_is_too_fast():
    rig = Rig()
    rig.wish = np.array([5.0, 0.0, 0.9])
    rig.run(1.5)
    assert rig.arm().granted
    rig.run(0.6)
    rig.speed = 1.0
    rig.run(0.5)
    assert rig.decision.twist.tolist() == [1.0, 0.0, 0.5]
    moving = np.array([(time, *twist) for time, twist in rig.published])
    dt = np.diff(moving[:, 0])
    change = np.diff(moving[:, [1, 3]], axis=0)
    assert (
        np.abs(change) <= np.array([2.0, 4.0]) * dt[:, None] * (1 + TOLERANCE)
    ).all()
    jerk = np.abs(np.diff(change / dt[:, None], axis=0)) / dt[1:, None]
    assert (jerk <= np.array([40.0, 80.0]) * (1 + TOLERANCE)).all()


def test_a_motion_too_soon_after_the_last_is_not_published():
    rig = driving()
    rig.wish = np.array([0.1, 0.0, 0.0])
    rig.command()
    rig.now += 1e-4
    assert not rig.tick().publish
    assert rig.decision.twist.any()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            ("robot: ackermann", "robot: car"),
            "the limits are for 'car', not for 'ackermann'",
        ),
        (
            ("speed_command:", "sped_command:"),
            "'commands.sped_command'; did you mean 'speed_comm",
        ),
        (("rate: 2.0, ", ""), "the key 'commands.speed_command.rate' is missing"),
        ((", jerk: 40.0", ""), "the key 'commands.speed_command.jerk' is missing"),
        (("max: 1.0", "max: .inf"), "finite"),
        (("rate: 2.0", "rate: 0.0"), "greater than 0"),
        (("min: -0.5, max: 1.0", "min: 0.0, max: 0.0"), "min must be less than max"),
        (("min: -0.5, max: 1.0", "min: 0.2, max: 1.0"), "less than or equal to 0"),
        (
            ("jerk: 40.0}", "jerk: 40.0, snap: 1.0}"),
            "unknown key 'commands.speed_command.snap'",
        ),
        (
            ("max: 1.0", "max: 10.0"),
            "'commands.speed_command.max': 10 m/s is beyond the robot's own",
        ),
        (
            ("min: -0.5, max: 1.0", "min: -0.6, max: 1.0"),
            "'commands.speed_command.min': -0.6 m/s is beyond the robot's",
        ),
        (("max: 0.5", "max: 0.51"), "give at most 0.5"),
        (
            ("rate: 2.0", "rate: 1e308"),
            "within a period of the gate, 0.02 s, and limits nothing",
        ),
        (("rate: 2.0", "rate: 76.0"), "give at most 75"),
        (
            ("jerk: 40.0", "jerk: 1e308"),
            "'commands.speed_command.jerk': 1e+308 m/s/s^2 crosses",
        ),
        (
            ("rate: 2.0", "rate: 1e-4"),
            "'commands.speed_command.rate': 0.0001 would never let it",
        ),
        (
            ("jerk: 80.0", "jerk: 1e-300"),
            "'commands.steering_command.jerk': 1e-300 would never",
        ),
        (
            ("min: -0.5, max: 1.0", "min: -0.001, max: 0.001"),
            "the robot could never move: none of its speeds",
        ),
    ],
)
def test_a_wrong_file_of_limits_is_one_sentence(tmp_path, change, sentence):
    text = find_config("ackermann", "limits").read_text(encoding="utf-8")
    path = tmp_path / "limits.yaml"
    assert change[0] in text
    path.write_text(text.replace(*change, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        load_limits(str(path), load_robot("ackermann"))


def test_limits_that_leave_a_command_out_are_refused(tmp_path):
    text = find_config("ackermann", "limits").read_text(encoding="utf-8")
    path = tmp_path / "limits.yaml"
    kept = [line for line in text.splitlines() if "steering_command" not in line]
    path.write_text("\n".join(kept), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"'commands\.steering_command' is missing"):
        load_limits(str(path), load_robot("ackermann"))


def test_without_limits_nothing_is_armed():
    rig = Rig(config(limits=None))
    rig.run(1.5)
    assert not rig.arm().granted
    assert (
        rig.decision.answer
        == "limits_set: no limits are set, name their file in `limits`"
    )


@pytest.mark.parametrize(
    ("wish", "speed", "turn"),
    [(2.0, 1.0, 0.5), (0.5, 0.25, 2.0)],
    ids=["too fast", "turns too fast"],
)
def test_the_gate_cuts_what_is_too_much_and_keeps_the_curve(wish, speed, turn):
    rig = Rig(config("differential"))
    rig.wish = np.array([wish, 0.0, wish * turn / speed])
    rig.run(1.5)
    assert rig.arm().granted
    rig.run(0.4)
    rig.speed = speed
    rig.run(1.0)
    assert rig.decision.twist == pytest.approx([speed, 0.0, turn])


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


@settings(max_examples=25, deadline=None)
@given(limits=absurd_limits(), wish=st.tuples(TWIST, TWIST), dt=st.floats(1e-3, 0.2))
def test_a_gate_with_absurd_limits_publishes_numbers_within_them(limits, wish, dt):
    rig = Rig(config("differential", limits=limits))
    rig.run(1.5)
    assert rig.arm().granted
    with np.errstate(all="ignore"):
        for _ in range(4):
            rig.give(
                Command(
                    rig.state.scans.stamps_ns[-1], np.array([wish[0], 0.0, wish[1]])
                )
            )
            rig.now += dt
            value = rig.tick().twist[[0, 2]]
            assert is_within(value, limits)


@pytest.mark.parametrize("jerk", [1e308, 1e300, 1e16])
def test_a_jerk_beyond_all_bounds_lets_a_command_pass_within_its_rate(jerk):
    shipped = LIMITS["ackermann"]
    rig = Rig(config(limits=replace(shipped, jerk=np.full(2, jerk))))
    rig.drive(0.1)
    assert rig.decision.twist[0] > 0.0
    assert all(np.isfinite(twist).all() for _, twist in rig.published)


def test_limits_of_a_period_are_let_through_and_those_of_the_robot_itself(tmp_path):
    text = find_config("ackermann", "limits").read_text(encoding="utf-8")
    path = tmp_path / "limits.yaml"
    path.write_text(text.replace("rate: 2.0, jerk: 40.0", "rate: 50.0, jerk: 2500.0"))
    assert load_limits(str(path), load_robot("ackermann")).jerk[0] == 2500.0


def test_a_motion_that_is_no_number_after_all_is_a_zero_that_stays(monkeypatch):
    rig = driving()

    def broken(config, state, motion, now):
        return replace(motion, value=np.array([np.nan, 0.0]))

    shapers = gate.SHAPERS
    monkeypatch.setattr(gate, "SHAPERS", (*shapers[:-1], broken, shapers[-1]))
    decision = rig.run(TICK_S)
    assert (rig.rule, decision.publish, decision.twist.tolist()) == (
        "motion_unfit",
        True,
        [0.0] * 3,
    )
    monkeypatch.setattr(gate, "SHAPERS", shapers)
    rig.run(1.0)
    assert rig.rule == "motion_unfit"
    assert not rig.moves


@pytest.mark.parametrize("far", [1.1, -0.6, np.inf])
def test_a_motion_beyond_its_limits_after_all_is_a_zero(monkeypatch, far):
    rig = driving()

    def broken(config, state, motion, now):
        return replace(motion, value=np.array([far, 0.0]))

    monkeypatch.setattr(gate, "SHAPERS", (broken, gate.SHAPERS[-1]))
    assert not rig.run(TICK_S).twist.any()
    assert rig.rule == "motion_unfit"


@pytest.mark.parametrize("speed", [1e-310, -1e-310, 5e-324])
def test_a_denormal_speed_is_exactly_zero(speed):
    limits = LIMITS["differential"]
    assert not saturate(np.array([speed, speed]), limits).any()
    for settings_of_gate in (config(), config(bicycle=Bicycle(0.2))):
        rig = Rig(settings_of_gate).drive()
        rig.wish = np.array([speed, 0.0, speed])
        rig.speed = 0.0
        rig.run(2.0)
        assert rig.decision.publish
        assert rig.decision.cause is None
        assert not rig.decision.twist.any()
        assert rig.state.value[0] == 0.0


def test_a_denormal_that_the_shield_leaves_of_a_speed_is_exactly_zero(monkeypatch):
    def leave(_, state, motion, now):
        return replace(motion, value=np.full_like(motion.value, 1e-310))

    rig = driving()
    monkeypatch.setattr(gate, "SHAPERS", (*gate.SHAPERS[:-1], leave, gate.bound))
    rig.speed = 0.0
    rig.run(0.1)
    assert rig.decision.publish
    assert not rig.decision.twist.any()
