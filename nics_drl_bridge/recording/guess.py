"""Drafts the mapping of a recording by its names, units and types, with blanks for the rest."""

import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from nics_drl_bridge.geometry import Array, east_and_north
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording.command_guess import (
    TICKS,
    Candidate,
    CommandGuess,
    find_look_alikes,
    guess_command,
)
from nics_drl_bridge.recording.imu_guess import guess_yaw_rate, write_imu_line
from nics_drl_bridge.recording.mapped import POSES
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.recording.motion_check import find_doubts, find_reversed_wheels
from nics_drl_bridge.recording.names import split_words, write_reference
from nics_drl_bridge.recording.pose_guess import (
    GLOBE,
    PoseGuess,
    guess_pose,
    select_apart,
)
from nics_drl_bridge.recording.recording import find_clockwise_keys, select_along_path
from nics_drl_bridge.recording.survey import Survey, TableSurvey, split_unit
from nics_drl_bridge.recording.switch_guess import Switch, guess_switch

GUESSED = "# guessed"
DOUBT = "# doubt:"
NOT_USED = "# not used"
NO_COMMAND = (
    "no command was recorded, that is: nothing here was sent to the robot, such as "
    "geometry_msgs/Twist on cmd_vel; record it together with the pose"
)
NO_POSE = "# no pose was found: give x, y, and heading or quaternion, or `pose: /tf`"
NO_RADIUS = 0.2  # of a robot [m], unless it is as large as a car, since
FAST_CAR = 10.0  # it is faster [m/s],
FAR_AWAY = 1e4  # or so far from 0 [m]
CAR_RADIUS = 2.0
USUAL_WHEEL = 5.0  # [rad/s], by which the ticks of a turn are guessed
LARGEST_ANGLE = 1.6  # of a steering [rad]
MOST_LISTED = 20  # unused columns of a table
STILL = "; it is 0"
NO_VALUES = {"header", "stamp", "seq", "covariance", "index", "id", "row"}
# shares from which on a draft turns a heading round
MIRRORED = 0.6
MIRRORED_BETTER = 0.3


def propose_mapping(tables: Sequence[TableSurvey]) -> str:
    """Drafts a mapping in YAML; guesses are marked, and what is not certain is left blank."""
    alone = len(tables) == 1
    pose = guess_pose(tables)
    guess = guess_command(tables, pose)
    times = [table.time for table in tables if table.time is not None]
    common = max(times, key=times.count) if times else None
    if pose:
        pose_lines = _write_pose(pose, alone, common)
    else:
        pose_lines = [NO_POSE, "pose:", "  x: ", "  y: "]
    values = _compute_poses(pose, pose_lines) if pose else None
    if guess.commands or guess.candidates:
        switch = guess_switch(tables, values)
    else:
        switch = None
    lines = [f"{DOUBT} {doubt}" for doubt in find_doubts(guess, values)]
    if not guess.commands and not guess.candidates:
        lines.append(f"{DOUBT} {NO_COMMAND}")
    lines.append(_write_robot(guess, _guess_radius(values)))
    if common is not None:
        lines.append(f"time: {common}  {GUESSED}")
    elif any(table.t is None and table.rows for table in tables):
        lines.append(
            f"time: {{rate: 50}}  {GUESSED}: no stamps were found; rows a second"
        )
    lines += pose_lines
    lines += _write_clock(pose, guess.commands or guess.candidates)
    backwards = find_reversed_wheels(guess, values)
    lines += _write_commands(guess, switch, backwards, alone, common)
    gyro = _find_free_yaw_rate(tables, guess)
    if gyro is not None:
        lines.append(f"{write_imu_line(*gyro, alone, common)}  {GUESSED}")
    lines += _list_unused(tables, pose, guess, switch, gyro)
    return "\n".join(lines) + "\n"


def _write_robot(guess: CommandGuess, radius: float) -> str:
    if guess.kind is None:
        example = f"{{kind: differential, footprint_radius: {radius}}}"
        return f"robot:  # which kind is not certain, as in {example}"
    alike = "".join(f", or {each}" for each in find_look_alikes(guess.kind))
    robot = f"robot: {{kind: {guess.kind}, footprint_radius: {radius}}}"
    return f"{robot}  {GUESSED}{alike}; radius in m"


def _write_commands(
    guess: CommandGuess,
    switch: Switch | None,
    backwards: Sequence[Candidate],
    alone: bool,
    common: str | None,
) -> Iterator[str]:
    """Yields the commands, or a blank with the candidates as comments."""
    when = "" if switch is None else f"when: {{{switch.refer_to(alone)}: {switch.on}}}"
    if guess.commands:
        wheels = "  # no command was recorded: what the wheels did stands in for it"
        yield "command:" + wheels * guess.of_wheels
        for name, each in guess.commands.items():
            keys = when
            if each in backwards:
                keys = "scale: -1"
            value = _write_value(name, each, keys, alone, common)
            why = ": else it turns against the other" * (each in backwards)
            yield f"  {name}: {value}  {GUESSED}{STILL * each.is_still}{why}"
    elif guess.candidates:
        yield "command:  # none is certain: uncomment what was sent to the robot"
        for name, each in guess.candidates.items():
            yield f"#  {name}: {_write_value(name, each, when, alone, common)}"
    else:
        yield f"command:  # {NO_COMMAND}"


