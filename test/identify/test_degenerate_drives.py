"""Drives that can't show what a robot does: each is refused, or says what it can't show."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from identify.drives import drive
from nics_drl_bridge import geometry
from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify import acceptance, verdict
from nics_drl_bridge.identify.conclusion import conclude
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.repair import check_axes
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.kernels import SERIES, make_terms, simulate_rollouts
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import load_robot

FINE = 10


def driven(spec, commands, dt=0.02, noise=(0.0, 0.0), seed=0) -> Recording:
    """The textbook robot's drive under given commands (T, C)."""
    book = textbook(spec)
    rng = np.random.default_rng(seed)
    goals = book.target(np.clip(commands, spec.command_low, spec.command_high))
    share = np.exp(-np.arange(FINE)[:, None] * dt / FINE / book.lag)
    state = np.zeros(len(spec.state))
    states = []
    for goal in goals:
        states.append(goal + (state - goal) * share)
        state = goal + (state - goal) * np.exp(-dt / book.lag)
    moved = geometry.exp(book.twist(np.concatenate(states)) * dt / FINE)
    heading = np.cumsum(moved[:, 2]) - moved[:, 2]
    path = np.cumsum(geometry.rotate(moved[:, :2], heading), axis=0)
    poses = np.concatenate(
        [np.append(np.zeros((1, 2)), path[:-1], 0), heading[:, None]], 1
    )[::FINE]
    poses = poses + rng.normal(size=poses.shape) * [noise[0], *noise]
    t = np.arange(len(commands)) * dt
    states = np.array([block[0] for block in states])
    return Recording(Stream(t, commands), Stream(t, poses), Stream(t, states))


def random_commands(spec, count=1500, hold=25, seed=0):
    rng = np.random.default_rng(seed)
    held = rng.uniform(
        spec.command_low, spec.command_high, (-(-count // hold), len(spec.command))
    )
    return np.repeat(held, hold, axis=0)[:count]


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


@pytest.mark.parametrize("noise", [(0.0, 0.0), (5e-4, 1e-3)])
def test_straight_only_gives_a_model_without_turning_and_says_so(car, noise):
    commands = random_commands(car)
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


def test_straight_only_of_a_differential_robot_names_the_turn_command(differential):
    commands = random_commands(differential)
    commands[:, 1] = 0.0
    found = identify(driven(differential, commands), differential)
    assert found.fit.unmoved == ("turn_command",)
    assert said(found, "Drive with turn_command changing")
    assert harmless(found, differential)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "constant", "name", "advice"),
    [
        (0, 0.6, "speed_command", "is only valid for this drive's constant value"),
        (
            1,
            -0.4,
            "steering_command",
            "drive with steering_command changing over its whole range",
        ),
    ],
)
def test_a_constant_command_gives_a_model_without_it_and_says_so(
    car, column, constant, name, advice
):
    commands = random_commands(car)
    commands[:, column] = constant
    recording = replace(driven(car, commands), state=None)
    found = identify(recording, car)
    assert name in found.fit.unmoved
    assert said(found, advice)
    with pytest.raises(FitError, match=f"{name} never moved"):
        identify(recording, car, strict=True)


@pytest.mark.slow
def test_noise_of_a_measured_state_is_no_excitation(car):
    commands = random_commands(car)
    commands[:, 1] = -0.4
    recording = driven(car, commands, noise=(5e-4, 1e-3))
    values = recording.state.values.copy()
    values[:, 1] = -0.4
    values += np.random.default_rng(3).normal(size=values.shape) * 0.01
    found = identify(
        replace(recording, state=replace(recording.state, values=values)), car
    )
    assert "steering" in found.fit.unmoved
    assert harmless(found, car)


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_standing_is_refused(name):
    spec = load_robot(name)
    still = np.zeros((1000, len(spec.command)))
    for noise in ((0.0, 0.0), (5e-4, 1e-3)):
        with pytest.raises((FitError, RecordingError), match="no command ever changed"):
            identify(driven(spec, still, noise=noise), spec)


