"""Repair of a drive: faulty rows, jumps, commands, heading; refuses wrong units and axes."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import (
    average_between_stamps,
    average_held,
    select_moved_commands,
)
from nics_drl_bridge.identify.drive import Doubt, Drive, Gap, Mistake, unwrap_headings
from nics_drl_bridge.identify.forms import list_driving_commands
from nics_drl_bridge.identify.statistics import compute_unexplained
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.heading import (
    CLEARLY,
    WINDOW_S,
    Turning,
    compare_turning,
    turn_by_gyro,
)
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.recording import HeadingKeys, Recording
from nics_drl_bridge.recording.stamping import select_new_rows
from nics_drl_bridge.robot.kinds import has_textbook, slips, textbook
from nics_drl_bridge.robot.spec import (
    FARTHEST_STEERED,
    CommandVariable,
    RobotSpec,
    StateVariable,
)

# number of samples on either side whose median difference measures a jump
NEIGHBOURS = 3
STEPS = 6.0  # a jump exceeds this many usual changes from sample to sample
# percentile that counts as usual: jumps in 20 % of the rows affect 40 % of the changes
USUAL = 60.0
REACH = 1.5  # this many times the distance that the maximum command allows in that time
HEADING_REACH = 0.1  # this angle [rad], for a heading
STATE_SHARE = 0.2  # and this fraction of the usual range, for a state
# A localiser jumps permanently where a step differs from the surrounding motion by more than
# this many times the distance at the speed (turn rate) that 95 % of the drive stays below
FARTHER = 3.0
SPEED_OVER_S = 0.5  # over this time
UNUSUAL = 12.0  # this many usual differences (`USUAL`)
# and this fraction of the robot's radius, or this angle [rad]
JUMP_SHARE = 0.5
JUMP_TURN = 0.3
AROUND = 5  # number of steps on either side
MOST_LISTED = 3  # maximum number of jumps to report individually
MOST_JUMPS = 0.02  # fraction of the steps above which jumps are noise
# fraction of the rows above which jumps are not faults of single samples
MOST = 0.15
HELD_S = 0.5  # a pose that keeps one value for longer, and then leaps, was frozen
# and one that does so to the end, while commands ask for this fraction of their maximum
ASKS = 0.1
EXCESS = 0.01  # commands may exceed their limits by this fraction of their range
# ratio to the limit that suggests another unit: degrees give 57, rpm 9.5
WRONG_UNIT = 5.0
UNIT_PERCENTILE = 75.0
STEERED_PERCENTILE = 95.0
# Commands are compared with the motion over this time [s], at least this many times, for any delay
# and clock offset;
DELAYS_S = np.linspace(-1.0, 1.5, 26)
COMPARED_S = 1.0
MIN_COMPARED = 20
# from this correlation on, another unit may explain ratios up to this one
ALIKE = 0.85
NEAR = 1.2
# ratio to the commanded speed that is not just slip or a worn wheel
SCALED = 1.5
MOST_SKID = 6.0  # ratio of the commanded to the measured turn up to which a robot skids
# a pose that stays within these,
STANDING_M = 1e-3
STANDING_RAD = 2e-3
# or within this many times its noise, never moved
FROZEN = 12.0
# minimum correlation of each of two commands with what the other should move
SWAPPED = 0.6
# indices in speed and turn rate
PLACES = {"linear.x": 0, "angular.z": 1, "throttle": 0, "steering": 1}
# commands of a robot that moves sideways
SIDEWAYS = ("linear.x", "linear.y", "angular.z")
CONFUSED = {"m/s": ("km/h", "cm/s", "mm/s"), "rad/s": ("deg/s", "rpm")}
# Minimum distance for measuring a direction of travel, in footprint radii and in noise of the pose
TRAVEL_SHARE = 0.1
TRAVEL_NOISE = 25.0


def repair_rows(drive: Drive) -> tuple[Drive, tuple[str, ...]]:
    """Drops rows, joins at jumps, clips commands; returns a sentence on each kind of fault."""
    notes: list[str] = []
    for repair in (
        _drop_repetitions,
        _drop_held_poses,
        _drop_outliers,
        _join_at_jumps,
        _clip_commands,
    ):
        drive = drive.part(repair(drive, notes))
    return drive, tuple(notes)


def _select_rows(
    recording: recordings.Recording, name: str, keep: NDArray[np.bool_]
) -> recordings.Recording:
    parts: Any = {name: recording.streams[name].rows(keep)}
    return replace(recording, **parts)


def _drop_repetitions(drive: Drive, notes: list[str]) -> recordings.Recording:
    recording = drive.recording
    for name, stream in recording.streams.items():
        keep, note = select_new_rows(stream.t, stream.values, name)
        if note:
            recording = _select_rows(recording, name, keep)
            notes.append(note)
    return recording


def _drop_held_poses(drive: Drive, notes: list[str]) -> recordings.Recording:
    """Removes poses frozen where tracking was lost, which leaves a gap or ends the drive.

    A robot at rest also keeps its place, but continues from there.
    """
    recording = drive.recording
    t = drive.sample_t
    pose = recording.pose.values
    if len(t) < 2:
        return recording
    reach = REACH * _find_largest_speed(drive.spec) * np.diff(t)
    leap = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    kept = np.ones(len(t), dtype=np.bool_)
    for begin, end in _find_held_poses(t, pose):
        span = f"from {t[begin] - t[0]:.1f} s to {t[end] - t[0]:.1f} s"
        finding = f"The pose keeps one value {span}"
        if end < len(t) - 1:
            if leap[end] <= max(reach[end], 1e-6):
                continue
            cause = "as if tracking was lost: these rows were left out"
            # another note reports the gap
            notes.append(f"{finding} and then leaps by {leap[end]:.2f} m, {cause}.")
        elif _is_first_stop(pose, begin) and _asks_to_move(drive, float(t[begin])):
            cause = "though commands ask the robot to move, as if tracking was lost"
            notes.append(Gap(f"{finding}, {cause}: the drive ends there."))
        else:
            continue
        kept[begin + 1 : end + 1] = False
    return recording if kept.all() else _select_rows(recording, "pose", kept)


def _find_held_poses(t: Array, pose: Array) -> list[tuple[int, int]]:
    """Returns first and last rows of poses (T, 3) that keep one value for a while."""
    # Each run of equal poses begins with one that moved, and ends before the next.
    moved = np.append(True, (pose[1:] != pose[:-1]).any(axis=1))
    begins = np.flatnonzero(moved)
    ends = np.append(begins[1:], len(t)) - 1
    runs = zip(begins.tolist(), ends.tolist(), strict=True)
    return [(a, b) for a, b in runs if b > a and t[b] - t[a] >= HELD_S]


def _is_first_stop(pose: Array, begin: int) -> bool:
    """True if poses (T, 3) changed from row to row up to one."""
    return bool(np.diff(pose[:begin], axis=0).any(axis=1).all())


def _asks_to_move(drive: Drive, after_s: float) -> bool:
    """True if commands ask the robot to move after a time of its poses [s]."""
    pose = drive.recording.pose
    command = drive.recording.command
    if pose.clock != command.clock:
        return False
    driving = list_driving_commands(drive.spec)
    columns = [c.name in driving for c in drive.spec.command]
    asked = np.abs(command.values[:, columns])
    late = asked[(command.t > after_s) & (command.t < pose.t[-1])]
    return bool(len(late)) and bool(
        (late.mean(axis=0) > ASKS * asked.max(axis=0)).any()
    )


def _find_largest_speed(spec: RobotSpec) -> float:
    """Returns the largest magnitude of the commands that do not turn the robot; 0 without any."""
    sizes = [max(abs(c.min), abs(c.max)) for c in spec.command if not c.turns]
    return max(sizes, default=0.0)


def _drop_outliers(drive: Drive, notes: list[str]) -> recordings.Recording:
    recording = drive.recording
    jumps = {"pose": _find_pose_jumps(drive)}
    if recording.state is not None and drive.spec.state:
        jumps["state"] = _find_state_jumps(recording.state)
    for name, jump in jumps.items():
        if not jump.any():
            continue
        share = float(jump.mean())
        finding = "jump away from their neighbours and back"
        if share > MOST:
            fault = f"{recording.source}: {name}: {share:.0%} of the rows {finding}"
            raise RecordingError(f"{fault}; look for two sources mixed in one stream.")
        recording = _select_rows(recording, name, ~jump)
        rows = f"{name}: {int(jump.sum())} of {len(jump)} rows ({share:.1%})"
        notes.append(f"{rows} {finding}, and were left out as outliers.")
    return recording


def _find_pose_jumps(drive: Drive) -> NDArray[np.bool_]:
    pose = drive.recording.pose
    spec = drive.spec
    t = drive.sample_t
    span = np.zeros(len(t))
    span[NEIGHBOURS:] = t[NEIGHBOURS:] - t[:-NEIGHBOURS]
    span[:-NEIGHBOURS] = np.maximum(
        span[:-NEIGHBOURS], t[NEIGHBOURS:] - t[:-NEIGHBOURS]
    )
    reach = np.maximum(REACH * _find_largest_speed(spec) * span, 1e-6)
    out = [_select_outliers(pose.values[:, i], reach) for i in (0, 1)]
    turns = np.maximum(HEADING_REACH, reach / max(spec.footprint_radius, 1e-3) / 2.0)
    return out[0] | out[1] | _select_outliers(pose.values[:, 2], turns, turning=True)


def _find_state_jumps(state: recordings.Stream) -> NDArray[np.bool_]:
    out = np.zeros(len(state.t), dtype=np.bool_)
    for column in state.values.T:
        low, high = np.percentile(column, (5.0, 95.0))
        out |= _select_outliers(
            column, np.full(len(column), max(STATE_SHARE * (high - low), 1e-9))
        )
    return out


def _join_at_jumps(drive: Drive, notes: list[str]) -> recordings.Recording:
    """Moves all poses after a localiser jump to where the motion before it leads."""
    recording = drive.recording
    t = drive.sample_t
    pose = recording.pose.values
    if len(t) < 2 * AROUND + 2:
        return recording
    expected, apart = _compare_steps(t, pose)
    jump = (apart > _limit_steps(drive, apart)).any(axis=0)
    if not jump.any() or jump.mean() > MOST_JUMPS:
        return recording
    joined = pose.copy()
    for k in np.flatnonzero(jump):
        here = geometry.compose(joined[k], geometry.exp(expected[k]))
        after = geometry.between(joined[k + 1], joined[k + 1 :])
        joined[k + 1 :] = geometry.compose(here, after)
    notes.append(_describe_jumps((t - t[0])[1:][jump], apart[:, jump]))
    return replace(recording, pose=replace(recording.pose, values=joined))


def _describe_jumps(t: Array, apart: Array) -> Gap:
    """Describes jumps of a pose at times (J,) [s], by distances (2, J) in m and rad."""
    descriptions = [
        f"at {time:.2f} s ({distance:.2f} m, {angle:.2f} rad)"
        for time, distance, angle in zip(t, *apart, strict=True)
    ]
    places = ", ".join(descriptions[:MOST_LISTED])
    if len(descriptions) > MOST_LISTED:
        places += f" and {len(descriptions) - MOST_LISTED} more"
    finding = f"jumps {places} as no speed of this robot explains"
    split = "the drive is split there and continues from where it was before"
    return Gap(f"pose: {finding}; {split}.")


def _compare_steps(t: Array, pose: Array) -> tuple[Array, Array]:
    """Returns the usual motion (T - 1, 3) around each step, and how far it is from that (2, T - 1).

    The distances are in m and rad.
    """
    span = np.diff(t)[:, None]
    moved = geometry.log(geometry.between(pose[:-1], pose[1:]))
    around = np.pad(moved / np.maximum(span, 1e-9), ((AROUND, AROUND), (0, 0)), "edge")
    windows = sliding_window_view(around, 2 * AROUND + 1, axis=0)
    expected = np.median(windows, axis=2) * span
    off = moved - expected
    return expected, np.stack([np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])])


def _limit_steps(drive: Drive, apart: Array) -> Array:
    """Returns the allowed difference of steps (2, T), in m and rad, from those around them."""
    t = drive.sample_t
    pose = unwrap_headings(drive.recording.pose.values)
    every = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], SPEED_OVER_S)))
    took = np.maximum(np.diff(t[every]), 1e-9)
    gone = np.abs(np.diff(pose[every], axis=0))
    rates = np.stack([np.hypot(*gone[:, :2].T), gone[:, 2]]) / took
    speeds = [
        max(abs(c.min), abs(c.max)) for c in drive.spec.command if c.unit == "m/s"
    ]
    fastest = np.percentile(rates, 95.0, axis=1) if len(took) else np.zeros(2)
    fastest[0] = max(fastest[0], REACH / FARTHER * max(speeds, default=0.0))
    floor = np.array([JUMP_SHARE * drive.spec.footprint_radius, JUMP_TURN])
    floor = np.maximum(floor, UNUSUAL * np.percentile(apart, USUAL, axis=1))
    return np.asarray(
        np.maximum(floor[:, None], FARTHER * fastest[:, None] * np.diff(t))
    )


def _select_outliers(
    values: Array, least: Array, turning: bool = False
) -> NDArray[np.bool_]:
    """Selects values (T,) that differ equally from both sides, by `least` and `STEPS` changes."""
    count = len(values)
    if count <= 2 * NEIGHBOURS:
        return np.zeros(count, dtype=np.bool_)
    back, ahead = np.zeros((2, NEIGHBOURS, count))  # differences; zero at the ends
    for n in range(1, NEIGHBOURS + 1):
        difference = values[n:] - values[:-n]
        difference = geometry.wrap_angle(difference) if turning else difference
        back[n - 1, n:] = difference
        ahead[n - 1, :-n] = -difference
    usual = float(np.percentile(np.abs(back[0][1:]), USUAL))
    before = np.median(back, axis=0)
    after = np.median(ahead, axis=0)
    apart = np.minimum(np.abs(before), np.abs(after))
    return np.asarray(
        (before * after > 0.0) & (apart > np.maximum(STEPS * usual, least))
    )


def _clip_commands(drive: Drive, notes: list[str]) -> recordings.Recording:
    """Clips commands to the robot's limits, unless the robot followed them beyond."""
    recording = drive.recording
    spec = drive.spec
    low = spec.command_low
    high = spec.command_high
    values = recording.command.values
    margin = EXCESS * (high - low)
    beyond = (values < low - margin) | (values > high + margin)
    if not beyond.any():
        return recording
    clipped = np.where(beyond, np.clip(values, low, high), values)
    if _measure_unexplained_rates(recording, values) < _measure_unexplained_rates(
        recording, clipped
    ):
        notes.append(
            "Commands were beyond the limits in the robot's YAML file, and the robot followed them "
            "there: widen the limits, or the simulator will not go so far."
        )
        return recording
    notes += [
        f"{c.name} was beyond the robot's limits, {c.min:g} to {c.max:g} {c.unit}, in {share:.0%} "
        "of the rows: it was clipped to them; the model does not cover the range beyond."
        for c, share in zip(spec.command, beyond.mean(axis=0), strict=True)
        if share > 0.0
    ]
    return replace(recording, command=replace(recording.command, values=clipped))


