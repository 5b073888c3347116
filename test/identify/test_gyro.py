"""A recorded gyro turns odometry whose wheels slip; the report says relative to what it errs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from skid_steer import BIAS, OVER_REPORTED, drive_skid_steer

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.drive import Mistake
from nics_drl_bridge.identify.identify import join_recordings
from nics_drl_bridge.identify.repair import correct_heading_by_gyro, describe_reference
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import build_robot

ROBOT = {
    "kind": "differential",
    "footprint_radius": 0.4,
}


def recorded(drive, measured_by="odometry", gyro=True):
    """Returns the recording of a drive as a bag of the robot holds it."""
    imu = np.stack([np.zeros_like(drive.t), np.zeros_like(drive.t), drive.gyro], axis=1)
    pose = np.concatenate(
        [drive.odom[:, :2], geometry.wrap_angle(drive.odom[:, 2:])], axis=1
    )
    every = slice(None, None, 5)
    return Recording(
        command=Stream(drive.t[every], drive.command[every]),
        pose=Stream(drive.odom_t, pose),
        imu=Stream(drive.t, imu) if gyro else None,
        measured_by=measured_by,
    )


@pytest.fixture(scope="module")
def slipping():
    return drive_skid_steer(np.random.default_rng(3))


def off_the_truth(drive, pose):
    """Returns the greatest distance [m] and turn [rad] of poses from the true ones."""
    truth = drive.truth[:: len(drive.truth) // len(pose)][: len(pose)]
    turn = np.abs(geometry.wrap_angle(pose[:, 2] - truth[:, 2]))
    return np.hypot(*(pose - truth)[:, :2].T).max(), turn.max()


def test_the_heading_of_slipping_wheels_is_taken_from_the_gyro(slipping):
    recording = recorded(slipping)
    before, turned_before = off_the_truth(slipping, recording.pose.values)
    found = correct_heading_by_gyro(recording)
    after, turned_after = off_the_truth(slipping, found.pose.values)
    assert turned_before > 0.5
    assert before > 0.5
    assert turned_after < 0.1
    assert after < 0.3
    turning = found.gyro
    assert turning.scale == pytest.approx(OVER_REPORTED, abs=0.02)
    assert abs(turning.bias - BIAS) < 5.0 * turning.bias_std + 3e-4
    assert 0.0 < turning.bias_std < 2e-3
    assert turning.rest_s >= 2.0
    told = found.repairs[-1]
    assert told.startswith("The gyro contradicts odometry by 0.")
    assert "in 5 s: it turns 1." in told


def test_the_bias_is_found_while_driving_if_the_robot_never_stood():
    drive = drive_skid_steer(np.random.default_rng(5), rest_s=0.0)
    found = correct_heading_by_gyro(recorded(drive))
    assert found.gyro.rest_s == 0.0
    assert abs(found.gyro.bias - BIAS) < 5.0 * found.gyro.bias_std
    assert off_the_truth(drive, found.pose.values)[1] < 0.5


def test_a_gyro_that_agrees_changes_nothing_and_confirms_the_heading():
    drive = drive_skid_steer(np.random.default_rng(6), over_reported=1.0)
    recording = recorded(drive)
    found = correct_heading_by_gyro(recording)
    assert np.array_equal(found.pose.values, recording.pose.values)
    assert found.gyro is not None
    assert "confirms" in describe_reference(found)


@pytest.mark.parametrize(
    ("factor", "word"), [(-1.0, "mirrored"), (180.0 / np.pi, "unit: deg/s"), (0.0, "")]
)
def test_a_gyro_of_another_sign_or_unit_is_not_used_and_told(slipping, factor, word):
    recording = recorded(slipping)
    wrong = replace(recording.imu, values=recording.imu.values * factor)
    found = correct_heading_by_gyro(replace(recording, imu=wrong))
    assert np.array_equal(found.pose.values, recording.pose.values)
    assert found.gyro is None
    if word:
        assert isinstance(found.repairs[-1], Mistake)
        assert word in found.repairs[-1]


def test_poses_of_a_tracker_are_never_turned(slipping):
    recording = recorded(slipping, measured_by="tracker")
    found = correct_heading_by_gyro(recording)
    assert np.array_equal(found.pose.values, recording.pose.values)
    assert "contradicts the tracker" in found.repairs[-1]


def test_poses_of_unknown_origin_are_not_turned_but_the_fix_is_told(slipping):
    found = correct_heading_by_gyro(recorded(slipping, measured_by=""))
    assert found.gyro is None
    assert "measured_by: odometry" in found.repairs[-1]


@pytest.mark.parametrize(
    ("measured_by", "gyro", "said"),
    [
        (
            "odometry",
            False,
            "relative to odometry; nothing here shows how far that drifts.",
        ),
        ("odometry", True, "relative to odometry with its heading from the gyro"),
        ("tracker", False, "relative to motion capture or a localiser."),
        ("", False, "relative to the recorded pose"),
    ],
)
def test_the_report_says_relative_to_what_the_error_is(
    slipping, measured_by, gyro, said
):
    recording = correct_heading_by_gyro(recorded(slipping, measured_by, gyro))
    assert said in describe_reference(recording)


def test_each_of_several_recordings_turns_by_its_own_bias():
    drives = [
        drive_skid_steer(np.random.default_rng(k), duration=40.0, bias=0.02 * k)
        for k in (1, 2)
    ]
    spec = build_robot(
        ROBOT, {"forward_command": (-0.2, 0.8), "turn_command": (-1.0, 1.0)}
    )
    joined = join_recordings([recorded(each) for each in drives], spec)
    assert joined.gyro is not None
    turned = np.diff(np.unwrap(joined.pose.values[:, 2]))
    true = sum(float(np.abs(np.diff(each.truth[:, 2])).sum()) for each in drives)
    assert float(np.abs(turned).sum()) == pytest.approx(true, rel=0.03)