@pytest.mark.slow
def test_constant_commands_are_refused_instead_of_predicting_nonsense(car):
    commands = np.tile([0.1, -0.5], (1500, 1))
    with pytest.raises(FitError, match="no command ever changed"):
        identify(replace(driven(car, commands), state=None), car)
    started = driven(
        car, commands
    )  # the start of the drive moved the state, and no command
    found = identify(started, car)
    assert {"speed_command", "steering_command"} <= set(found.fit.unmoved)
    assert said(found, "Drive with")
    assert found.model.rates([0.1, -0.5, 0.1, -0.5])[2] == pytest.approx(
        -0.273, abs=0.01
    )
    with pytest.raises(
        FitError, match="speed_command and steering_command never moved"
    ):
        identify(started, car, strict=True)


def test_one_sample_is_refused(car):
    recording = driven(car, random_commands(car, 1))
    with pytest.raises(RecordingError, match="has 1 samples"):
        identify(recording, car)


@pytest.mark.parametrize("count", [2, 5, 19, 60])
def test_too_short_a_drive_is_refused(car, count):
    with pytest.raises(
        (FitError, RecordingError), match=r"too few|usable intervals|overlap|rec"
    ):
        identify(driven(car, random_commands(car, count)), car)


def test_repeated_rows_are_left_out_and_change_nothing(car):
    once = drive(car, duration=20.0)
    again = {
        name: Stream(np.repeat(s.t, 2), np.repeat(s.values, 2, axis=0), s.clock)
        for name, s in once.streams.items()
    }
    plain = identify(once, car)
    twice = identify(Recording(**again), car)
    assert said(twice, "repeat the row before them")
    assert twice.model.named.terms == plain.model.named.terms


def test_rows_of_nan_are_refused_with_their_place(car):
    recording = driven(car, random_commands(car))
    values = recording.pose.values.copy()
    values[30] = np.nan
    with pytest.raises(RecordingError, match="pose: row 30 holds NaN"):
        identify(replace(recording, pose=replace(recording.pose, values=values)), car)


def test_time_that_runs_backwards_is_refused_with_its_place(car):
    recording = driven(car, random_commands(car))
    t = recording.pose.t.copy()
    t[50:] -= 0.5
    with pytest.raises(RecordingError, match="time runs backwards at row 50"):
        identify(replace(recording, pose=replace(recording.pose, t=t)), car)


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
    recording = driven(car, random_commands(car))
    one = getattr(recording, stream)
    values = one.values.copy()
    values[:, column] *= factor
    with pytest.raises(RecordingError, match="must be in"):
        identify(replace(recording, **{stream: replace(one, values=values)}), car)