def _measure_unexplained_rates(
    recording: recordings.Recording, command: Array
) -> float:
    """Returns the fraction of the state's rates that commands do not explain; 0 without a state."""
    state = recording.state
    if state is None or len(state.t) < 2:
        return 0.0
    span = np.diff(state.t)
    keep = span > 0.0
    rates = np.diff(state.values, axis=0)[keep] / span[keep, None]
    row = np.searchsorted(recording.command.t, state.t[:-1][keep] + 1e-9, "right") - 1
    u = command[np.clip(row, 0, len(command) - 1)]
    chi = np.concatenate([state.values[:-1][keep], u], axis=1)
    return float((compute_unexplained(chi, rates) ** 2).mean())


def check_units(drive: Drive) -> None:
    """Refuses states and commands, with a RecordingError, that only another unit can explain."""
    recording = drive.recording
    spec = drive.spec
    _refuse_other_unit(recording, recording.command, spec.command)
    if recording.state is not None:
        _refuse_other_unit(recording, recording.state, spec.state)
    for variable, column in zip(spec.command, recording.command.values.T, strict=True):
        size = float(np.percentile(np.abs(column), STEERED_PERCENTILE))
        if variable.steers and size > FARTHEST_STEERED:
            fault = (
                f"{variable.name} is {size:.4g} rad or more, and no wheel steers so far"
            )
            line = f"{variable.name}: {{from: ..., unit: deg}}"
            advice = f"write `{line}` for degrees, or a `scale:` for a steering wheel"
            raise RecordingError(f"{recording.source}: {fault}; {advice}.")


