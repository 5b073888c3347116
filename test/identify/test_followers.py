"""Delay, lag, dead zone and limits of states that follow commands and were not measured."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from identify.drives import MOTOR, servoed, tricycle
from nics_drl_bridge import geometry
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot.taylor import TaylorModel

SPEED = "speed_command"


@cache
def found(**given: float) -> Identified:
    return identify(servoed(steering_servo=MOTOR, steering=0.5, **given), tricycle())


def ends(identified: Identified) -> tuple[float, float]:
    """Mean error after 5 s of the model, and of the fitted textbook."""
    (five,) = (each for each in identified.judgement if each.horizon_s == 5.0)
    return five.model.position_m, five.textbook.position_m


@pytest.mark.slow
def test_a_robot_whose_motors_follow_freely_has_no_limits_and_no_dead_zone():
    model = found().model
    assert not np.isfinite(model.limits).any()
    assert not any(curve.bends for curve in model.inputs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mounting",
    [
        (0.25, 0.12, 0.5),
        pytest.param((0.0, 0.0, 0.0), marks=pytest.mark.campaign),
    ],
)
def test_a_dead_zone_of_the_speed_is_found_and_predicted(mounting):
    identified = found(dead=0.1, mounting=mounting)
    (curve,) = (each for each in identified.model.inputs if each.bends)
    assert (curve.command, curve.least, curve.most) == (SPEED, -np.inf, np.inf)
    assert curve.dead == pytest.approx(0.1, rel=0.1)
    assert (
        abs(curve.dead - 0.1)
        < 3.0 * identified.calibration.uncertainty[f"{SPEED}.dead"]
    )
    assert identified.dead_zone == curve.dead
    error, textbook = ends(identified)
    assert error < textbook  # whose offset acts like a dead zone


@pytest.mark.slow
def test_limits_of_acceleration_are_found_and_predicted():
    identified = found(slew=0.7)
    speed, steering = identified.model.limits
    assert speed == pytest.approx([-0.7, 0.7], rel=0.1)
    assert not np.isfinite(steering).any()
    assert {"speed.fall", "speed.rise"} <= set(identified.calibration.uncertainty)
    error, textbook = ends(identified)
    # The textbook has no limits; these hide a second lag, which costs the model a third.
    assert error < 0.65 * textbook
    assert "at least -0.6" in identified.model.equations()[-2]
    (kept,) = step_shares(identified.model)
    assert 0.0 <= kept < 1.0  # no state overshoots its command in a step


def step_shares(model: TaylorModel) -> list[float]:
    """What a speed keeps of itself in a step."""
    alone = [k for k, term in enumerate(model.term_names) if term == "speed"]
    return [1.0 + model.dt * model.coefficients[3, k] for k in alone]


@pytest.mark.campaign
def test_no_state_overshoots_its_command_in_a_step():
    recording = servoed(
        steering_servo=MOTOR, steering=0.5, slew=0.7, later=0.15, dead=0.1
    )
    model = identify(recording, tricycle(), order="auto", alpha="auto").model
    (kept,) = step_shares(model)
    assert 0.0 <= kept < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("slew", [0.7, pytest.param(0.4, marks=pytest.mark.campaign)])
def test_a_lag_before_a_limit_makes_the_latency_uncertain(slew):
    calibration = found(slew=slew).calibration
    off = abs(calibration.command_latency_s - 0.1)
    assert off < 3.0 * calibration.uncertainty["command_latency_s"]
    assert any("trust their sum" in note for note in calibration.notes)


@pytest.mark.slow
def test_motors_are_found_where_the_wheels_tell_the_latency_of_a_pose_on_another_clock():
    recording = servoed(
        steering_servo=MOTOR, steering=0.5, mounting=(0.0, 0.0, 0.0), slew=0.7
    )
    pose = recording.pose
    moved = geometry.log(geometry.between(pose.values[:-5], pose.values[5:]))
    twist = moved / (pose.t[5:] - pose.t[:-5])[:, None]
    both = np.stack(
        [twist[:, 0] - 0.2 * twist[:, 2], twist[:, 0] + 0.2 * twist[:, 2]], axis=1
    )
    wheels = Stream(pose.t[5::2], both[::2], "robot")
    tracked = replace(pose, t=pose.t + 3.0, clock="mocap")
    error, textbook = ends(
        identify(replace(recording, wheels=wheels, pose=tracked), tricycle())
    )
    assert error < 0.65 * textbook
