"""Drives that can't show what a robot does: each is refused, or says what it can't show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import (
    NOISE,
    draw_commands,
    drive,
    fit_whole,
    follow_commands,
    scale,
    with_values,
)
from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify import judgement
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.repair import check_axes
from nics_drl_bridge.identify.report import conclude
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import load_robot


def driven(spec, commands, **given) -> Recording:
    """The textbook robot's drive under given commands (T, C)."""
    book = textbook(spec)
    within = np.clip(commands, spec.command_low, spec.command_high)
    made = follow_commands(within, book.target, book.twist, book.lag, **given)
    return with_values(made, command=commands)


def said(found, text: str) -> bool:
    return any(text in note for note in found.notes)


def harmless(found, spec) -> bool:
    """Whether no rate within the robot's limits is out of this world."""
    book = textbook(spec)
    model = found.model
    rng = np.random.default_rng(1)
    low = [v.min for v in (*spec.state, *spec.command)]
    high = [v.max for v in (*spec.state, *spec.command)]
    x = rng.uniform(low, high, (500, len(low)))
    limit = np.abs(book.twist(x[:, : len(spec.state)])).max(axis=0)
    return bool((np.abs(model.rates(x)[:, :3]) <= 2.0 * limit + 0.5).all())


@pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE])
def test_straight_only_gives_a_model_without_turning_and_says_so(car, noise):
    commands = draw_commands(car)
    commands[:, 1] = 0.0
    recording = driven(car, commands, noise=noise)
    found = identify(recording, car)
    assert {"steering", "steering_command"} <= set(found.fit.unmoved)
    assert said(found, "Drive with steering_command changing")
    assert any("steering_command changing" in gap for gap in found.gaps)
    assert "record another drive" in conclude(found).advice
    assert not found.model.powers[:, [1, 3]].any()
    assert harmless(found, car)
    with pytest.raises(FitError, match="steering_command never moved"):
        identify(recording, car, strict=True)


@pytest.mark.slow
def test_noise_of_a_measured_state_is_no_excitation(car):
    commands = draw_commands(car)
    commands[:, 1] = -0.4
    recording = driven(car, commands, noise=NOISE)
    values = recording.state.values.copy()
    values[:, 1] = -0.4
    values += np.random.default_rng(3).normal(size=values.shape) * 0.01
    found = fit_whole(with_values(recording, state=values), car, order=2)
    assert "steering" in found.fit.unmoved
    assert harmless(found, car)


@pytest.mark.parametrize("name", ["ackermann", "mecanum"])
def test_standing_is_refused(name):
    spec = load_robot(name)
    still = np.zeros((1000, len(spec.command)))
    for noise in ((0.0, 0.0), NOISE):
        with pytest.raises((FitError, RecordingError), match="no command ever changed"):
            identify(driven(spec, still, noise=noise), spec)


@pytest.mark.parametrize("count", [2, 60])
def test_too_short_a_drive_is_refused(car, count):
    with pytest.raises(
        (FitError, RecordingError), match=r"too few|usable intervals|overlap|rec"
    ):
        identify(driven(car, draw_commands(car, count)), car)


def test_repeated_rows_are_left_out_and_change_nothing(car):
    once = drive(car, duration=20.0)
    again = {
        name: Stream(np.repeat(s.t, 2), np.repeat(s.values, 2, axis=0), s.clock)
        for name, s in once.streams.items()
    }
    plain = identify(once, car)
    twice = identify(Recording(**again), car)
    assert said(twice, "repeat the previous row")
    assert twice.model.named.terms == plain.model.named.terms


@pytest.mark.parametrize(
    ("stream", "column", "factor"),
    [
        ("state", 1, 180.0 / np.pi),
        ("command", 1, 180.0 / np.pi),
        ("state", 0, 1000.0),
        ("command", 0, 1000.0),
        ("pose", 2, 180.0 / np.pi),
        ("pose", slice(0, 2), 1000.0),
    ],
)
def test_mixed_units_are_refused(car, stream, column, factor):
    recording = driven(car, draw_commands(car))
    factors = np.ones(recording.streams[stream].values.shape[1])
    factors[column] = factor
    with pytest.raises(RecordingError, match="must be in"):
        identify(scale(recording, **{stream: factors}), car)


