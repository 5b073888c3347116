"""Drafts a recording's mapping from its names, units and types, with blanks for the rest."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import Array, east_and_north
from nics_drl_bridge.recording.guesses import (
    GLOBE,
    TICKS,
    Candidate,
    CommandGuess,
    PoseGuess,
    Switch,
    find_look_alikes,
    guess_command,
    guess_episode,
    guess_pose,
    guess_switches,
    guess_yaw_rate,
    is_used,
    write_imu_line,
    write_value,
)
from nics_drl_bridge.recording.mapped import POSES
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.motion_check import find_doubts
from nics_drl_bridge.recording.names import split_words, write_reference
from nics_drl_bridge.recording.recording import compute_heading, find_implausible_pose
from nics_drl_bridge.recording.survey import Field, TableSurvey

GUESSED = "# guessed"
NO_COMMAND = (
    "no command was recorded, that is: nothing here was sent to the robot, such as "
    "geometry_msgs/Twist on cmd_vel; record it together with the pose"
)
NO_POSE = "# no pose was found: give x, y, and heading or quaternion, or `pose: /tf`"
USUAL_RADIUS = 0.2  # footprint radius of a robot [m]
LARGEST_ANGLE = 1.6  # maximum steering angle [rad]
MOST_LISTED = 20  # maximum number of unused columns listed per table
STILL = "; it is 0"
NEEDS_TURN = "; add `ticks_per_turn:`, the counts of a turn of the wheel"
NO_VALUES = {"header", "stamp", "seq", "covariance", "index", "id", "row"}


class _Guesses(NamedTuple):
    """The guesses from which a mapping is drafted."""

    tables: Sequence[TableSurvey]
    pose: PoseGuess | None
    guess: CommandGuess
    switches: tuple[Switch, ...]
    gyro: Field | None
    episode: Field | None
    common_time: str | None  # the stamps of most tables, for the whole mapping


class MappingDraft(NamedTuple):
    """A draft of a mapping."""

    doubts: Sequence[str]  # what the user should check first
    lines: Sequence[str]  # the mapping, in YAML
    unused: Sequence[str]  # the columns that it does not use, a text for each table

    @property
    def text(self) -> str:
        """The file: the mapping in YAML, with doubts and unused columns as comments."""
        doubts = [f"# doubt: {doubt}" for doubt in self.doubts]
        unused = [f"# {columns}" for columns in self.unused]
        return "\n".join([*doubts, *self.lines, *unused]) + "\n"


def propose_mapping(tables: Sequence[TableSurvey]) -> MappingDraft:
    """Drafts a mapping in YAML; guesses are marked, and uncertain parts are left blank."""
    pose = guess_pose(tables)
    guess = guess_command(tables, pose)
    times = [table.time for table in tables if table.time is not None]
    common_time = max(times, key=times.count, default=None)
    pose_lines = [NO_POSE, "pose:", "  x: ", "  y: "]
    poses = None
    if pose is not None:
        units = _name_units(pose)
        pose_lines = _write_pose(pose, units, common_time)
        poses = _compute_poses(pose, units)
    switches: tuple[Switch, ...] = ()
    if guess.listed:
        switches = guess_switches(tables)
    gyro = guess_yaw_rate(tables)
    if gyro and any(gyro is command.column for command in guess.listed.values()):
        gyro = None
    episode = guess_episode(tables)
    guesses = _Guesses(tables, pose, guess, switches, gyro, episode, common_time)
    doubts = [*_find_doubts(guess, poses, str(common_time))]
    if not guess.listed:
        doubts.append(NO_COMMAND)
    lines = [_write_robot(guess)]
    if common_time is not None:
        lines.append(f"time: {common_time}  {GUESSED}")
    elif any(table.t is None and table.rows for table in tables):
        lines.append(
            f"time: {{rate: 50}}  {GUESSED}: no stamps were found; rows a second"
        )
    if episode is not None:
        lines.append(f"episode: {episode.reference}  {GUESSED}")
    lines += pose_lines
    lines += _write_clock(pose, guess.listed)
    lines += _write_commands(guesses)
    if gyro is not None:
        lines.append(f"{write_imu_line(gyro, common_time)}  {GUESSED}")
    return MappingDraft(doubts, lines, [*_list_unused(guesses)])


def _find_doubts(
    guess: CommandGuess, poses: tuple[Array, Array] | None, time: str
) -> Iterator[str]:
    """Yields sentences on a pose in the wrong unit, else on commands that the motion ignores.

    `time` is the reference to the column of the stamps.
    """
    if poses is None:
        return
    # A car may accelerate harder than a small robot, and only its kind tells.
    may_be_car = guess.kind is None or guess.kind.startswith("ackermann")
    fault = find_implausible_pose(*poses, radius=np.inf if may_be_car else USUAL_RADIUS)
    if fault is None:
        yield from find_doubts(guess, *poses)
    else:
        line = fault.line.replace("...", time)
        yield f"pose: {fault.reason}; {fault.cause}: add `{line}`"


def _write_robot(guess: CommandGuess) -> str:
    if guess.kind is None:
        return (
            "robot:  # which kind is not certain, as in {kind: differential, "
            f"footprint_radius: {USUAL_RADIUS}}}"
        )
    look_alikes = "".join(f", or {kind}" for kind in find_look_alikes(guess.kind))
    return (
        f"robot: {{kind: {guess.kind}, footprint_radius: {USUAL_RADIUS}}}  "
        f"{GUESSED}{look_alikes}; radius in m"
    )


def _write_commands(guesses: _Guesses) -> Iterator[str]:
    """Yields the commands, or a blank with the candidates as comments."""
    guess = guesses.guess
    when = ""
    if guesses.switches:
        flags = [switch.condition for switch in guesses.switches]
        when = f"when: {{{', '.join(flags)}}}"
    if guess.commands:
        if guess.of_wheels:
            found = "none is certain" if guess.candidates else "no command was recorded"
            yield f"command:  # {found}: what the wheels did stands in for it"
        else:
            yield "command:"
        for name, candidate in guess.commands.items():
            value = _write_command(name, candidate, when, guesses.common_time)
            yield f"  {name}: {value}  {GUESSED}{_write_remark(candidate)}"
        for name, candidate in guess.candidates.items():
            yield f"#  or {name}: {_write_command(name, candidate, when, guesses.common_time)}"
    elif guess.candidates:
        yield "command:  # none is certain: uncomment what was sent to the robot"
        for name, candidate in guess.candidates.items():
            yield f"#  {name}: {_write_command(name, candidate, when, guesses.common_time)}"
    else:
        yield f"command:  # {NO_COMMAND}"


def _write_command(name: str, candidate: Candidate, when: str, time: str | None) -> str:
    keys = [*_write_unit_keys(name, candidate.column)]
    # A switch cuts off the motor; the steering stays as it is.
    if when and "steer" not in name:
        keys.append(when)
    return write_value(candidate.column, keys, time)


def _write_remark(candidate: Candidate) -> str:
    if candidate.is_still:
        return STILL
    is_counter = not TICKS.isdisjoint(split_words(candidate.column.name))
    return NEEDS_TURN * (is_counter and candidate.meaning != "steering")


def _write_unit_keys(name: str, column: Field) -> Iterator[str]:
    unit = column.unit
    if not TICKS.isdisjoint(split_words(column.name)):
        yield "unit: ticks"
        if "steer" in name:
            yield "differentiate: false"
    elif unit == "%":
        yield 'unit: "%"'
    elif unit is not None and UNITS[unit].factor != 1.0:
        yield f"unit: {unit}"
    elif name == "steering_command" and max(-column.low, column.high) > LARGEST_ANGLE:
        yield "unit: deg"


def _write_clock(
    pose: PoseGuess | None, commands: Mapping[str, Candidate]
) -> Iterator[str]:
    """Yields the line that gives the pose a clock of its own, if its stamps show one."""
    if pose is None or pose.table.t is None or not pose.table.stamps:
        return
    t = pose.table.t
    stamps = [
        (table.unit, np.sort(table.t))
        for table in (candidate.column.table for candidate in commands.values())
        if table.t is not None
    ]
    if not stamps:
        return
    line = f"  clock: tracker  {GUESSED}"
    if all(other[-1] < min(t) or other[0] > max(t) for _, other in stamps):
        yield f"{line}: shares no time with the commands"
    elif all(
        unit != pose.table.unit and 0.0 in (other[0], t[0]) for unit, other in stamps
    ):
        yield f"{line}: one counts from its first row, and in another unit"


def _list_unused(guesses: _Guesses) -> Iterator[str]:
    """Yields a text for each table with the columns of values that the draft does not use."""
    guess = guesses.guess
    candidates = [*guess.commands.values(), *guess.candidates.values()]
    used = [candidate.column for candidate in candidates]
    used += [switch.column for switch in guesses.switches]
    for table in guesses.tables:
        unused = []
        for column in table.columns:
            is_value = NO_VALUES.isdisjoint(split_words(column.name))
            is_named = column in (*used, guesses.gyro, guesses.episode)
            if is_value and not is_named and not is_used(column, guesses.pose):
                unused.append(f"{column.name}{_explain_unused(column)}")
        place = "" if table.is_single else f"{table.name}: "
        listed = ", ".join(unused[:MOST_LISTED])
        if len(unused) > MOST_LISTED:
            listed += f" and {len(unused) - MOST_LISTED} more"
        if unused:
            yield f"not used: {place}{listed}"


def _explain_unused(column: Field) -> str:
    if column.moves:
        return ""
    if column.low == column.high:
        return " (constant)"
    return " (no numbers)"


def _write_pose(
    pose: PoseGuess, units: Mapping[str, str], common_time: str | None
) -> list[str]:
    table = pose.table
    is_known = pose.x.name in (form[0].format("x") for form in POSES[:4])
    if table.stamps is None and is_known:
        return [f"pose: {table.name}  {GUESSED}"]  # a message whose fields are known
    lines = [f"pose:  {GUESSED}"]
    if not table.is_single:
        lines.append(f"  in: {write_reference(table.name)}")
    names = [write_reference(column.name) for column in pose.columns]
    lines += [f"  x: {names[0]}", f"  y: {names[1]}"]
    if pose.heading is not None:
        lines.append(f"  heading: {names[2]}")
    else:
        lines.append(f"  quaternion: [{', '.join(names[2:])}]")
    if table.time not in (common_time, None):
        lines.append(f"  time: {table.time}")
    for key, unit in units.items():
        lines.append(f"  {key}: {unit}  {GUESSED}")
    return lines


def _name_units(pose: PoseGuess) -> dict[str, str]:
    """Returns the units that the names of a pose's columns show, unless they are m and rad."""
    units = {
        "unit": pose.x.unit,
        "heading_unit": None if pose.heading is None else pose.heading.unit,
    }
    if not {*GLOBE}.isdisjoint(split_words(pose.x.name)):
        units["unit"] = "deg"
    named = {}
    for key, unit in units.items():
        if unit is None:
            continue
        si, factor = UNITS[unit]
        if factor != 1.0 and si in ("m", "rad"):
            named[key] = unit
    return named


def _compute_poses(
    pose: PoseGuess, units: Mapping[str, str]
) -> tuple[Array, Array] | None:
    """Returns stamps (T,) and poses (T, 3) of a guess in SI; None if its rows have no stamps."""
    table = pose.table
    if table.t is None:
        return None
    columns = [column.numbers for column in pose.columns]
    # The columns may be of several streams.
    if any(len(column) != len(table.t) for column in columns):
        return None
    x, y, *orientation = columns
    heading = orientation[0]
    if pose.quaternion:
        heading = compute_heading(*orientation)
    values = np.stack([x, y, heading], axis=1)
    is_finite = np.isfinite(values).all(axis=1)
    if is_finite.sum() < 3:
        return None
    if "heading_unit" in units:
        values[:, 2] *= UNITS[units["heading_unit"]].factor
    if "unit" in units:
        si, factor = UNITS[units["unit"]]
        values[:, :2] *= factor
        if si == "rad":
            values[:, :2] = np.stack(east_and_north(*values[:, :2].T), axis=1)
    return table.t[is_finite], values[is_finite]