@pytest.mark.parametrize("name", ["ackermann", "differential"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_reversed_axis_of_the_pose_is_refused(name, axis):
    spec = load_robot(name)
    recording = driven(spec, random_commands(spec), noise=(5e-4, 1e-3))
    values = recording.pose.values.copy()
    values[:, axis] *= -1.0
    with pytest.raises(RecordingError, match="one of x, y and heading is reversed"):
        identify(replace(recording, pose=replace(recording.pose, values=values)), spec)


def test_the_heading_of_a_compass_is_refused_with_the_line_to_write(car):
    """On a wide curve the course is nearly steady with the wrong heading, too."""
    t = np.arange(0.0, 60.0, 0.02)
    recording = driven(car, np.stack([0.8 + 0.0 * t, 0.1 * np.sin(0.35 * t)], axis=1))
    values = recording.pose.values.copy()
    values[:, 2] = np.pi / 2.0 - values[:, 2]
    with pytest.raises(
        RecordingError, match=r"heading: {from: ..., scale: -1, offset: 1.5708}"
    ):
        check_axes(
            Drive(replace(recording, pose=replace(recording.pose, values=values)), car)
        )


def test_a_reversed_axis_of_a_robot_that_moves_sideways_is_not_silent(mecanum):
    recording = driven(mecanum, random_commands(mecanum))
    values = recording.pose.values * [1.0, -1.0, 1.0]
    mirrored = replace(recording, pose=replace(recording.pose, values=values))
    with pytest.raises(RecordingError, match="one of x, y and heading is reversed"):
        identify(mirrored, mecanum)


def test_a_whole_mirror_image_is_told(car):
    recording = driven(car, random_commands(car))
    values = recording.pose.values * [1.0, -1.0, -1.0]
    found = identify(
        replace(recording, pose=replace(recording.pose, values=values)), car
    )
    assert said(found, "turns right where steering_command is positive")
    assert not conclude(found).ready
    upright = identify(recording, car)
    assert not said(upright, "turns right")


def test_commands_beyond_the_limits_are_held_there_and_told(differential):
    commands = random_commands(differential) * [3.0, 1.5]
    found = identify(driven(differential, commands), differential)
    assert said(found, "forward_command was beyond the robot's limits, -0.5 to 1 m/s")
    terms = found.model.named.terms
    assert terms["d_left_wheel"]["left_wheel"] == pytest.approx(
        -9.06, abs=0.1
    )  # dt is 20 ms
    assert found.fit.r2[3:].min() > 0.999


def test_two_valued_commands_are_told(differential):
    rng = np.random.default_rng(0)
    held = rng.integers(0, 2, (60, 2)) * [1.0, 4.0] - [0.0, 2.0]
    found = identify(driven(differential, np.repeat(held, 25, axis=0)), differential)
    assert said(found, "took only two values")
    assert harmless(found, differential)


def test_a_robot_that_does_not_follow_its_commands_is_not_trusted(differential):
    recording = driven(differential, random_commands(differential))
    other = random_commands(differential, seed=9)
    found = identify(
        replace(recording, command=replace(recording.command, values=other)),
        differential,
    )
    assert said(found, "does not follow the commands") or said(found, "did not follow")


def test_commands_that_always_move_together_are_named(differential):
    commands = random_commands(differential)
    commands[:, 1] = 2.0 * commands[:, 0]
    recording = driven(differential, commands)
    found = identify(recording, differential)
    assert said(found, "forward_command and turn_command always moved together")
    assert harmless(found, differential)
    with pytest.raises(
        FitError, match="forward_command and turn_command always moved together"
    ):
        identify(recording, differential, strict=True)


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_a_good_drive_passes_the_strict_checks(name):
    spec = load_robot(name)
    found = identify(driven(spec, random_commands(spec, 2500)), spec, strict=True)
    assert not said(found, "never moved")
    assert not said(found, "reversed")


def test_a_model_of_every_partial_drive_stays_finite(car):
    """Nothing diverges when a partial model is driven over the whole range of its commands."""
    for column, value in ((0, 0.5), (1, 0.0), (1, 0.3)):
        commands = random_commands(car)
        commands[:, column] = value
        model = identify(driven(car, commands), car).model
        poses = np.zeros((1, 501, 3))
        states = np.zeros((1, 501, 2))
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            simulate_rollouts(
                poses,
                states,
                random_commands(car, 500, seed=5)[None],
                make_terms(model),
                SERIES,
                model.dt,
            )
        assert np.abs(poses[0, :, :2]).max() < 20.0


def test_where_predictions_run_away_the_model_is_linear(monkeypatch):
    """Each half second of commands comes late by another time, as over a bad link."""
    monkeypatch.setattr(acceptance, "loses_to_textbook", lambda judgement: False)
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
    assert verdict.LINEAR in found.notes
    assert (found.model.powers.sum(axis=1) <= 1).all()
    assert found.held_out.mean_position_error_m < 0.25 * found.held_out.mean_path_m