def _refuse_other_unit(
    recording: Recording,
    stream: recordings.Stream,
    variables: tuple[CommandVariable, ...] | tuple[StateVariable, ...],
) -> None:
    """Refuses variables of a stream that are far beyond their limits (RecordingError)."""
    sizes = np.percentile(np.abs(stream.values), UNIT_PERCENTILE, axis=0)
    for variable, size in zip(variables, sizes, strict=True):
        limit = max(abs(variable.min), abs(variable.max))
        if size > WRONG_UNIT * limit:
            name = f"{recording.source}: {variable.name}"
            unit = variable.unit
            fault = f"is {size:.4g} or more, but its limit is {limit:g} {unit}"
            causes = "degrees, millimetres or revolutions per minute look like this"
            raise RecordingError(f"{name} {fault}; it must be in {unit} ({causes}).")


def check_commands(
    drive: Drive, command: recordings.Stream | None = None
) -> tuple[str, ...]:
    """Refuses swapped commands, with a RecordingError; reports other units and mirrored motion.

    Compares the speed and turn rate that commands ask for (or those before they were clipped) with
    the measured ones.
    """
    spec = drive.spec
    sent = command or drive.recording.command
    if spec.moves_sideways:
        return _check_sideways(drive, sent)
    compared = _compare_commands(drive, sent)
    if compared is None:
        return ()
    asked, driven, alike = compared
    places = _find_places(spec)
    if len(places) == 2:
        _check_swapped(drive, [0, 1], min(alike[0, 1], alike[1, 0]), np.trace(alike))
    ratios = asked.std(axis=0) / np.maximum(driven.std(axis=0), 1e-9)
    return tuple(_describe_scales(spec, ratios, np.diag(alike)))


