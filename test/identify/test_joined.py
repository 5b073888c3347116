"""Several recordings in one fit."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from identify.drives import draw_commands, fit_trial, follow_commands
from nics_drl_bridge.errors import FitError
from nics_drl_bridge.generator import generate, mount_lidar
from nics_drl_bridge.identify import open_loop
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Alone, Drive
from nics_drl_bridge.identify.findings import describe_gaps, measure_time_without_pose
from nics_drl_bridge.identify.identify import join_recordings
from nics_drl_bridge.identify.report import conclude, format_report
from nics_drl_bridge.identify.shooting import Parameters, Shooting
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import build_robot

ROBOT = build_robot(
    {"kind": "differential", "footprint_radius": 0.2},
    {"forward_command": (-0.8, 0.8), "turn_command": (-1.5, 1.5)},
)
LAG_S = 0.1
GAIN = np.array([0.9, 0.8])  # of forward and turn


def driven(
    source: str,
    forward: float,
    turn: float,
    seconds: float = 24.0,
    seed: int = 0,
    gain: np.ndarray = GAIN,
    clock_ahead: float = 0.0,
) -> Recording:
    """A differential robot that lags behind commands up to these [m/s, rad/s], seen at 50 Hz."""
    held = draw_commands(ROBOT, round(seconds / 0.02), hold=40, seed=seed)
    command = held * np.array([forward / 0.8, turn / 1.5])
    made = follow_commands(
        command,
        lambda u: gain * u,
        lambda state: np.insert(state, 1, 0.0, axis=1),
        LAG_S,
        noise=(0.001, 0.001),
        seed=seed,
    )
    clock = "mocap" if clock_ahead else "robot"
    pose = replace(made.pose, t=made.pose.t + clock_ahead, clock=clock)
    return replace(made, pose=pose, state=None, source=source)


STRAIGHT = driven("straight.csv", 0.8, 0.0)
TURNING = driven("turning.csv", 0.0, 1.5, seed=1)


def test_the_time_between_two_recordings_is_no_gap_in_the_pose():
    drive = Drive(join_recordings([STRAIGHT, TURNING], ROBOT), ROBOT)
    assert measure_time_without_pose(drive) == 0.0
    assert list(describe_gaps(drive)) == []


@pytest.fixture(scope="module")
def together():
    return generate(
        [STRAIGHT, TURNING], ROBOT, mount_lidar(ROBOT), order=1, strict=True
    )


@pytest.mark.slow
def test_no_window_of_the_fit_crosses_either(together):
    _, identified = together
    samples = identified.samples
    recording = identified.recording
    problem = Shooting(
        samples,
        Parameters((), *np.zeros((4, 0))),
        lambda _: samples.x,
        lambda model, _: model,
        lambda *_: np.ones(3),
    )
    first, steps = problem.list_windows()
    at = recording.episode_at(samples.t)
    assert set(at) == {0, 1, 2, 3}
    for column in steps.T:
        some = column > 0
        assert np.array_equal(at[first[some]], at[(first + column)[some]])


def test_not_even_episodes_without_a_gap_are_crossed():
    whole = driven("whole.csv", 0.8, 1.5)
    joined = join_recordings([STRAIGHT, TURNING], ROBOT)
    start, end = (
        replace(joined.episodes[0], start_s=a, end_s=b) for a, b in ((0, 12), (12, 24))
    )
    cut = replace(whole, episodes=(start, end))
    chosen = open_loop.select_windows(
        Drive(cut, ROBOT), Calibration(), 0.0, 24.0, 2.0, 0.1
    )
    crossing = (chosen.start_t < 12.0) & (chosen.end_t > 12.0)
    assert len(chosen.start_t) > 100
    assert not crossing.any()


@pytest.mark.slow
def test_two_drives_teach_together_what_neither_does_alone(together):
    with pytest.raises(FitError):
        generate(STRAIGHT, ROBOT, mount_lidar(ROBOT), order=1, strict=True)
    with pytest.raises(FitError):
        generate(TURNING, ROBOT, mount_lidar(ROBOT), order=1, strict=True)
    model, identified = together
    last = identified.judgement[-1]
    assert last.model.position_m < 0.02
    assert "(the last third of each drive)" in model.report
    assert "straight.csv, turning.csv" in model.report
    assert not identified.fit.unmoved


@pytest.mark.slow
def test_clocks_of_their_own_are_aligned_drive_by_drive():
    drives = [
        driven(f"{k}.csv", 0.8, 1.5, seed=k, clock_ahead=ahead)
        for k, ahead in enumerate((3.0, -40.0))
    ]
    joined = join_recordings(drives, ROBOT)
    said = " ".join(joined.repairs)
    aligned = re.findall(
        r"(\d).csv: the clock of its pose was aligned by (-?[\d.]+) s", said
    )
    # Each is sought by the commands, and so includes the same lag of the robot.
    lags = [
        float(offset) - sought
        for (_, offset), sought in zip(aligned, (-3.0, 40.0), strict=True)
    ]
    assert np.abs(lags).max() < 0.3
    assert lags[0] == pytest.approx(lags[1], abs=0.03)
    found = fit_trial(joined, ROBOT, order=1)
    assert found.judgement[-1].model.position_m < 0.05


@pytest.mark.slow
def test_a_recording_that_alone_is_off_is_named():
    good = [driven(f"good{k}.csv", 0.8, 1.5, seed=k) for k in range(2)]
    slippery = driven("slippery.csv", 0.8, 1.5, seed=5, gain=np.array([0.5, 0.4]))
    found = fit_trial(join_recordings([*good, slippery], ROBOT), ROBOT, order=1)
    named = [note for note in found.notes if isinstance(note, Alone)]
    assert len(named) == 1
    assert named[0].startswith("slippery.csv alone is off: its predictions end")
    assert named[0] in conclude(found).doubts
    assert "slippery.csv alone is off" in " ".join(
        format_report("three", found).split()
    )
