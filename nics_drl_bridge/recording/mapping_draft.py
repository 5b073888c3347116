"""Drafts a recording's mapping from its names, units and types, with blanks for the rest."""

from collections.abc import Iterator, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.geometry import east_and_north
from nics_drl_bridge.recording.column_guesses import (
    GLOBE,
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
from nics_drl_bridge.recording.mapping import UNITS, write_reference
from nics_drl_bridge.recording.recording import (
    Implausible,
    compute_heading,
    find_implausible_pose,
)
from nics_drl_bridge.recording.survey import Field, TableSurvey

GUESSED = "# guessed"
NO_COMMAND = (
    "no command was recorded: nothing here was sent to the robot, such as "
    "geometry_msgs/Twist on cmd_vel; record it together with the pose"
)
NO_POSE = "# no pose was found: give x, y, and heading or quaternion, or `pose: /tf`"
USUAL_RADIUS = 0.2  # footprint radius of a robot [m]
LARGEST_ANGLE = 1.6  # maximum steering angle [rad]
MOST_LISTED = 20  # maximum number of unused columns listed per table
STILL = "; it is 0"
NEEDS_TURN = "; add `ticks_per_turn:`, the counts of a turn of the wheel"
NO_VALUES = {"header", "stamp", "seq", "covariance", "index", "id", "row"}


class MappingDraft(NamedTuple):
    """A draft of a mapping."""

    doubts: Sequence[str]  # sentences on what the user should check first
    lines: Sequence[str]  # the mapping, in YAML
    unused: Sequence[str]  # unused columns, a text for each table

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
    switches = guess_switches(tables) if guess.listed else ()
    used = [candidate.column for candidate in guess.listed.values()]
    used += [switch.column for switch in switches]
    gyro = guess_yaw_rate(tables)
    if gyro in used:
        gyro = None
    episode = guess_episode(tables)
    times = [table.time for table in tables if table.time is not None]
    time = max(times, key=times.count, default=None)
    lines = [_write_robot(guess.kind)]
    if time is not None:
        lines.append(f"time: {time}  {GUESSED}")
    elif any(table.t is None and table.rows for table in tables):
        lines.append(
            f"time: {{rate: 50}}  {GUESSED}: no stamps were found; rows a second"
        )
    if episode is not None:
        lines.append(f"episode: {episode.reference}  {GUESSED}")
    doubts = []
    if pose is None:
        lines += [NO_POSE, "pose:", "  x: ", "  y: "]
    else:
        units = _name_units(pose)
        lines += [*_write_pose(pose, units, time), *_write_clock(pose, guess.listed)]
        fault = _find_fault(pose, units, guess.kind)
        if fault is not None:
            line = fault.line.replace("...", str(time))
            doubts.append(f"pose: {fault.reason}; {fault.cause}: add `{line}`")
    if not guess.listed:
        doubts.append(NO_COMMAND)
    lines += _write_commands(guess, switches, time)
    if gyro is not None:
        lines.append(f"{write_imu_line(gyro, time)}  {GUESSED}")
    used += [candidate.column for candidate in guess.candidates.values()]
    unused = [*_list_unused(tables, {*used, episode, gyro}, pose)]
    return MappingDraft(doubts, lines, unused)


def _write_robot(kind: str | None) -> str:
    if kind is None:
        return (
            "robot:  # the kind is not certain, for example {kind: differential, "
            f"footprint_radius: {USUAL_RADIUS}}}"
        )
    look_alikes = "".join(f", or {other}" for other in find_look_alikes(kind))
    return (
        f"robot: {{kind: {kind}, footprint_radius: {USUAL_RADIUS}}}  "
        f"{GUESSED}{look_alikes}; radius in m"
    )


def _write_commands(
    guess: CommandGuess, switches: Sequence[Switch], time: str | None
) -> Iterator[str]:
    """Yields the commands, or a blank with the candidates as comments."""
    when = ", ".join(switch.condition for switch in switches)

    def write(name: str, candidate: Candidate) -> str:
        keys = [*_write_unit_keys(name, candidate.column)]
        # A switch cuts off the motor; the steering stays as it is.
        if when and "steer" not in name:
            keys.append(f"when: {{{when}}}")
        return f"{name}: {write_value(candidate.column, keys, time)}"

    head = "command:"
    if not guess.listed:
        head += f"  # {NO_COMMAND}"
    elif guess.of_wheels:
        found = "none is certain" if guess.candidates else "no command was recorded"
        head += f"  # {found}: the measured wheel motion is used instead"
    elif not guess.commands:
        head += "  # none is certain: uncomment what was sent to the robot"
    yield head
    for name, candidate in guess.commands.items():
        remark = ""
        if candidate.is_still:
            remark = STILL
        elif candidate.meaning != "steering" and candidate.column.counts:
            remark = NEEDS_TURN
        yield f"  {write(name, candidate)}  {GUESSED}{remark}"
    either = "or " if guess.commands else ""
    for name, candidate in guess.candidates.items():
        yield f"#  {either}{write(name, candidate)}"


def _write_unit_keys(name: str, column: Field) -> Iterator[str]:
    unit = column.unit
    if column.counts:
        yield "unit: ticks"
        if "steer" in name:
            yield "differentiate: false"
    elif unit == "%":
        yield 'unit: "%"'
    elif unit is not None and UNITS[unit].factor != 1.0:
        yield f"unit: {unit}"
    elif name == "steering_command" and max(-column.low, column.high) > LARGEST_ANGLE:
        yield "unit: deg"


def _write_clock(pose: PoseGuess, commands: Mapping[str, Candidate]) -> Iterator[str]:
    """Yields the line that gives the pose a separate clock, if its stamps show one."""
    t = pose.table.t
    tables = [candidate.column.table for candidate in commands.values()]
    stamps = [(other.unit, np.sort(other.t)) for other in tables if other.t is not None]
    if t is None or not pose.table.stamp_columns or not stamps:
        return
    line = f"  clock: tracker  {GUESSED}"
    if all(other[-1] < min(t) or other[0] > max(t) for _, other in stamps):
        yield f"{line}: shares no time with the commands"
    elif all(
        unit != pose.table.unit and 0.0 in (other[0], t[0]) for unit, other in stamps
    ):
        yield f"{line}: one counts from its first row, and in another unit"


def _list_unused(
    tables: Sequence[TableSurvey], used: Set[Field | None], pose: PoseGuess | None
) -> Iterator[str]:
    """Yields a text for each table with the columns of values that the draft does not use."""
    for table in tables:
        unused = []
        for column in table.columns:
            if column.name_words & NO_VALUES or column in used or is_used(column, pose):
                continue
            remark = "" if column.moves else " (no numbers)"
            if column.low == column.high:
                remark = " (constant)"
            unused.append(f"{column.name}{remark}")
        place = "" if table.is_single else f"{table.name}: "
        listed = ", ".join(unused[:MOST_LISTED])
        if len(unused) > MOST_LISTED:
            listed += f" and {len(unused) - MOST_LISTED} more"
        if unused:
            yield f"not used: {place}{listed}"


def _write_pose(
    pose: PoseGuess, units: Mapping[str, str], common_time: str | None
) -> list[str]:
    table = pose.table
    is_known = pose.x.name in (form[0].format("x") for form in POSES[:4])
    if not table.stamp_columns and is_known:
        return [f"pose: {table.name}  {GUESSED}"]  # a message whose fields are known
    lines = [f"pose:  {GUESSED}"]
    if not table.is_single:
        lines.append(f"  in: {write_reference(table.name)}")
    names = [write_reference(column.name) for column in pose.columns]
    lines += [f"  x: {names[0]}", f"  y: {names[1]}"]
    if len(pose.orientation) == 1:
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
    units = {"unit": pose.x.unit}
    if pose.x.name_words & GLOBE.keys():
        units["unit"] = "deg"
    if len(pose.orientation) == 1:
        units["heading_unit"] = pose.orientation[0].unit
    return {
        key: unit
        for key, unit in units.items()
        if unit and UNITS[unit].factor != 1.0 and UNITS[unit].si in ("m", "rad")
    }


def _find_fault(
    pose: PoseGuess, units: Mapping[str, str], kind: str | None
) -> Implausible | None:
    """Finds poses that only another unit explains; None also if their rows have no stamps."""
    t = pose.table.t
    columns = [column.numbers for column in pose.columns]
    # The columns may be of several streams.
    if t is None or any(len(column) != len(t) for column in columns):
        return None
    x, y, *orientation = columns
    heading = orientation[0]
    if len(orientation) > 1:
        heading = compute_heading(*orientation)
    si, factor = UNITS[units.get("unit", "m")]
    place = (factor * x, factor * y)
    if si == "rad":
        place = east_and_north(*place)
    heading = heading * UNITS[units.get("heading_unit", "rad")].factor
    values = np.stack([*place, heading], axis=1)
    is_finite = np.isfinite(values).all(axis=1)
    # A car may accelerate harder than a small robot; only the kind distinguishes them.
    radius = USUAL_RADIUS
    if kind is None or kind.startswith("ackermann"):
        radius = np.inf
    return find_implausible_pose(t[is_finite], values[is_finite], radius=radius)