def _describe_scales(spec: RobotSpec, ratios: Array, alike: Array) -> Iterator[str]:
    """Yields sentences on speed and turn rate whose ratios (2,) to the measured ones are odd.

    Ratios mean nothing where commands and motion are not `alike` (2,).
    """
    places = _find_places(spec)
    commands = [(c.name, c.unit) for c in spec.command]
    if not places:  # wheels
        places = [0]
        commands = [("speed", "rad/s")]
    for place, (name, unit) in zip(places, commands, strict=True):
        # a steering angle is not comparable with a turn rate
        if alike[place] <= ALIKE or unit not in CONFUSED:
            continue
        ratio = float(ratios[place])
        is_turn = unit == "rad/s" and len(places) == 2
        if is_turn and slips(spec) and SCALED < ratio < MOST_SKID:
            yield _describe_skid(spec, ratio)
        else:
            yield from _describe_ratio(name, unit, ratio)


def _describe_skid(spec: RobotSpec, ratio: float) -> str:
    """Describes how much less a robot turns than its wheels ask for, because it skids."""
    effective_track = ratio * spec.parameters["track"]
    finding = f"The robot turns {1.0 / ratio:.2g} times as fast as commanded, because it skids"
    return f"{finding}; in its file, `effective_track: {effective_track:.3g}` says so."


