from __future__ import annotations

import pytest

from identify.drives import fit_trial, without
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.open_loop import measure_open_loop_error
from nics_drl_bridge.recording.readers import read_recording


@pytest.fixture(scope="module")
def found(real_drives, car):
    return identify(read_recording(real_drives / "random_drive_45s"), car, assume=True)


@pytest.mark.slow
def test_its_recording_shows_bursts_offset_rotation_and_swapped_wheels(found):
    calibration = found.calibration
    assert calibration.burst_period_s == pytest.approx(0.1, abs=0.005)
    assert 0.15 < calibration.clock_offset_s < 0.35
    assert 0.03 < calibration.command_latency_s < 0.15
    assert calibration.rotation_rad == pytest.approx(-1.48, abs=0.01)
    assert calibration.wheels_swapped is True
    told = " ".join(calibration.notes)
    assert "lies on the robot could not be learnt" in told
    assert "steering_command never changed" in told


def check_prediction(held_out):
    assert held_out is not None
    assert held_out.windows > 15
    assert held_out.mean_path_m > 1.0
    assert held_out.mean_position_error_m < 0.03


@pytest.mark.slow
def test_its_model_predicts_five_seconds_of_unseen_drive_to_three_centimetres(found):
    check_prediction(found.held_out)


@pytest.mark.campaign
@pytest.mark.parametrize("until", [10.0, 20.0, 38.0])
def test_so_does_a_model_that_learnt_another_part(real_drives, car, until):
    recording = read_recording(real_drives / "random_drive_45s")
    check_prediction(identify(recording, car, train_until=until).held_out)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["constant_drive_51s", "constant_drive_214s"])
def test_its_model_predicts_other_drives_too(real_drives, car, found, name):
    other = Drive(read_recording(real_drives / name), car)
    end = float(other.recording.pose.t[-1])
    result = measure_open_loop_error(found.model, found.calibration, other, 2.0, end)
    assert result.mean_position_error_m < 0.03


def test_its_model_is_short_and_steers_by_assumption_only(found):
    terms = found.model.named.terms
    assert terms["vx"] == {"speed": 1.0}
    assert list(terms["wz"]) == ["speed*steering"]
    assert terms["wz"]["speed*steering"] * -0.5 == pytest.approx(-2.31, abs=0.05)
    assert set(found.model.assumed) == {
        ("wz", "speed*steering"),
        ("d_steering", "steering"),
        ("d_steering", "steering_command"),
    }


@pytest.mark.slow
def test_gaps_and_a_start_in_the_middle_do_not_spoil_its_model(real_drives, car):
    recording = read_recording(real_drives / "random_drive_45s")
    for gap in (12.0, 15.5, 19.0, 26.0, 33.0):
        recording = without(recording, gap, gap + 0.4)
    held_out = fit_trial(without(recording, 0.0, 6.0), car).held_out
    assert held_out is not None
    assert held_out.mean_position_error_m < 0.03
