"""Latency and lags of states that follow the commands and were not measured."""

from __future__ import annotations

from dataclasses import replace

import pytest

from identify.drives import drive, fit_whole
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import SEPARABLE_S, measure_timing
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import describe_clocks


@pytest.mark.slow
def test_of_latency_and_lag_that_noise_hides_the_sum_is_told(car):
    recording = drive(
        car, 4, 20.0, latency=0.05, noise=(0.04, 0.08), measured_state=False
    )
    found = fit_whole(recording, car).calibration
    assert found.uncertainty["command_latency_s"] > SEPARABLE_S
    sigma = found.uncertainty["command_latency_and_speed_lag_s"]
    both = found.command_latency_s + found.responses[0].lag_s
    assert both == pytest.approx(0.15, abs=3.0 * sigma)
    assert any(
        "can hardly be separated: trust their sum" in note for note in found.notes
    )


@pytest.mark.parametrize("ahead", [0.0, 0.2])
def test_a_robot_that_moves_before_its_commands_has_poses_of_another_clock(car, ahead):
    recording = drive(
        car, 4, 20.0, latency=0.05, noise=(0.001, 0.002), measured_state=False
    )
    pose = replace(recording.pose, t=recording.pose.t - ahead)
    tried = Drive(replace(recording, pose=pose), car)
    timing = measure_timing(tried)
    assert timing.latency == pytest.approx(0.0 if ahead else 0.05, abs=0.01)
    told = " ".join(describe_clocks(tried, Calibration(), timing))
    assert ("The robot moves 0.15 s before its commands" in told) == (ahead > 0.0)


def test_a_measured_state_that_moves_before_its_commands_is_of_another_clock(car):
    recording = drive(car, 4, 20.0, latency=0.05, noise=(0.001, 0.002))
    ahead = {
        name: replace(stream, t=stream.t - 0.2)
        for name, stream in (("pose", recording.pose), ("state", recording.state))
    }
    tried = Drive(replace(recording, **ahead), car)
    told = " ".join(describe_clocks(tried, Calibration(), measure_timing(tried)))
    assert (
        "The robot moves 0.15 s before its commands: its state is stamped by another"
        in told
    )


def test_what_the_pose_tells_is_not_asked_to_be_measured(car, differential):
    recording = replace(drive(car, duration=10.0), state=None)
    speed, steering = car.state
    by_twist = speed.model_copy(update={"follows": None, "twist": "vx"})
    told = car.model_copy(update={"state": (by_twist, steering)})
    untold = car.model_copy(
        update={"state": (speed, steering.model_copy(update={"follows": None}))}
    )
    assert not any(v.must_be_measured for v in told.state)
    sentence = (
        "'steering' of robot 'ackermann' follows no command; "
        ".*`nics inspect .* --map my.yaml`"
    )
    with pytest.raises(RecordingError, match=sentence):
        measure_timing(Drive(recording, untold))