def _describe_ratio(name: str, unit: str, ratio: float) -> Iterator[str]:
    """Yields a sentence if the ratio of a commanded to the measured speed is far from 1."""
    for confused in CONFUSED[unit]:
        if 1.0 / NEAR < ratio * UNITS[confused].factor < NEAR:
            finding = f"The commands ask for {ratio:.3g} times the measured {name}"
            advice = f"write `unit: {confused}` beside `from:`"
            yield Mistake(f"{finding}: if they are in {confused}, {advice}.")
            return
    if not 1.0 / SCALED < ratio < SCALED:
        finding = (
            f"The commands consistently ask for {ratio:.3g} times the measured {name}"
        )
        causes = "the scale of this command, or that of the pose, is wrong"
        yield Doubt(f"{finding}: {causes}, or the robot's own driver scales it.")


def check_pose_moves(drive: Drive) -> None:
    """Refuses poses that stay in place while commands change (RecordingError)."""
    recording = drive.recording
    values = unwrap_headings(drive.recording.pose.values)
    if not select_moved_commands(recording.command).any():
        return
    position, heading = drive.pose_noise or (0.0, 0.0)
    reach = float(np.ptp(values[:, :2], axis=0).max())
    turn = float(np.ptp(values[:, 2]))
    stays = reach <= max(STANDING_M, FROZEN * position)
    stays &= turn <= max(STANDING_RAD, FROZEN * heading)
    if stays:
        fault = (
            f"stays within {reach:.2g} m and {turn:.2g} rad while the commands change"
        )
        advice = "check that it is this robot's, that it is alive, and that nothing held the robot"
        raise RecordingError(f"{recording.source}: pose: {fault}; {advice}.")


def check_encoders(drive: Drive) -> tuple[str, ...]:
    """Returns a sentence on each wheel that turns against the motion it causes.

    The wheels are those of the measured state, or else the commands.
    """
    spec = drive.spec
    if not has_textbook(spec):
        return ()
    has_state = drive.recording.state is not None
    variables = spec.state if has_state else spec.command
    if {v.unit for v in variables} != {"rad/s"}:
        return ()
    wheels = _average_inputs(drive, drive.dated.values)
    if wheels is None:
        return ()
    try:
        book = textbook(spec)
    except ConfigError:
        return ()
    unit_speeds = np.eye(len(variables))
    if has_state:
        per_wheel = book.twist(unit_speeds)  # (wheels, 3)
        fault = "its encoder counts backwards"
    else:
        per_wheel = book.compute_twist(unit_speeds)
        fault = "its sign is reversed, as if its encoder counts backwards"
    finding = "turns backwards where the robot drives ahead"
    return tuple(
        Mistake(f"{variables[i].name} {finding}: {fault}; write `scale: -1` for it.")
        for i in _find_reversed_wheels(*wheels, per_wheel)
    )


def _find_reversed_wheels(
    turned: Array, driven: Array, per_wheel: Array
) -> NDArray[np.intp]:
    """Returns the wheels, of those that turned (n, wheels), whose effect has the wrong sign.

    `driven` (n, 3) are the twists meanwhile, `per_wheel` (wheels, 3) those that they should cause.
    """
    effect, explained = _explain_motion(turned, driven)
    dofs = [d for d in (0, 2) if np.abs(per_wheel[:, d]).min() > 0.0]
    if not dofs or explained[dofs].min() < SWAPPED:
        return np.zeros(0, dtype=np.intp)
    is_reversed = (effect[:, dofs] * per_wheel[:, dofs] < 0.0).all(axis=1)
    return np.flatnonzero(is_reversed)


def _explain_motion(sent: Array, driven: Array) -> tuple[Array, Array]:
    """Returns the effect (K, D) of inputs (n, K), and the share (D,) of motions it explains."""
    effect = np.linalg.lstsq(sent, driven, rcond=1e-3)[0]
    rest = ((driven - sent @ effect) ** 2).mean(axis=0)
    power = np.maximum((driven**2).mean(axis=0), 1e-12)
    return np.asarray(effect), np.asarray(1.0 - rest / power)


def _average_inputs(
    drive: Drive, pose: Array, delay_s: float = 0.0
) -> tuple[Array, Array] | None:
    """Returns mean inputs (n, inputs) and the twists (n, 3) of poses (T, 3) meanwhile.

    The inputs are the measured speeds of the wheels, or else commands for the wheels or the twist,
    which act after a delay. None if they are others or on another clock, or for too few spans.
    """
    recording = drive.recording
    spec = drive.spec
    start, end, driven = _measure_twists(drive.dated.t, pose)
    state = recording.state
    if state is not None:
        are_wheels = {(v.unit, v.twist) for v in spec.state} == {("rad/s", None)}
        are_linear = are_wheels or spec.moves_sideways
        source = state
        inside = (start >= state.t[0]) & (end <= state.t[-1])
    else:
        are_wheels = all(c.unit == "rad/s" and not c.cmd_vel for c in spec.command)
        are_linear = are_wheels or all(c.is_twist for c in spec.command)
        source = recording.command
        inside = np.ones(len(start), dtype=np.bool_)
    if not are_linear or source.clock != recording.pose.clock:
        return None
    if inside.sum() < MIN_COMPARED:
        return None
    start, end, driven = (values[inside] for values in (start, end, driven))
    if state is not None:
        return average_between_stamps(state.t, state.values, start, end), driven
    sent = average_held(recording.command, spec, start - delay_s, end - delay_s)
    return sent, driven


