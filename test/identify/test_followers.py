"""Delay, lag, dead zone and limits of states that follow commands and were not measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import MOTOR, fit_trial, fit_whole, servoed, tricycle
from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import SEPARABLE_S
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.taylor import TaylorModel

SPEED = "speed_command"
SUM = "command_latency_and_speed_lag_s"
MOUNTED = (0.25, 0.12, 0.5)


def ends(identified: Identified) -> tuple[float, float]:
    """Mean error after 5 s of the model, and of the fitted textbook."""
    (five,) = (each for each in identified.judgement if each.horizon_s == 5.0)
    return five.model.position_m, five.textbook.position_m


def off(calibration: Calibration, mounting: tuple[float, float, float]) -> np.ndarray:
    """Errors of the mounting in its own standard errors."""
    x, y, heading = mounting
    names = ("lever_arm_x_m", "lever_arm_y_m", "rotation_rad")
    sigma = [max(calibration.uncertainty[name], 1e-4) for name in names]
    found = np.array([*calibration.lever_arm_m, calibration.rotation_rad])
    return (found - [x, y, -heading]) / sigma


@pytest.fixture(scope="module")
def found() -> Identified:
    """A tricycle that steers far, by a motor and a servo of second order."""
    return fit_trial(servoed(mounting=MOUNTED, duration=36.0), tricycle(), alpha="auto")


@pytest.mark.slow
def test_a_tricycle_that_steers_far_gets_its_order_and_mounting_by_itself(found):
    assert [trial.order for trial in found.findings.trials] == [0, 2, 3, 4]
    assert found.model.powers.sum(axis=1).max() >= 3
    held_out = found.held_out
    assert held_out.mean_position_error_m < 0.02 * held_out.mean_path_m
    assert np.abs(off(found.calibration, MOUNTED)).max() < 3.0


@pytest.mark.slow
def test_a_servo_of_second_order_is_taken_for_no_latency_limit_or_dead_zone(found):
    calibration = found.calibration
    assert calibration.command_latency_s == pytest.approx(0.1, abs=0.003)
    assert calibration.uncertainty["command_latency_s"] < SEPARABLE_S
    speed, steering = calibration.responses
    assert speed.lag_s == pytest.approx(0.15, abs=0.005)
    (curve,) = calibration.inputs  # a part of its lag looks like a delay
    assert (curve.command, curve.bends) == (steering.command, False)
    total = curve.delay + steering.lag_s
    assert total == pytest.approx(22.0 / 180.0, abs=0.015)  # damping by stiffness
    assert SUM not in calibration.uncertainty
    assert not np.isfinite(found.model.limits).any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_dead_zone_is_found_and_predicted_and_not_taken_for_a_mounting(seed):
    recording = servoed(seed, steering=0.5, steering_servo=MOTOR, dead=0.1)
    identified = fit_trial(recording, tricycle())
    calibration = identified.calibration
    (curve,) = (each for each in identified.model.inputs if each.bends)
    assert (curve.command, curve.least, curve.most) == (SPEED, -np.inf, np.inf)
    assert curve.dead == pytest.approx(0.1, rel=0.1)
    assert abs(curve.dead - 0.1) < 3.0 * calibration.uncertainty[f"{SPEED}.dead"]
    error, textbook = ends(identified)
    assert error < textbook  # whose offset acts like a dead zone
    assert np.abs(off(calibration, (0.0, 0.0, 0.0))).max() < 3.0
    assert calibration.rotation_rad == pytest.approx(0.0, abs=0.003)


@pytest.mark.slow
def test_a_command_that_acts_later_than_the_others_has_a_delay():
    recording = servoed(
        duration=24.0,
        mounting=MOUNTED,
        steering=0.5,
        steering_servo=MOTOR,
        later=0.12,
    )
    found = fit_whole(recording, tricycle()).calibration
    assert found.command_latency_s == pytest.approx(0.1, abs=0.003)
    (curve,) = found.inputs
    assert curve.command == "steering_command"
    assert curve.delay == pytest.approx(0.12, abs=0.005)
    assert abs(curve.delay - 0.12) < 3.0 * found.uncertainty["steering_command.delay"]
    assert [r.lag_s for r in found.responses] == pytest.approx([0.15, 0.15], abs=0.01)


def add_wheels(recording: Recording) -> Recording:
    """Adds wheels by the motion of a pose at the centre, whose clock is then 3 s ahead."""
    pose = recording.pose
    moved = geometry.log(geometry.between(pose.values[:-5], pose.values[5:]))
    twist = moved / (pose.t[5:] - pose.t[:-5])[:, None]
    both = twist[:, :1] + twist[:, 2:] * [-0.2, 0.2]
    wheels = Stream(pose.t[5::2], both[::2], "robot")
    tracked = replace(pose, t=pose.t + 3.0, clock="mocap")
    return replace(recording, wheels=wheels, pose=tracked)


@pytest.mark.slow
def test_limits_of_acceleration_are_found_where_wheels_tell_the_pose_of_another_clock():
    recording = servoed(duration=36.0, steering_servo=MOTOR, steering=0.5, slew=0.7)
    identified = fit_trial(add_wheels(recording), tricycle())
    speed, steering = identified.model.limits
    assert speed == pytest.approx([-0.7, 0.7], rel=0.1)
    assert not np.isfinite(steering).any()
    assert {"speed.fall", "speed.rise"} <= set(identified.calibration.uncertainty)
    error, textbook = ends(identified)
    # The textbook has no limits; these hide a second lag, which costs the model a third.
    assert error < 0.65 * textbook
    assert "at least -0.6" in identified.model.equations()[-2]
    check_steps(identified.model)


def check_steps(model: TaylorModel) -> None:
    """Asserts that no speed overshoots its command in a step."""
    (alone,) = np.flatnonzero(np.array(model.term_names) == "speed")
    assert 0.0 <= 1.0 + model.dt * model.coefficients[3, alone] < 1.0


@pytest.mark.campaign
def test_no_state_overshoots_its_command_in_a_step():
    recording = servoed(
        mounting=MOUNTED,
        steering_servo=MOTOR,
        steering=0.5,
        slew=0.7,
        later=0.15,
        dead=0.1,
    )
    found = identify(recording, tricycle(), order="auto", alpha="auto")
    check_steps(found.model)


@pytest.mark.campaign
@pytest.mark.parametrize("slew", [0.7, 0.4])
def test_a_lag_before_a_limit_makes_the_latency_uncertain(slew):
    recording = servoed(mounting=MOUNTED, steering_servo=MOTOR, steering=0.5, slew=slew)
    calibration = identify(recording, tricycle()).calibration
    error = abs(calibration.command_latency_s - 0.1)
    assert error < 3.0 * calibration.uncertainty["command_latency_s"]
    assert any("trust their sum" in note for note in calibration.notes)
