"""Outliers and missing rows: the model must be that of the same drive without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify import planted
from identify.drives import (
    NOISE,
    drive,
    fit_whole,
    scale,
    tricycle,
    with_values,
    without,
)
from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.alignment import align
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Doubt, Drive, Gap, Mistake
from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.repair import (
    check_axes,
    check_commands,
    check_encoders,
    check_units,
    repair_rows,
)
from nics_drl_bridge.recording.recording import (
    Recording,
    Samples,
    Stream,
    samples_on_one_clock,
)
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, load_robot

ROBOTS = ("ackermann", "differential", "mecanum")


def some(recording: Recording, keep: dict[str, np.ndarray]) -> Recording:
    """Rows of streams that are kept."""
    streams = {
        name: replace(stream, t=stream.t[keep[name]], values=stream.values[keep[name]])
        for name, stream in recording.streams.items()
    }
    return replace(recording, **streams)


def with_jumps(recording: Recording, share: float = 0.05, seed: int = 0) -> Recording:
    """Jumps of the pose by half a metre and a radian, of the state by its range."""
    rng = np.random.default_rng(seed)
    for name, size in (("pose", np.array([0.5, 0.5, 1.0])), ("state", None)):
        stream = getattr(recording, name)
        size = np.ptp(stream.values, axis=0) if size is None else size
        bad = rng.random(len(stream.t)) < share
        values = stream.values.copy()
        values[bad] += rng.normal(size=(bad.sum(), len(size))) * size
        recording = with_values(recording, **{name: values})
    return recording


def same_motion(a, b, share: float) -> None:
    """The rates of two models differ by less than a share of their size, at clean samples."""
    rates = a.model.rates(b.samples.x)
    others = b.model.rates(b.samples.x)
    apart = np.sqrt(((rates - others) ** 2).mean(axis=0))
    assert (
        apart <= share * np.maximum(np.sqrt((others**2).mean(axis=0)), 1e-2)
    ).all(), apart


@pytest.mark.parametrize(
    ("name", "noise"),
    list(zip(ROBOTS, [(2e-3, 5e-3), (0.0, 0.0), NOISE], strict=True)),
)
def test_a_recording_without_faults_is_not_touched(name, noise):
    spec = load_robot(name)
    whole = Drive(drive(spec, duration=20.0, noise=noise), spec)
    found, notes = repair_rows(whole)
    assert notes == ()
    assert found is whole


@pytest.mark.parametrize(
    ("name", "jump"),
    list(
        zip(ROBOTS, [(0.4, -0.5, 0.0), (0.0, 0.0, 1.0), (30.0, 0.0, -2.0)], strict=True)
    ),
)
def test_a_drive_goes_on_after_a_jump_of_the_localiser_as_it_moved(name, jump):
    spec = load_robot(name)
    plain = drive(spec, duration=20.0, noise=NOISE)
    late = plain.pose.t > 12.0
    values = plain.pose.values.copy()
    values[late] = geometry.compose(np.array(jump), values[late])
    jumped = Drive(with_values(plain, pose=values), spec)
    found, (note,) = repair_rows(jumped)
    assert "jumps at 12.01 s (" in note
    assert "the drive is split there" in note
    moved, true = (
        geometry.between(v[:-1], v[1:]) for v in (found.recording.pose.values, values)
    )
    k = int(np.argmax(late)) - 1
    assert np.delete(moved, k, axis=0) == pytest.approx(
        np.delete(true, k, axis=0), abs=1e-9
    )
    assert np.abs(moved[k, :2]).max() < 0.03


def test_a_gap_in_the_poses_is_no_jump(differential):
    gappy = without(drive(differential, duration=20.0, noise=NOISE), 8.0, 11.0)
    assert repair_rows(Drive(gappy, differential))[1] == ()


def held(recording: Recording, begin: float, end: float) -> Recording:
    """The pose keeps its value of `begin` up to `end`, as of a tracker that lost the robot."""
    t = recording.pose.t
    values = recording.pose.values.copy()
    lost = (t > begin) & (t < end)
    values[lost] = values[np.flatnonzero(lost)[0] - 1]
    return with_values(recording, pose=values)


def test_a_pose_that_was_held_is_left_out_and_told(differential):
    plain = drive(differential, duration=20.0, noise=NOISE)
    mended, notes = repair_rows(Drive(held(plain, 8.0, 11.0), differential))
    (told,) = notes
    assert "keeps one value from 8.0 s to 11.0 s and then leaps by" in told
    t = mended.recording.pose.t
    assert np.diff(t).max() == pytest.approx(3.0, abs=0.1)


def test_a_drive_ends_where_its_pose_froze_though_commands_went_on(differential):
    plain = drive(differential, duration=20.0, noise=NOISE)
    frozen = held(plain, 16.0, 99.0)
    mended, (told,) = repair_rows(Drive(frozen, differential))
    assert isinstance(told, Gap)
    assert "keeps one value from 16.0 s to 20.0 s, though commands" in told
    assert mended.duration_s == pytest.approx(16.0, abs=0.05)
    values = np.where(frozen.command.t[:, None] > 16.0, 0.0, frozen.command.values)
    parked = with_values(frozen, command=values)
    mended, notes = repair_rows(Drive(parked, differential))
    assert mended.recording is parked
    assert notes == ()


def test_a_robot_that_stood_and_goes_on_from_there_was_not_held(differential):
    plain = drive(differential, duration=20.0)
    t = plain.pose.t
    values = plain.pose.values
    later = np.maximum(np.minimum(t, 8.0), t - 3.0)  # it stands from 8 s to 11 s
    stood = np.stack([np.interp(later, t, each) for each in values.T], axis=1)
    paused = with_values(plain, pose=stood)
    notes = repair_rows(Drive(paused, differential))[1]
    assert not any("keeps one value" in note for note in notes)


def test_steering_in_degrees_is_refused_though_the_limits_are_those_recorded():
    angles = np.degrees(1.1) * np.sin(np.arange(500))
    plain = drive(tricycle(), duration=5.0)
    command = replace(plain.command, values=np.stack([0.0 * angles, angles], axis=1))
    limits = {"speed_command": (-1.0, 1.0), "steering_command": (-64.0, 64.0)}
    spec = build_robot({"kind": "tricycle", "footprint_radius": 0.6}, limits)
    with pytest.raises(
        RecordingError, match=r"write `steering_command: {from: ..., unit: deg}`"
    ):
        check_units(Drive(replace(plain, command=command), spec))


@pytest.mark.parametrize(
    ("name", "pair", "rotation", "ahead"),
    [
        ("ackermann", (0, 1), 0.4, 0.0),
        ("differential", (0, 1), 0.4, 0.4),
        ("mecanum", (0, 1), 0.4, 0.4),
        ("mecanum", (0, 2), 0.0, 0.4),
        ("mecanum", (1, 2), 0.4, 0.4),
    ],
)
def test_swapped_commands_are_refused_by_what_they_move(name, pair, rotation, ahead):
    spec = load_robot(name)
    plain = drive(spec, pose_clock_ahead=ahead, rotation=rotation)
    assert check_commands(Drive(plain, spec)) == ()
    values = plain.command.values.copy()
    values[:, pair] = values[:, pair[::-1]]
    one, other = (spec.command[k].name for k in pair)
    with pytest.raises(
        RecordingError, match=f"{one} and {other} are swapped: each moves"
    ):
        check_commands(Drive(with_values(plain, command=values), spec))


@pytest.mark.parametrize(("rotation", "place"), [(0.8, 0), (0.0, 1), (np.pi, 0)])
def test_a_reversed_command_of_a_robot_that_moves_sideways_is_told(place, rotation):
    spec = load_robot("mecanum")
    plain = drive(spec, pose_clock_ahead=0.4, rotation=rotation, noise=(2e-3, 3e-3))
    turned = scale(plain, command=np.where(np.arange(3) == place, -1.0, 1.0))
    (note,) = check_commands(Drive(turned, spec))
    assert isinstance(note, Mistake)
    assert note.startswith(
        "The robot moves right where left_command is positive, or back where"
    )
    assert check_commands(Drive(plain, spec)) == ()


@pytest.mark.parametrize("rotation", [np.pi / 2, -np.pi / 2])
def test_a_mount_that_is_turned_by_90_degrees_is_no_swap(mecanum, rotation):
    assert check_commands(Drive(drive(mecanum, rotation=rotation), mecanum)) == ()


def test_a_reversed_heading_is_refused_though_noise_hides_short_ways(differential):
    """At rest and between rows 6 mm apart, 2 mm of noise lead anywhere."""
    t = np.arange(0.0, 90.0, 0.02)
    rng = np.random.default_rng(1)
    speed, turn = (np.repeat(rng.uniform(-a, a, 60), 75) for a in (0.3, 1.5))
    moved = np.stack([speed, 0.0 * t, turn], axis=1) * 0.02
    pose = [np.zeros(3)]
    for each in geometry.exp(moved[:-1]):
        pose.append(geometry.compose(pose[-1], each))
    values = np.stack(pose) + rng.normal(size=(len(t), 3)) * [2e-3, 2e-3, 3e-3]
    made = Recording(Stream(t, np.stack([speed, turn], axis=1)), Stream(t, values))
    check_axes(Drive(made, differential))
    with pytest.raises(
        RecordingError, match=r"write `heading: {from: ..., scale: -1}`"
    ):
        check_axes(Drive(scale(made, pose=[1.0, 1.0, -1.0]), differential))


def test_two_commands_a_quarter_of_a_period_apart_are_not_swapped(differential):
    """Late by as much, each goes as the other does."""
    t = np.arange(0.0, 60.0, 0.02)
    turn = 2.0 * np.pi / 3.8
    asked, moved = (
        np.stack([0.5 * np.sin(turn * since), np.cos(turn * since)], axis=1)
        for since in (t, t - 0.05)
    )
    heading = np.cumsum(moved[:, 1]) * 0.02
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1) * moved[:, :1] * 0.02
    pose = Stream(t, np.column_stack([np.cumsum(ahead, axis=0), heading]), "robot")
    made = Recording(Stream(t, asked, "robot"), pose, source="drive")
    assert check_commands(Drive(made, differential)) == ()


def test_a_throttle_and_a_steering_that_are_swapped_are_refused_beyond_their_limits():
    limits = {"throttle": (-1.0, 1.0), "steering": (-1.0, 1.0)}
    kind = {"kind": "ackermann_throttle", "footprint_radius": 0.2}
    spec = build_robot(kind, limits)
    plain = drive(load_robot("ackermann"), measured_state=False)
    assert check_commands(Drive(plain, spec)) == ()
    swapped = with_values(plain, command=100.0 * plain.command.values[:, ::-1])
    with pytest.raises(RecordingError, match="throttle and steering are swapped"):
        identify(swapped, spec)


@pytest.mark.parametrize(
    ("column", "unit", "times"), [(0, "km/h", 3.6), (1, "deg/s", 57.3)]
)
def test_a_speed_that_another_unit_explains_is_told(differential, column, unit, times):
    plain = drive(differential, latency=0.2)
    other = scale(plain, command=np.where(np.arange(2) == column, times, 1.0))
    (note,) = check_commands(Drive(other, differential))
    assert f"if they are in {unit}, write `unit: {unit}`" in note
    assert isinstance(note, Mistake)


def test_a_robot_that_skids_is_told_from_a_wrong_scale(differential):
    lengths = {"track": 0.5, "effective_track": 1.25, "wheel_radius": 0.1}
    kind = {"kind": "skid_steer", "footprint_radius": 0.4, "parameters": lengths}
    skidding = drive(build_robot(kind), measured_state=False)
    (note,) = check_commands(Drive(skidding, build_robot(kind)))
    assert "turns 0.4 times as fast" in note
    assert "`effective_track: 1.2" in note
    (doubt,) = check_commands(Drive(skidding, differential))
    assert isinstance(doubt, Doubt)


def test_wheels_in_rpm_are_told_if_their_radius_is_known():
    parameters = {"wheel_radius": 0.05, "track": 0.3, "wheel_lag": 0.1}
    wheels = {"kind": "differential_wheels", "footprint_radius": 0.2}
    known = build_robot(wheels | {"parameters": parameters})
    unknown = build_robot(wheels)
    plain = drive(known, measured_state=False)
    assert check_commands(Drive(plain, known)) == ()
    other = scale(plain, command=9.55)
    assert "write `unit: rpm` beside `from:`" in check_commands(Drive(other, known))[0]
    assert check_commands(Drive(other, unknown)) == ()


def by_wheels() -> tuple[Recording, RobotSpec]:
    """A drive whose commands are the measured wheels, tracked at a point ahead of the axle."""
    given = {
        "kind": "differential_wheels",
        "footprint_radius": 0.25,
        "parameters": {
            "wheel_radius": planted.WHEEL_RADIUS_M,
            "track": planted.TRACK_M,
        },
    }
    whole = planted.wheeled_drive()
    ahead = geometry.compose(whole.pose.values, np.array([0.2, 0.0, 0.0]))
    recording = with_values(whole, pose=ahead)
    spec = build_robot(given, {})
    return replace(recording, command=whole.state, state=None), spec


def test_an_encoder_that_counts_backwards_is_named_though_it_is_the_command():
    recording, spec = by_wheels()
    assert check_encoders(Drive(recording, spec)) == ()
    for signs, names in (((-1.0, 1.0), ["left_wheel"]), ((1.0, -1.0), ["right_wheel"])):
        told = check_encoders(Drive(scale(recording, command=signs), spec))
        assert [note.split()[0] for note in told] == names
        assert all("its encoder counts backwards; write `scale: -1`" in n for n in told)
        assert all(isinstance(note, Mistake) for note in told)


@pytest.mark.parametrize("inputs", ["wheels", "measured wheels", "twists"])
def test_inputs_tell_a_clockwise_heading_of_a_point_ahead_of_the_axle(inputs):
    recording, spec = by_wheels()
    if inputs != "wheels":
        spec = planted.wheeled()
        recording = replace(planted.wheeled_drive(), pose=recording.pose)
    if inputs == "twists":
        spec = spec.model_copy(update={"state": ()})
        recording = replace(recording, state=None)
    check_axes(Drive(recording, spec))
    with pytest.raises(
        RecordingError, match=r"heading counted clockwise write .*scale: -1\}"
    ):
        check_axes(Drive(scale(recording, pose=[1.0, 1.0, -1.0]), spec))


@pytest.mark.slow
def test_a_noisy_fit_survives_both(differential):
    rng = np.random.default_rng(2)
    plain = drive(differential, duration=30.0, noise=NOISE, latency=0.05)
    keep = {n: rng.random(len(s.t)) > 0.1 for n, s in plain.streams.items()}
    keep["command"][:] = True
    clean = fit_whole(plain, differential, order=1)
    faulty = fit_whole(some(with_jumps(plain), keep), differential, order=1)
    same_motion(faulty, clean, 0.03)
    assert faulty.calibration.command_latency_s == pytest.approx(0.05, abs=3e-3)


def test_a_gap_is_no_step():
    t = np.array([0.0, 0.1, 0.2, 0.5, 0.6, 0.6, 0.7])
    pose = np.stack([t, 0.0 * t, 0.0 * t], axis=1)
    samples = samples_on_one_clock(t, pose, t[:, None], np.zeros((7, 1)))
    assert samples.t == pytest.approx([0.0, 0.1, 0.5, 0.6])
    assert samples.dt == pytest.approx(0.1)
    assert np.allclose(samples.dq, [1.0, 0.0, 0.0, 1.0])


def test_steps_of_unequal_length_have_their_own():
    t = np.cumsum(np.array([0.1, 0.11, 0.09, 0.1, 0.12, 0.08, 0.1, 0.1]))
    pose = np.stack([2.0 * t, 0.0 * t, 0.0 * t], axis=1)
    samples = samples_on_one_clock(t, pose, t[:, None], np.zeros((8, 1)))
    assert np.allclose(samples.dq[:, 0], 2.0)
    assert np.allclose(samples.dq[:, 3], 1.0)


def test_rows_of_samples_that_jump_are_left_out_of_the_fit(car):
    samples = align(Drive(drive(car, noise=(0.0, 0.0)), car), Calibration())
    rng = np.random.default_rng(3)
    bad = rng.random(len(samples.t)) < 0.05
    dq = samples.dq.copy()
    x = samples.x.copy()
    dq[bad] += rng.normal(size=(bad.sum(), 5)) * 30.0 * samples.dq.std(axis=0)
    x[bad[::-1], 0] += 40.0
    clean = fit(samples, car)
    faulty = fit(Samples(samples.t, samples.q, x, dq, samples.dt), car)
    terms = faulty.model.named.terms
    others = clean.model.named.terms
    for dof in ("vx", "d_speed", "d_steering"):
        assert terms[dof] == pytest.approx(others[dof], rel=1e-5)
    assert terms["wz"]["speed*steering"] == pytest.approx(
        others["wz"]["speed*steering"], rel=0.05
    )
    assert 0.02 < faulty.outliers[0] < 0.12
    assert clean.outliers == pytest.approx(0.0)


def test_a_stream_that_is_mixed_of_two_is_refused(car):
    recording = drive(car, duration=20.0)
    values = recording.pose.values.copy()
    values[::5, :2] += 0.5
    with pytest.raises(RecordingError, match="two sources mixed"):
        identify(with_values(recording, pose=values), car)


@pytest.mark.slow
def test_noise_of_the_measured_state_does_not_bend_its_lag(differential):
    plain = drive(differential, noise=NOISE)
    noise = np.random.default_rng(0).normal(size=plain.state.values.shape) * 0.2
    recording = with_values(plain, state=plain.state.values + noise)
    model = fit_whole(recording, differential, order=1).model
    value = model.named.terms["d_left_wheel"]["left_wheel"]
    error = model.named_errors["d_left_wheel"]["left_wheel"]
    assert error < 0.2
    assert abs(value - (np.exp(-0.1) - 1.0) / 0.01) < 3.0 * error