def _check_swapped(
    drive: Drive, pair: list[int], crosswise: float, straight: float
) -> None:
    """Refuses two commands that correlate better with the other's motion than with their own."""
    if crosswise <= max(SWAPPED, straight):
        return
    first, second = (drive.spec.command[place].name for place in pair)
    fault = (
        f"{first} and {second} are swapped: each moves the robot like the other should"
    )
    advice = f"write the column of `{second}:` after `{first}:`, and vice versa"
    raise RecordingError(f"{drive.recording.source}: {fault}; {advice}.")


def _check_sideways(drive: Drive, command: recordings.Stream) -> tuple[str, ...]:
    """Checks commands of a robot that moves sideways, whose pose sensor may be rotated."""
    spec = drive.spec
    start, end, driven = _measure_twists(drive.dated.t, drive.dated.values)
    keys = [c.cmd_vel or c.name for c in spec.command]
    if sorted(keys) != sorted(SIDEWAYS) or len(start) < MIN_COMPARED:
        return ()
    order = [keys.index(key) for key in SIDEWAYS]
    trials = [
        average_held(command, spec, start - delay, end - delay)[:, order]
        for delay in DELAYS_S
    ]
    asked, alike = _find_most_alike(trials, driven)
    _refuse_swapped_sideways(drive, order, alike)
    if not _is_mirrored(asked, driven, alike):
        return ()
    ahead, left = (spec.command[k].name for k in order[:2])
    return (_describe_mirrored(ahead, left),)


def _describe_mirrored(ahead: str, left: str) -> Mistake:
    """Describes that a robot moves as the mirror image of its commands ahead and left."""
    finding = (
        f"The robot moves right where {left} is positive, or back where {ahead} is"
    )
    cause = "one of them has the wrong sign, or the recording is a mirror image"
    consequence = "(y and heading reversed); the model moves as recorded"
    return Mistake(f"{finding}: {cause} {consequence}.")


def _is_mirrored(asked: Array, driven: Array, alike: Array) -> bool:
    """True if a robot moves (n, 3) as the mirror image of what was asked (n, 3) would."""
    # a rotated mounting moves the sensor sideways
    chi = np.column_stack([asked, driven[:, 2]])
    way = np.linalg.lstsq(chi, driven[:, :2], rcond=None)[0]
    is_opposite = np.linalg.det(alike[:2, :2]) <= -(SWAPPED**2)
    return bool(is_opposite and np.linalg.det(way[:2]) <= 0.0)


def _refuse_swapped_sideways(drive: Drive, order: list[int], alike: Array) -> None:
    """Refuses two swapped commands of a robot that moves sideways.

    Args:
        drive: the drive.
        order: places of the commands that move it along x and y and turn it.
        alike: (3, 3) their correlations with these motions.
    """
    size = np.abs(alike)
    along = np.hypot(alike[:, 0], alike[:, 1])
    for k, straight in enumerate(along[:2] + size[2, 2]):
        _check_swapped(drive, [order[k], order[2]], min(along[2], size[k, 2]), straight)
    # opposite signs come from poses rotated by 90 degrees
    if alike[0, 1] * alike[1, 0] > 0.0:
        _check_swapped(
            drive, order[:2], min(size[0, 1], size[1, 0]), size[0, 0] + size[1, 1]
        )


def _find_most_alike(trials: list[Array], driven: Array) -> tuple[Array, Array]:
    """Returns the motion (n, K) that most resembles the driven one, and their correlations."""
    count = driven.shape[1]
    with np.errstate(invalid="ignore"):  # commands that never changed
        alike = [np.corrcoef(asked.T, driven.T)[:count, count:] for asked in trials]
    alike = [np.nan_to_num(correlation) for correlation in alike]
    best = int(np.argmax([np.abs(correlation).sum() for correlation in alike]))
    return trials[best], alike[best]


