from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from identify.drives import NOISE, add_wheels, calibrate, drive
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.alignment import align, find_dividing_step
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.recording.recording import samples_on_one_clock
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import load_robot


@pytest.mark.parametrize(
    ("step", "part"),
    [
        (0.01, 0.01),
        (0.0100036, 0.01),
        (0.0083, 0.1 / 12),
        (0.05, 0.05),
        (0.07, 0.1),
        (0.2, 0.1),
    ],
)
def test_a_step_becomes_a_part_of_the_control_period(step, part):
    assert find_dividing_step(0.1, step) == part


def test_stamps_that_were_rounded_are_taken_as_they_are(car):
    late = drive(car, duration=10.0)
    streams = {
        name: replace(getattr(late, name), t=getattr(late, name).t + 1.7e9)
        for name in ("pose", "state", "command")
    }
    samples = align(Drive(replace(late, **streams), car), Calibration())
    assert samples.dt == 0.01
    assert np.array_equal(samples.q[:, :3], late.pose.values[: len(samples.t)])


@pytest.mark.parametrize("measured", [True, False])
def test_stamps_whose_step_is_no_part_of_the_control_period_are_resampled(
    car, measured
):
    recording = record(car, np.random.default_rng(0), 20.0, 0.0083)
    recording = recording if measured else replace(recording, state=None)
    responses = () if measured else (Response("speed", "speed_command", 0.1),) * 2
    samples = align(Drive(recording, car), Calibration(responses=responses))
    assert samples.dt == 0.1 / 12
    assert np.diff(samples.t) == pytest.approx(samples.dt)


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_a_textbook_recording_needs_no_correction_and_is_taken_digit_by_digit(name):
    spec = load_robot(name)
    recording = drive(spec, duration=30.0)
    calibration = calibrate(recording, spec)
    assert calibration.is_exact
    samples = align(Drive(recording, spec), calibration)
    r = recording
    plain = samples_on_one_clock(
        r.pose.t, r.pose.values, r.state.values, r.command.values
    )
    for field in ("t", "q", "x", "dq"):
        assert np.array_equal(getattr(samples, field), getattr(plain, field))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ahead", "rotation"),
    [("ackermann", -1.7, -1.48), ("differential", 1.7e9, 2.5)],
)
def test_clock_offset_rotation_lever_arm_and_noise_are_found_together(
    name, ahead, rotation
):
    spec = load_robot(name)
    recording = drive(
        spec,
        latency=0.06,
        pose_clock_ahead=ahead,
        rotation=rotation,
        lever=(0.05, 0.0),
        noise=(0.001, 0.002),
    )
    found = calibrate(recording, spec)
    assert found.clock_offset_s == pytest.approx(-ahead, abs=4e-3)
    assert found.command_latency_s == pytest.approx(0.06, abs=2e-3)
    assert found.rotation_rad == pytest.approx(rotation, abs=0.01)
    assert found.lever_arm_m[0] == pytest.approx(0.05, abs=3e-3)
    assert found.position_noise_m == pytest.approx(0.001, rel=0.1)
    assert found.heading_noise_rad == pytest.approx(0.002, rel=0.1)
    error = abs(found.clock_offset_s + ahead)
    assert error < 5 * found.uncertainty["clock_offset_s"] + 1e-3


def test_the_lever_arm_along_y_is_found_where_the_speed_is_measured(car):
    found = calibrate(drive(car, lever=(0.05, -0.03), noise=NOISE), car)
    assert found.lever_arm_m == pytest.approx((0.05, -0.03), abs=3e-3)


def test_the_lever_arm_along_y_of_a_differential_robot_is_said_to_be_unknown(
    differential,
):
    found = calibrate(drive(differential, lever=(0.05, -0.03)), differential)
    assert found.lever_arm_m[1] == 0.0
    assert any("along y could not be learnt" in note for note in found.notes)


@pytest.mark.slow
def test_a_robot_that_moves_sideways_shows_both_parts_of_the_lever_arm(mecanum):
    recording = drive(
        mecanum, latency=0.05, rotation=-0.5, lever=(0.03, 0.04), noise=(0.001, 0.002)
    )
    found = calibrate(recording, mecanum)
    assert found.rotation_rad == pytest.approx(-0.5, abs=0.01)
    assert found.lever_arm_m == pytest.approx((0.03, 0.04), abs=3e-3)


def test_bursts_do_not_spoil_offset_and_mounting(differential):
    recording = drive(
        differential, burst=0.1, pose_clock_ahead=0.4, rotation=1.0, lever=(-0.05, 0.0)
    )
    found = calibrate(recording, differential)
    assert found.burst_period_s == pytest.approx(0.1, abs=1e-3)
    assert found.clock_offset_s == pytest.approx(-0.4, abs=3e-3)
    assert found.rotation_rad == pytest.approx(1.0, abs=5e-3)
    assert any("bursts" in note for note in found.notes)


@pytest.fixture(scope="module")
def together(car):
    """A drive on one clock, whose state was not measured."""
    return drive(car, duration=30.0, latency=0.06, noise=NOISE, measured_state=False)


@pytest.mark.slow
def test_lags_and_latency_of_a_state_that_was_not_measured_are_found(car, together):
    found = calibrate(together, car)
    assert found.command_latency_s == pytest.approx(0.06, abs=5e-3)
    speed, steering = found.responses
    assert speed.lag_s == pytest.approx(0.1, abs=5e-3)
    assert speed.gain == pytest.approx(1.0, abs=0.01)
    assert steering.lag_s == pytest.approx(0.1, abs=0.01)
    plain = json.loads(json.dumps(asdict(found)))
    assert TypeAdapter(Calibration).validate_python(plain) == found


@pytest.mark.slow
def test_without_wheels_offset_and_latency_are_said_to_be_one_sum(car, together):
    found = calibrate(replace(add_wheels(together, 0.4), wheels=None), car)
    assert found.command_latency_s == 0.0
    assert found.clock_offset_s == pytest.approx(-0.46, abs=5e-3)
    assert any("Only the sum" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize("swapped", [True, False])
def test_wheels_tell_latency_from_clock_offset_and_whether_they_are_swapped(
    car, together, swapped
):
    found = calibrate(add_wheels(together, 0.4, swapped), car)
    assert found.command_latency_s == pytest.approx(0.06, abs=0.015)
    assert found.clock_offset_s == pytest.approx(-0.4, abs=0.015)
    assert found.wheels_swapped is swapped
    assert any("interchanged" in note for note in found.notes) is swapped


def test_a_recording_of_another_robot_is_refused(car, mecanum):
    with pytest.raises(RecordingError, match="check that this robot was recorded"):
        calibrate(drive(car, duration=5.0), mecanum)


def test_streams_that_do_not_overlap_are_refused(car):
    recording = drive(car, duration=20.0)
    moved = replace(recording.command, t=recording.command.t + 500.0)
    with pytest.raises(RecordingError, match="from the same drive"):
        align(Drive(replace(recording, command=moved, state=None), car), Calibration())


def test_poses_of_tracked_body_and_base_link_convert_both_ways():
    calibration = Calibration(rotation_rad=-1.2, lever_arm_m=(0.05, 0.02))
    base = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 3))
    tracked = calibration.to_tracked(base)
    assert np.allclose(calibration.to_base(tracked), base, atol=1e-12)
    assert np.allclose(np.hypot(*(tracked - base)[:, :2].T), np.hypot(0.05, 0.02))