def _write_value(
    name: str, candidate: Candidate, when: str, alone: bool, common: str | None
) -> str:
    """Returns a command as a mapping has it: a column, or a column with more keys."""
    table = candidate.table
    column = candidate.column
    reference = table.refer_to(column.name, alone)
    keys = [*_write_unit_keys(name, table, column)]
    if (
        when and "steer" not in name
    ):  # a switch cuts the motor; the steering stays as it is
        keys.append(when)
    if table.time not in (common, None):
        keys.append(f"time: {table.time}")
    return f"{{from: {reference}, {', '.join(keys)}}}" if keys else reference


def _write_unit_keys(name: str, table: TableSurvey, column: Survey) -> Iterator[str]:
    words = {*split_words(column.name)}
    unit = split_unit(column.name)[1]
    if words & TICKS:
        counters = [
            table.data[c.name] for c in table.numbers if {*split_words(c.name)} & TICKS
        ]
        step = np.abs(
            np.concatenate([np.diff(each.astype(np.float64)) for each in counters])
        )
        yield "unit: ticks"
        if "steer" in name:
            yield "differentiate: false"
        if (t := table.t) is not None and np.ptp(t) > 0.0 and (step > 0.0).any():
            rate = float(np.median(step[step > 0.0])) * len(t) / float(np.ptp(t))
            yield f"ticks_per_turn: {2 ** round(np.log2(2.0 * np.pi * rate / USUAL_WHEEL))}"
    elif unit is not None and UNITS[unit].factor != 1.0:
        yield f"unit: {unit}" if unit != "%" else 'unit: "%"'
    elif name == "steering_command" and max(-column.low, column.high) > LARGEST_ANGLE:
        yield "unit: deg"


def _write_clock(
    pose: PoseGuess | None, commands: Mapping[str, Candidate]
) -> list[str]:
    """Returns the line that gives the pose a clock of its own, if it has one by its stamps."""
    if pose is None or (t := pose.table.t) is None or not pose.table.stamps:
        return []
    tables = [each.table for each in commands.values()]
    others = [(each.unit, np.sort(each.t)) for each in tables if each.t is not None]
    if not others:
        return []
    if all(u[-1] < min(t) or u[0] > max(t) for _, u in others):
        why = "shares no time with the commands"
    elif all(unit != pose.table.unit and 0.0 in (u[0], t[0]) for unit, u in others):
        why = "one counts from its first row, and in another unit"
    else:
        return []
    return [f"  clock: tracker  {GUESSED}: {why}"]


def _find_free_yaw_rate(
    tables: Sequence[TableSurvey], guess: CommandGuess
) -> tuple[TableSurvey, Survey] | None:
    """Returns the yaw rate of a gyro, unless it may be a command."""
    found = guess_yaw_rate(tables)
    if found is None:
        return None
    table, column = found
    commands = (*guess.commands.values(), *guess.candidates.values())
    taken = any(
        each.table is table and each.column.name == column.name for each in commands
    )
    return None if taken else found


def _list_unused(
    tables: Sequence[TableSurvey],
    pose: PoseGuess | None,
    guess: CommandGuess,
    switch: Switch | None,
    gyro: tuple[TableSurvey, Survey] | None,
) -> Iterator[str]:
    """Yields a comment for each table that names the columns of values that the draft lacks."""
    taken = {
        (id(each.table), each.column.name)
        for each in (*guess.commands.values(), *guess.candidates.values())
    }
    if pose is not None:
        taken |= {(id(pose.table), column) for column in pose.columns}
    if switch is not None:
        taken.add((id(switch.table), switch.column))
    if gyro is not None:
        taken.add((id(gyro[0]), gyro[1].name))
    for table in tables:
        rest = []
        for column in table.columns:
            is_value = not {*split_words(column.name)} & NO_VALUES
            is_free = (id(table), column.name) not in taken
            if is_value and is_free and column.name not in table.stamp_columns:
                rest.append(f"{column.name}{_explain_unused(column)}")
        place = "" if len(tables) == 1 else f"{table.name}: "
        more = f" and {len(rest) - MOST_LISTED} more" if len(rest) > MOST_LISTED else ""
        if rest:
            yield f"{NOT_USED}: {place}{', '.join(rest[:MOST_LISTED])}{more}"


def _explain_unused(column: Survey) -> str:
    if column.low < column.high:
        return ""
    return " (constant)" if column.low == column.high else " (no numbers)"