def _measure_twists(t: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Returns the ends (n,) of time spans [s], and the twist (n, 3) of poses (T, 3) in each."""
    start = np.arange(t[0], t[-1] - COMPARED_S, COMPARED_S / 2.0)
    first = np.searchsorted(t, start)
    last = np.searchsorted(t, start + COMPARED_S)
    apart = last > first
    first = first[apart]
    last = last[apart]
    moved = geometry.log(geometry.between(pose[first], pose[last]))
    return t[first], t[last], moved / (t[last] - t[first])[:, None]


def _find_places(spec: RobotSpec) -> list[int]:
    """Returns the indices of commands in speed and turn rate; none if any command is another."""
    keys = [c.cmd_vel or c.name for c in spec.command]
    return [PLACES[key] for key in keys] if {*keys} <= {*PLACES} else []


def _has_known_wheels(spec: RobotSpec) -> bool:
    """True if the commands are those of wheels whose radius is known."""
    return (
        all(c.unit == "rad/s" for c in spec.command)
        and "wheel_radius" in spec.parameters
        and "wheel_radius" not in spec.assumed
        and has_textbook(spec)
    )


def _compare_commands(
    drive: Drive, command: recordings.Stream
) -> tuple[Array, Array, Array] | None:
    """Returns speed and turn rate (n, 2), commanded and measured, and their correlations (2, 2).

    None if they can't be determined.
    """
    spec = drive.spec
    places = _find_places(spec)
    start, end, moved = _measure_twists(drive.dated.t, drive.dated.values)
    if len(start) < MIN_COMPARED or not (places or _has_known_wheels(spec)):
        return None
    # direction of travel, ahead or back
    axis = np.sqrt(((moved[:, 0] + 1j * moved[:, 1]) ** 2).sum())
    axis = axis / max(abs(axis), 1e-9)
    driven = np.stack([moved[:, :2] @ [axis.real, axis.imag], moved[:, 2]], axis=1)
    trials = []
    for delay in DELAYS_S:
        sent = average_held(command, spec, start - delay, end - delay)
        asked = np.zeros_like(driven)
        if places:
            asked[:, places] = sent
        else:
            asked[:] = textbook(spec).compute_twist(sent)[:, [0, 2]]
        trials.append(asked)
    asked, alike = _find_most_alike(trials, driven)
    return asked, driven, np.abs(alike)


def check_axes(drive: Drive) -> None:
    """Refuses poses whose heading turns against the direction of travel (RecordingError)."""
    # If only mirrored headings make the direction constant, then x, y or heading is reversed.
    recording = drive.recording
    values = drive.dated.values
    noise = TRAVEL_NOISE * (drive.pose_noise or (0.0, 0.0))[0]
    apart = max(TRAVEL_SHARE * drive.spec.footprint_radius, noise, 1e-3)
    spaced = drive.dated.rows(recordings.select_along_path(values, apart))
    keys = HeadingKeys.NONE
    if not drive.spec.moves_sideways:
        keys = recordings.find_clockwise_keys(spaced.values)
    if keys is HeadingKeys.NONE:
        keys = _find_heading_by_inputs(spaced.values, drive)
    if keys is HeadingKeys.NONE:
        return
    if keys is HeadingKeys.COMPASS:
        kind = "as that of a compass"
        alternative = "exchange x and y"
    else:
        kind = "counted clockwise"
        alternative = "reverse x or y, or remove such a scale"
    fault = "heading and path turn opposite ways; one of x, y and heading is reversed"
    advice = (
        f"for a heading {kind} write `heading: {{from: ..., {keys}}}` below `pose:`"
    )
    raise RecordingError(
        f"{recording.source}: pose: {fault}: {advice}; or {alternative} (REP-103)."
    )


def _find_heading_by_inputs(spaced: Array, drive: Drive) -> HeadingKeys:
    """Finds if only mirrored headings make wheels or commands explain where the robot went.

    A tracked point ahead of the axle moves sideways in turns, so its path alone may not show this.
    """
    if not recordings.has_visible_axes(spaced):
        return HeadingKeys.NONE
    as_recorded, mirrored = (
        _explain_velocity(drive, drive.dated.values * [1.0, 1.0, scale])
        for scale in (1.0, -1.0)
    )
    if mirrored < max(recordings.MIN_MIRRORED, recordings.BETTER + as_recorded):
        return HeadingKeys.NONE
    if (
        drive.spec.moves_sideways
    ):  # its course says nothing of where its heading is zero
        return HeadingKeys.MIRRORED
    return recordings.choose_clockwise_keys(spaced)


def _explain_velocity(drive: Drive, pose: Array) -> float:
    """Returns the fraction (0 to 1) of the body velocity that inputs explain after some delay."""
    explained = [0.0]
    for delay_s in DELAYS_S:
        averages = _average_inputs(drive, pose, delay_s)
        if averages is None:
            return 0.0
        sent, driven = averages
        velocity = driven[:, :2]
        rest = velocity - sent @ np.linalg.lstsq(sent, velocity, rcond=1e-3)[0]
        share = (rest**2).sum() / max(float((velocity**2).sum()), 1e-12)
        explained.append(1.0 - float(share))
    return max(explained)


LEAST_COVERED = 0.9  # minimum fraction of a drive that the gyro must cover
# deviation from 1 of the ratio of turns, above which the gyro does not match a tracker
UNLIKE_TRACKER = 0.1


def correct_heading_by_gyro(recording: Recording) -> Recording:
    """Returns a recording whose odometry turns by the gyro, if one was recorded and the two differ.

    `gyro` then holds the comparison. Other poses are compared but not changed; `repairs` gets a
    sentence on the finding.
    """
    if recording.imu is None or recording.gyro is not None:
        return recording
    if recording.imu.clock != recording.pose.clock:
        sentence = "The gyro is on another clock than the pose, so it was not compared with it."
        return replace(recording, repairs=(*recording.repairs, sentence))
    pose = recording.pose
    gyro_t = recording.imu.t
    yaw_rate = recording.imu.values[:, 2]
    turning = compare_turning(pose.t, pose.values, gyro_t, yaw_rate)
    if turning is None or not turning.compared:
        return recording
    sentences = tuple(_describe_turning(recording, turning))
    if not _is_credible(recording, turning):
        return replace(recording, repairs=(*recording.repairs, *sentences))
    if recording.measured_by == "odometry" and turning.contradicts:
        turned, covered = turn_by_gyro(pose.t, pose.values, gyro_t, yaw_rate, turning)
        if covered < LEAST_COVERED:
            sentences = (
                f"The gyro covers only {covered:.0%} of the drive, so the heading is that of "
                "odometry, which it contradicts; record its topic without gaps.",
            )
            return replace(recording, repairs=(*recording.repairs, *sentences))
        pose = replace(pose, values=turned)
    return replace(
        recording, pose=pose, gyro=turning, repairs=(*recording.repairs, *sentences)
    )


def describe_reference(recording: Recording) -> str:
    """States what the errors of a model learnt from a recording are relative to."""
    by = recording.measured_by
    turning = recording.gyro
    if by == "truth":
        return ""
    if by == "tracker":
        return "That is relative to motion capture or a localiser."
    if by == "odometry" and turning is not None:
        if turning.contradicts:
            return (
                "That is relative to odometry with its heading from the gyro, which contradicts "
                f"odometry's own by {turning.apart:.2g} rad in {WINDOW_S:g} s; nothing here shows "
                "how far the path drifts."
            )
        return (
            "That is relative to odometry, whose heading the gyro confirms; nothing here shows "
            "how far the path drifts."
        )
    if by == "odometry":
        return "That is relative to odometry; nothing here shows how far that drifts."
    return (
        "That is relative to the recorded pose; nothing here shows whether it is odometry, which "
        "drifts."
    )


def _is_credible(recording: Recording, turning: Turning) -> bool:
    """True if the gyro is credible, given this pose."""
    if not turning.plausible:
        return False
    if recording.measured_by == "odometry":
        return True
    return abs(turning.scale - 1.0) < UNLIKE_TRACKER or not turning.contradicts


def _describe_turning(recording: Recording, turning: Turning) -> Iterator[str]:
    """Yields a sentence on how gyro and pose turn."""
    if turning.mirrored:
        yield Mistake(
            "The gyro turns against the heading: one of them is mirrored, and the gyro was not "
            "used. Counter-clockwise is positive; write `scale: -1` beside its `from:`, or fix "
            "its driver."
        )
        return
    if turning.in_degrees:
        yield Mistake(
            f"The gyro turns {1.0 / turning.scale:.3g} times as far as the heading, as degrees "
            "would, and was not used: write `unit: deg/s` beside its `from:`, or fix its driver."
        )
        return
    if not turning.plausible:
        yield (
            "The gyro does not turn as the heading does (correlation "
            f"{turning.alike:.2f}), and was not used: find out which of them is wrong."
        )
        return
    if turning.rest_s > 0.0:
        where = f"over {turning.rest_s:.1f} s at rest"
    else:
        where = "while driving"
    bias = (
        f"bias of {turning.bias:.4f} +- {turning.bias_std:.2g} rad/s was found {where}"
    )
    agrees = recording.measured_by == "tracker" and _is_credible(recording, turning)
    if agrees or not turning.contradicts:
        yield (
            f"The gyro confirms the heading: they differ by {turning.apart:.2g} rad in "
            f"{WINDOW_S:g} s; its {bias}."
        )
        return
    differ = f"by {turning.apart:.2g} rad in {WINDOW_S:g} s"
    if recording.measured_by == "odometry":
        slip = ""
        if abs(turning.scale - 1.0) > CLEARLY * turning.scale_std:
            slip = f": it turns {_format_factor(turning)} times as far, as wheels do that slip"
        yield (
            f"The gyro contradicts odometry {differ}{slip}. The model was learnt from the wheels' "
            f"displacements along the heading of the gyro, whose {bias}."
        )
        return
    times = f"{_format_factor(turning)} times as far"
    if recording.measured_by == "":
        yield (
            f"The gyro contradicts the pose {differ}: the pose turns {times}. If it is odometry, "
            "write `measured_by: odometry` below `pose:`, and the gyro will turn it."
        )
        return
    yield (
        f"The gyro contradicts the tracker {differ}: the tracker turns {times}; check the gyro's "
        "scale and mounting."
    )


def _format_factor(turning: Turning) -> str:
    digits = max(2, int(np.ceil(-np.log10(max(turning.scale_std, 1e-4)))))
    return f"{turning.scale:.{digits}f} +- {turning.scale_std:.1g}"
