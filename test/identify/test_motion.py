"""Motion as state: the twist of robots of which only the pose was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import savgol_filter

from identify.drives import fit_trial, slipping_car
from nics_drl_bridge.identify.alignment import (
    WIDTHS_S,
    add_motion,
    choose_half_width,
    find_slopes,
    has_motion_as_state,
    make_motion_grid,
    make_surrogate,
    require_state,
    resample_motion,
    smooth_commands,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import build_robot, load_robot

MOUNTED = Calibration(rotation_rad=-0.1, lever_arm_m=(0.08, 0.0))


@pytest.mark.parametrize("rows", [5, 21, 49])
def test_slopes_are_those_of_scipy_also_at_the_ends(rows):
    values = np.random.default_rng(0).normal(size=(50, 3)).cumsum(axis=0)
    expected = savgol_filter(values, rows, 2, deriv=1, delta=0.05, axis=0)
    assert find_slopes(values, rows, 0.05) == pytest.approx(expected, abs=1e-11)


@pytest.fixture(scope="module")
def drive() -> Drive:
    spec, recording = slipping_car(duration=20.0)
    return Drive(recording, spec)


def test_a_twist_that_was_not_measured_is_taken_from_the_pose(drive, car):
    assert has_motion_as_state(drive.spec, drive.recording)
    assert not has_motion_as_state(car, drive.recording)
    measured = Stream(
        drive.recording.pose.t, np.zeros((len(drive.recording.pose.t), 3))
    )
    assert not has_motion_as_state(drive.spec, replace(drive.recording, state=measured))


def test_noisier_poses_are_smoothed_over_longer(drive):
    assert choose_half_width(drive) == WIDTHS_S[0]
    noise = np.random.default_rng(0).normal(
        0.0, 0.01, drive.recording.pose.values.shape
    )
    pose = replace(drive.recording.pose, values=drive.recording.pose.values + noise)
    assert (
        choose_half_width(Drive(replace(drive.recording, pose=pose), drive.spec))
        > WIDTHS_S[0]
    )


@pytest.mark.parametrize(
    ("every", "step"), [(0.01, 0.01), (0.0071, 0.01), (0.04, 0.02)]
)
def test_the_step_divides_the_control_period_whatever_the_poses_rate(
    drive, every, step
):
    pose = drive.recording.pose
    other = replace(pose, t=every * np.arange(len(pose.t)))
    grid = make_motion_grid(
        Drive(replace(drive.recording, pose=other), drive.spec), Calibration(), 0.1
    )
    assert np.diff(grid) == pytest.approx(step)


def test_the_twist_is_that_of_the_base_wherever_the_tracked_body_sits(drive):
    grid = make_motion_grid(drive, MOUNTED, 0.1)
    moved = add_motion(drive, MOUNTED, grid, 0.07)
    speed, aside, turn = require_state(moved).values.T
    assert aside == pytest.approx(-0.015 * speed**2 * turn, abs=0.03)
    bare = require_state(add_motion(drive, Calibration(), grid, 0.07)).values[:, 1]
    assert np.abs(bare).mean() > 5.0 * np.abs(aside + 0.015 * speed**2 * turn).mean()


def test_samples_have_the_commands_in_effect_after_their_latency(drive):
    late = replace(MOUNTED, command_latency_s=0.1)
    grid = make_motion_grid(drive, late, 0.1)
    at = resample_motion(add_motion(drive, late, grid, 0.07), late, 0.07)
    command = drive.recording.command
    row = 500
    before = np.searchsorted(command.t, at.t[row] - 0.1 + 1e-9, "right") - 1
    assert at.x[row, 3:] == pytest.approx(command.values[before])


def test_a_surrogate_has_a_state_for_each_command(drive):
    names = [(v.name, v.follows) for v in make_surrogate(drive.spec).state]
    assert names == [("throttle_state", "throttle"), ("steering_state", "steering")]


def test_poses_that_are_known_to_be_doubtful_do_not_bend_the_motion(drive):
    pose = drive.recording.pose
    rng = np.random.default_rng(3)
    lost = rng.random(len(pose.t)) < 0.2
    values = pose.values + np.where(
        lost[:, None], rng.normal(0.0, 0.05, pose.values.shape), 0.0
    )
    sigma = np.where(lost, 0.05, 0.0005)[:, None] * np.ones(3)
    grid = make_motion_grid(drive, MOUNTED, 0.1)
    off = []
    truth = require_state(add_motion(drive, MOUNTED, grid, 0.07)).values
    for known in (None, sigma):
        stream = replace(pose, values=values, sigma=known)
        seen = Drive(replace(drive.recording, pose=stream), drive.spec)
        found = require_state(add_motion(seen, MOUNTED, grid, 0.07)).values
        off.append(np.abs(found - truth).mean())
    assert off[1] < 0.1 * off[0]


def test_commands_are_as_smooth_as_the_twist_so_that_they_begin_and_end_together():
    step = 0.02
    width = 0.25
    speed = np.where(np.arange(400) * step < 4.0, 0.2, 0.6)[:, None]
    smooth = smooth_commands(speed, step, width)[:, 0]
    changed = np.flatnonzero((smooth > 0.201) & (smooth < 0.599)) * step
    assert changed[[0, -1]] == pytest.approx([4.0 - width, 4.0 + width], abs=0.05)
    assert smooth[100:-100].mean() == pytest.approx(0.4, abs=0.01)


@pytest.mark.slow
def test_poses_ten_times_a_second_do_not_hide_when_a_robot_got_its_commands():
    spec = build_robot({"kind": "differential", "footprint_radius": 0.15})
    drive = record(load_robot("differential"), np.random.default_rng(2), 30.0, dt=0.02)
    seen = [
        replace(s, t=s.t[::5], values=s.values[::5])
        for s in (drive.command, drive.pose)
    ]
    found = fit_trial(Recording(*seen, source="ten a second"), spec, order=1)
    assert found.calibration.command_latency_s == pytest.approx(0.0, abs=0.03)
    ends = found.judgement[-1]
    assert ends.model.position_m < 0.02 * ends.path_m