@pytest.mark.parametrize(
    ("name", "axis"), [("ackermann", 0), ("differential", 2), ("mecanum", 1)]
)
def test_a_reversed_axis_of_the_pose_is_refused(name, axis):
    spec = load_robot(name)
    recording = driven(spec, draw_commands(spec), noise=NOISE)
    mirrored = scale(recording, pose=np.where(np.arange(3) == axis, -1.0, 1.0))
    with pytest.raises(RecordingError, match="one of x, y and heading is reversed"):
        identify(mirrored, spec)


def test_the_heading_of_a_compass_is_refused_with_the_line_to_write(car):
    """On a wide curve the course is nearly steady with the wrong heading, too."""
    t = np.arange(0.0, 60.0, 0.02)
    recording = driven(car, np.stack([0.8 + 0.0 * t, 0.1 * np.sin(0.35 * t)], axis=1))
    values = recording.pose.values.copy()
    values[:, 2] = np.pi / 2.0 - values[:, 2]
    with pytest.raises(
        RecordingError, match=r"heading: {from: ..., scale: -1, offset: 1.5708}"
    ):
        check_axes(Drive(with_values(recording, pose=values), car))


def test_commands_beyond_the_limits_are_held_there_and_told(differential):
    commands = draw_commands(differential) * [3.0, 1.5]
    found = identify(driven(differential, commands), differential)
    assert said(found, "forward_command was beyond the robot's limits, -0.5 to 1 m/s")
    terms = found.model.named.terms
    assert terms["d_left_wheel"]["left_wheel"] == pytest.approx(
        -9.06, abs=0.1
    )  # dt is 20 ms
    assert found.fit.r2[3:].min() > 0.999


def test_a_robot_that_does_not_follow_its_commands_is_not_trusted(differential):
    recording = driven(differential, draw_commands(differential))
    other = draw_commands(differential, seed=9)
    found = identify(
        with_values(recording, command=other),
        differential,
    )
    assert said(found, "does not follow the commands") or said(found, "did not follow")


def test_commands_that_always_move_together_are_named(differential):
    commands = draw_commands(differential)
    commands[:, 1] = 2.0 * commands[:, 0]
    recording = driven(differential, commands)
    found = identify(recording, differential)
    assert said(found, "forward_command and turn_command always moved together")
    assert harmless(found, differential)
    with pytest.raises(
        FitError, match="forward_command and turn_command always moved together"
    ):
        identify(recording, differential, strict=True)


@pytest.mark.parametrize("name", ["ackermann", "mecanum"])
def test_a_good_drive_passes_the_strict_checks(name):
    spec = load_robot(name)
    found = identify(driven(spec, draw_commands(spec, 2500)), spec, strict=True)
    assert not said(found, "never moved")
    assert not said(found, "reversed")


def test_where_predictions_run_away_the_model_is_linear(monkeypatch):
    """Each half second of commands comes late by another time, as over a bad link."""
    monkeypatch.setattr(judgement, "is_beaten_by_textbook", lambda judgement: False)
    spec = load_robot("differential")
    rng = np.random.default_rng(9)
    whole = record(spec, rng, 40.0, dt=0.02)
    poses = whole.pose.values + rng.normal(0.0, 1e-3, whole.pose.values.shape)
    late = np.repeat(rng.uniform(0.0, 0.4, len(whole.command.t) // 25 + 1), 25)
    t = np.maximum.accumulate(whole.command.t - late[: len(whole.command.t)])
    late_commands = replace(whole.command, t=t + 1e-6 * np.arange(len(t)))
    jittered = replace(
        whole, pose=replace(whole.pose, values=poses), command=late_commands
    )
    found = identify(jittered, spec, alpha=0.99)
    assert (found.model.powers.sum(axis=1) <= 1).all()
    assert found.held_out.mean_position_error_m < 0.25 * found.held_out.mean_path_m