def _write_pose(pose: PoseGuess, alone: bool, common: str | None) -> list[str]:
    table = pose.table
    if table.stamps is None and pose.x in (form[0].format("x") for form in POSES[:4]):
        return [f"pose: {table.name}  {GUESSED}"]  # a message whose fields are known
    lines = [f"pose:  {GUESSED}"]
    if not alone:
        lines.append(f"  in: {write_reference(table.name)}")
    lines.append(f"  x: {write_reference(pose.x)}")
    lines.append(f"  y: {write_reference(pose.y)}")
    if pose.heading is not None:
        lines.append(f"  heading: {write_reference(pose.heading)}")
    else:
        lines.append(
            f"  quaternion: [{', '.join(map(write_reference, pose.quaternion))}]"
        )
    if table.time not in (common, None):
        lines.append(f"  time: {table.time}")
    units = _guess_pose_units(pose)
    return [_correct_heading(line, pose, units) for line in lines] + units


def _guess_pose_units(pose: PoseGuess) -> list[str]:
    """Returns the lines on the units of a pose, by its names, else by what is plausible."""
    place = "deg" if {*split_words(pose.x)} & {*GLOBE} else split_unit(pose.x)[1]
    turned = split_unit(pose.heading or "")[1]
    said = []
    for key, unit in (("unit", place), ("heading_unit", turned)):
        if (
            unit is not None
            and UNITS[unit].factor != 1.0
            and UNITS[unit].si in ("m", "rad")
        ):
            said.append(f"  {key}: {unit}  {GUESSED}")
    if place is not None or turned is not None:
        return said
    for _ in range(2):
        values = _compute_poses(pose, said)
        if values is None:
            break
        fault = recordings.find_implausible_pose(
            *values, radius=_guess_radius(values, 0.0)
        )
        if fault is not None and not fault.line.startswith("time"):
            said.append(f"  {fault.line}  {GUESSED}: else {fault.reason}")
    return said


def _correct_heading(line: str, pose: PoseGuess, units: Sequence[str]) -> str:
    """Returns the heading's line as that of a compass, if the path only leads along such a one."""
    if not line.startswith("  heading: "):
        return line
    values = _compute_poses(pose, units)
    if values is None:
        return line
    apart = values[1][select_along_path(values[1], _guess_radius(values))]
    keys = find_clockwise_keys(apart)
    keys = keys or find_clockwise_keys(
        select_apart(values[1]), MIRRORED, MIRRORED_BETTER
    )
    if not keys:
        return line
    why = "else heading and path turn opposite ways"
    return f"  heading: {{from: {line.partition(': ')[2]}, {keys}}}  {GUESSED}: {why}"


def _compute_poses(pose: PoseGuess, lines: Sequence[str]) -> tuple[Array, Array] | None:
    """Returns stamps (T,) and poses (T, 3) of a guess in the units of its lines, if known."""
    table = pose.table
    if table.t is None:
        return None
    columns = [table.data[name].astype(np.float64) for name in pose.columns]
    if any(len(each) != len(table.t) for each in columns):  # of several streams
        return None
    x, y, *turned = columns
    heading = turned[0] if len(turned) == 1 else _compute_heading(*turned)
    values = np.stack([x, y, heading], axis=1)
    whole = np.isfinite(values).all(axis=1)
    if whole.sum() < 3:
        return None
    text = "\n".join(lines)
    units = re.findall(r"^  (unit|heading_unit): (\S+)", text, re.MULTILINE)
    for key, unit in units:
        part = np.s_[:, :2] if key == "unit" else np.s_[:, 2]
        values[part] *= UNITS[unit].factor
        if key == "unit" and UNITS[unit].si == "rad":
            values[part] = np.stack(east_and_north(*values[part].T), axis=1)
    if turned_round := re.search(
        r"^  heading: .* scale: -1(?:, offset: ([\d.]+))?}", text, re.M
    ):
        values[:, 2] = float(turned_round[1] or 0.0) - values[:, 2]
    return table.t[whole], values[whole]


def _compute_heading(x: Array, y: Array, z: Array, w: Array) -> Array:
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _guess_radius(
    values: tuple[Array, Array] | None, fastest: float = FAR_AWAY
) -> float:
    """Returns the radius of a robot [m]: of a car if it is as fast, or on a map of the land."""
    if values is None:
        return NO_RADIUS
    t, pose = values
    path = np.hypot(*np.diff(pose[:: max(1, len(t) // 200), :2], axis=0).T).sum()
    surveyed = (
        np.abs(pose[:, :2]).min() > FAR_AWAY
        and np.ptp(pose[:, :2], axis=0).max() < FAR_AWAY
    )
    fast = FAST_CAR * float(np.ptp(t)) < path < fastest
    return CAR_RADIUS if surveyed or fast else NO_RADIUS
