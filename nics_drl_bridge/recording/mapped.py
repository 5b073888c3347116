"""Reads the streams of a recording in any format according to its mapping."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array, east_and_north, wrap_angle
from nics_drl_bridge.recording import mapping as schema
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.joining import join, split_at
from nics_drl_bridge.recording.mapping import (
    DriveMapping,
    ImuSource,
    Measured,
    PoseSource,
    Reference,
    Value,
    explain_no_command,
    is_place_on_earth,
    may_be_place_on_earth,
)
from nics_drl_bridge.recording.recording import (
    MeasuredBy,
    Recording,
    Stream,
    check_streams,
    find_implausible_pose,
)
from nics_drl_bridge.recording.table import Source, Table, read_numbers
from nics_drl_bridge.recording.topic_roles import guess_source_by_names
from nics_drl_bridge.recording.values import (
    MappedReader,
    Series,
    combine_series,
    get_unit,
)
from nics_drl_bridge.robot.spec import RobotSpec

QUATERNION_TOLERANCE = 0.05
MOST_TILT_DEG = 40.0  # maximum median tilt of a robot that drives on wheels
# Maximum fraction of zero quaternions, where the tracker lost the body
MOST_UNTRACKED = 0.05
NO_LENGTH = 1e-9
MIN_EPISODE_ROWS = 3  # shorter episodes are left out
MIN_POSE_S = 1.0
MOST_RATIO = 100.0  # maximum ratio of the durations of two streams of a drive


def read_mapped(
    source: Source, mapping: DriveMapping, spec: RobotSpec | None = None
) -> Recording:
    """Reads a recording by its mapping. Raises ConfigError or RecordingError if they do not fit.

    Only the messages of a `command_topic` need the robot.
    """
    source.use(mapping)
    if mapping.episode is None:
        return _read_drive(source, mapping, spec)[0]
    plain = mapping.model_copy(update={"episode": None})
    episodes = _split_table(source, mapping, mapping.episode)
    if not episodes:
        recording, origin_s = _read_drive(source, plain, spec)
        return _split_by_time(source, mapping, recording, origin_s)
    drives = []
    for label, episode in episodes:
        try:
            drive, _ = _read_drive(episode, plain, spec)
            drives.append(replace(drive, source=episode.place))
        except RecordingError as error:
            raise RecordingError(f"episode {label}: {error}") from None
    return replace(join(drives), source=source.place)


class _Episode(Source):
    """The rows of one episode in a table that holds everything that a mapping reads."""

    def __init__(
        self, place: str, name: str, table: Table, rows: NDArray[np.intp]
    ) -> None:
        super().__init__(place, [name])
        self._table = replace(
            table,
            place=place,
            column=lambda which: table.column(which)[rows],
            row=lambda k: table.row(int(rows[k])),
        )

    def read(self, name: str) -> Table:
        """Returns the table with the rows of the episode."""
        return self._table


def _split_table(
    source: Source, mapping: DriveMapping, episode: Reference
) -> list[tuple[str, Source]]:
    """Returns label and rows of each episode of a table.

    Empty for several tables, or rows that come with stamps. Raises ConfigError if no episode is
    long enough.
    """
    reader = MappedReader(source, mapping)
    table, reference = reader.locate(episode)
    pose = mapping.pose
    used = [reader.locate(pose.x.from_ if pose.x else 0, pose.in_)[0]]
    for value in (*mapping.command.values(), *mapping.state.values()):
        used.append(reader.locate(value.from_)[0])
    # Stamps that come with the rows continue from one episode to the next.
    if (
        any(used_table is not table for used_table in used)
        or table.stamps("") is not None
    ):
        return []
    name = next(name for name in source.names if source.get_table(name) is table)
    episodes: list[tuple[str, Source]] = []
    column = table.column(reference)
    _, firsts, groups = np.unique(column, return_index=True, return_inverse=True)
    for k in np.argsort(firsts):
        rows = np.flatnonzero(groups == k)
        if len(rows) >= MIN_EPISODE_ROWS:
            label = _format_label(column[firsts[k]])
            place = f"{source.place} (episode {label})"
            episodes.append((label, _Episode(place, name, table, rows)))
    if not episodes:
        raise ConfigError(
            f"{table.place}: no value of the column {reference!r} lasts for "
            f"{MIN_EPISODE_ROWS} rows; name the column that numbers the episodes."
        )
    return episodes


def _split_by_time(
    source: Source, mapping: DriveMapping, recording: Recording, since: float
) -> Recording:
    """Splits a recording where its episode column changes.

    `since` [s] was subtracted from its stamps. Raises ConfigError if pose and commands have
    different clocks.
    """
    if recording.pose.clock != recording.command.clock:
        raise ConfigError(
            f"{source.place}: episode: pose and commands have separate clocks; give "
            "each episode as a separate recording."
        )
    reader = MappedReader(source, mapping)
    table, which = reader.locate(mapping.episode or 0)
    column = table.column(which)
    stamped = reader.stamp_rows(table, column, None)
    values = column[stamped.rows]
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    starts = [-np.inf, *(stamped.t[changes] - since)]
    names = [
        f"{source.place} (episode {_format_label(values[k])})" for k in (0, *changes)
    ]
    return split_at(recording, starts, names)


def _format_label(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{float(value):g}"


def _read_drive(
    source: Source, mapping: DriveMapping, spec: RobotSpec | None
) -> tuple[Recording, float]:
    """Returns a drive, and the time that was subtracted from the stamps of its pose [s]."""
    reader = MappedReader(source, mapping)
    _check_commands(reader, mapping.command)
    streams = {"pose": read_pose(reader, mapping.pose, spec)}
    commands = tuple(mapping.command)
    if mapping.command_topic is None:
        streams["command"] = _read_values(reader, "command", mapping.command, held=True)
    else:
        if spec is None:
            raise ConfigError(
                f"{source.place}: command: the messages of {mapping.command_topic!r} "
                "are commands only of a known robot; give --robot, or a RobotSpec."
            )
        streams["command"] = _read_command_topic(reader, mapping.command_topic, spec)
        commands = tuple(variable.name for variable in spec.command)
    if mapping.state:
        streams["state"] = _read_values(reader, "state", mapping.state, held=False)
    for name in ("wheels", "imu", "odometry"):
        measured = getattr(mapping, name)
        if isinstance(measured, ImuSource) and measured.heading is not None:
            streams[name] = _read_turn_rate(reader, measured, measured.heading)
        elif measured is not None:
            streams[name] = _read_measured(reader, name, measured)
    for name, stream in streams.items():
        is_new, note = stamping.select_new_rows(stream.t, stream.values, name)
        reader.add_notes(note)
        streams[name] = stream.rows(is_new)
    recording = Recording(
        **cast(Any, streams),
        source=source.place,
        variables=(*mapping.state, *commands),
        latency=source.latency,
        measured_by=mapping.pose.measured_by or _guess_pose_source(source, mapping),
    )
    widths = {"command": len(commands), "state": len(mapping.state), "wheels": 2}
    check_streams(recording, widths)
    shifted: Any = _shift_to_zero(streams, mapping.clock or schema.ROBOT_CLOCK, reader)
    origin_s = float(streams["pose"].t[0] - shifted["pose"].t[0])
    return replace(recording, **shifted, repairs=tuple(reader.notes)), origin_s


def _read_values(
    reader: MappedReader,
    name: str,
    values: Mapping[str, Value],
    held: bool,
    source: Measured | None = None,
) -> Stream:
    """Reads values into a stream with a column for each."""
    parts = [
        reader.read_series(f"{name}.{key}", value, source, held)
        for key, value in values.items()
    ]
    return combine_series(name, parts, held)


def _check_commands(reader: MappedReader, commands: Mapping[str, Value]) -> None:
    """Refuses a column as a command if its name or values show that it was measured."""
    for name, value in commands.items():
        table, reference = reader.locate(value.from_)
        column = str(reference)
        is_number = column.isdecimal() and reference not in table.names
        if is_number and int(column) < len(table.names):
            column = table.names[int(column)]
        fault = explain_no_command(column)
        if not fault and may_be_place_on_earth(column):
            values = read_numbers(table, reference)
            values = values[np.isfinite(values)]
            if len(values) and is_place_on_earth(column, values.min(), values.max()):
                fault = f"{column!r} looks like a latitude or longitude"
                fault += ", which was not sent to the robot; name a column that was"
        if fault:
            raise ConfigError(f"{table.place}: command.{name}: {fault}.")


def _guess_pose_source(source: Source, mapping: DriveMapping) -> MeasuredBy:
    """Returns what measured the pose, guessed from names of topic or file, columns and frames."""
    pose = mapping.pose
    values = (pose.x, pose.y, pose.heading)
    references = [str(value.from_) for value in values if value is not None]
    tables = [pose.in_, *(name.partition(":")[0] for name in references)]
    known = [
        source.get_table(name).kind
        for table in tables
        for name in (table, f"/{table}")
        if table and name in source.names
    ]
    names = (pose.in_, pose.clock, *pose.frames, *references)
    kind = next(filter(None, known), "")
    return guess_source_by_names(filter(None, names), kind)


def _read_turn_rate(reader: MappedReader, imu: ImuSource, heading: Value) -> Stream:
    """Reads a second heading as the turn rate that integrates to it, without accelerations."""
    heading = heading.model_copy(update={"unit": heading.unit or "rad"})
    _check_unit("imu.heading", heading, ("rad",))
    stream = _read_values(reader, "imu", {"heading": heading}, False, imu)
    stream = stream.rows(np.append(True, np.diff(stream.t) > 0.0))
    values = np.zeros((len(stream.t), 3))
    if len(stream.t) > 1:
        values[:, 2] = np.gradient(np.unwrap(stream.values[:, 0]), stream.t)
    return replace(stream, values=values)


def _check_unit(name: str, value: Value, needed: Sequence[str]) -> None:
    """Refuses a value whose unit is not of one of the needed SI units (ConfigError)."""
    si = get_unit(value).si
    if si not in needed:
        raise ConfigError(
            f"{name}: is in {si}, where {' or '.join(needed)} is needed; check its unit."
        )


def _refuse_implausible_pose(
    reader: MappedReader, pose: Stream, spec: RobotSpec | None
) -> None:
    """Refuses poses that only a wrong unit explains (RecordingError)."""
    mapping = reader.mapping
    radius = 0.0
    if spec is not None:
        radius = spec.footprint_radius
    elif isinstance(mapping.robot, dict):
        given_radius = mapping.robot.get("footprint_radius")
        if isinstance(given_radius, (int, float)):
            radius = float(given_radius)
    fault = find_implausible_pose(pose.t, pose.values, radius=radius)
    if fault is None:
        return
    column = "t"
    time = mapping.pose.time or mapping.time
    if time:
        column = str(time.columns[0])
    line = fault.line.replace("...", column)
    raise RecordingError(
        f"{reader.source.place}: pose: {fault.reason}; {fault.cause}: write `{line}` "
        "into the mapping, below `pose:`."
    )


def _read_measured(reader: MappedReader, name: str, source: Measured) -> Stream:
    """Reads a stream of measurements; values that are not mapped are zero."""
    values: dict[str, Value] = {}
    for key, kinds in schema.SI[name].items():
        value: Value | None = getattr(source, key)
        if value is not None:
            values[key] = value
            if value.unit is not None:
                _check_unit(f"{name}.{key}", value, kinds)
    measured = _read_values(reader, name, values, False, source)
    rows = np.zeros((len(measured.t), len(schema.SI[name])))
    rows[:, [list(schema.SI[name]).index(key) for key in values]] = measured.values
    return replace(measured, values=rows)


COMMANDS = (
    ("twist.linear.x", "twist.linear.y", "twist.angular.z"),
    ("linear.x", "linear.y", "angular.z"),
    ("drive.speed", "drive.steering_angle"),
    ("speed", "steering_angle"),
)
"""Fields of messages that are commands: velocities, or speed and steering angle."""


def _read_command_topic(reader: MappedReader, topic: str, spec: RobotSpec) -> Stream:
    """Reads the commands (T, C) of a robot from velocities or Ackermann drives."""
    table, _ = reader.locate("", topic)
    fields = next((form for form in COMMANDS if {*form} <= {*table.names}), None)
    if fields is None:
        raise RecordingError(
            f"{table.place}: its messages are not commands of a known form; name each "
            "command in the mapping."
        )
    is_steered = len(fields) == 2
    for variable in spec.command:
        if is_steered and variable.turns and not variable.steers:
            raise RecordingError(
                f"{table.place}: holds steering angles [rad], but {variable.name!r} of "
                f"robot {spec.name!r} is in {variable.unit}; choose the recorded "
                "robot, or another topic."
            )
    values = {field: _make_plain_value(f"{topic}:{field}") for field in fields}
    stream = _read_values(reader, "command", values, held=True)
    if not is_steered:
        return replace(stream, values=spec.from_cmd_vel(stream.values))
    speed, angle = stream.values.T
    rows = np.stack([speed, np.zeros_like(speed), angle], axis=1)
    return replace(stream, values=spec.from_fields(rows))


def read_pose(
    reader: MappedReader, pose: PoseSource, spec: RobotSpec | None = None
) -> Stream:
    """Reads poses (T, 3), with standard deviations if a covariance is mapped."""
    if pose.x is None:
        pose = _complete_pose(reader, pose)
    kinds = dict(schema.SI["pose"])
    parts = []
    factors = []
    for key in schema.SI["pose"]:
        value: Value | None = getattr(pose, key)
        if value is None:
            parts.append(_read_heading(reader, pose, pose.quaternion or ""))
            factors.append(schema.UNITS[pose.heading_unit].factor)
            continue
        usual = pose.heading_unit if key == "heading" else pose.unit
        value = value.model_copy(update={"unit": value.unit or usual})
        _check_unit(f"pose.{key}", value, kinds[key])
        unit = get_unit(value)
        if key == "x":
            kinds["y"] = (unit.si,)
        parts.append(reader.read_series(f"pose.{key}", value, pose, held=False))
        factors.append(abs(unit.factor * value.scale))
    if kinds["y"] == ("rad",):
        # Longitude and latitude; their covariances are in m.
        east, north = east_and_north(parts[0].values, parts[1].values)
        parts[:2] = [parts[0]._replace(values=east), parts[1]._replace(values=north)]
        factors[:2] = [1.0, 1.0]
    _refuse_implausible_pose(reader, combine_series("pose", parts, held=False), spec)
    # A heading can be interpolated only once it is unwrapped.
    parts[2] = parts[2]._replace(values=np.unwrap(parts[2].values))
    stream = combine_series("pose", parts, held=False)
    stream.values[:, 2] = wrap_angle(stream.values[:, 2])
    if not pose.covariance:
        return stream
    sigma = _read_deviations(reader, pose, pose.covariance, stream.t)
    if sigma is not None:
        sigma = sigma * np.array(factors)
    return replace(stream, sigma=sigma)


def _read_heading(
    reader: MappedReader, pose: PoseSource, references: str | Sequence[Reference]
) -> Series:
    """Returns the headings of quaternions, without quaternions of length 0."""
    if isinstance(references, str):
        references = [f"{references}.{axis}" for axis in "xyzw"]
    values = dict(zip("xyzw", map(_make_plain_value, references), strict=True))
    stream = _read_values(reader, "pose.quaternion", values, False, pose)
    place = f"{reader.source.place}: pose"
    length = np.linalg.norm(stream.values, axis=1)
    is_lost = length < NO_LENGTH
    if is_lost.any():
        lost = f"{int(is_lost.sum())} of {len(is_lost)} rows"
        if is_lost.mean() > MOST_UNTRACKED:
            raise RecordingError(
                f"{place}: {lost} have a quaternion of length 0: the body was not tracked, "
                "or the columns are not its own; map other columns, or record the drive again."
            )
        reader.add_notes(f"pose: {lost} without orientation were left out.")
        stream = stream.rows(~is_lost)
        length = length[~is_lost]
    wrong = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
    if len(wrong) > 0:
        row = wrong[0]
        raise RecordingError(
            f"{place}: {stream.t[row] - stream.t[0]:.3f} s from the start the "
            f"quaternion has the length {length[row]:.3f} and not 1; list its columns "
            "in the order x, y, z, w."
        )
    if recordings.is_w_first(stream.values):
        raise RecordingError(f"{place}: {recordings.W_FIRST}.")
    x, y, z, w = stream.values.T
    cosine = np.clip(np.abs(1.0 - 2.0 * (x * x + y * y)), 0.0, 1.0)
    tilt = np.degrees(np.median(np.arccos(cosine)))
    if tilt > MOST_TILT_DEG:
        raise RecordingError(
            f"{place}: by its quaternion the body is tilted by {tilt:.0f} deg; list "
            "its columns in the order x, y, z, w, or, if y is up, as [qz, qx, qy, qw]."
        )
    headings = recordings.compute_heading(x, y, z, w)
    return Series(stream.t, headings, stream.clock)


def _make_plain_value(reference: Reference) -> Value:
    """Returns a value that is read as it is."""
    return Value.model_validate({"from": reference})


POSES = (
    ("pose.pose.position.{}", "pose.pose.orientation", "pose.covariance"),
    ("pose.position.{}", "pose.orientation", None),
    ("transform.translation.{}", "transform.rotation", None),
    ("position.{}", "orientation", None),
    ("{}", "theta", None),
)
"""Fields of messages that are poses: position, orientation, covariance."""


def _complete_pose(reader: MappedReader, pose: PoseSource) -> PoseSource:
    """Completes a pose that is given by its topic only."""
    table, _ = reader.locate("", pose.in_)
    for position, orientation, covariance in POSES:
        keys = {"x": position.format("x"), "y": position.format("y")}
        if f"{orientation}.w" in table.names:
            keys["quaternion"] = orientation
        elif orientation in table.names:
            keys["heading"] = orientation
        if len(keys) < 3 or keys["x"] not in table.names:
            continue
        mapped = pose.model_dump(by_alias=True, exclude_none=True)
        if covariance is not None and "covariance" not in mapped:
            keys["covariance"] = covariance
        return PoseSource.model_validate({**mapped, **keys})
    raise RecordingError(
        f"{table.place}: its messages are not poses of a known form; name x, y and "
        "heading or quaternion in the mapping."
    )


def _read_deviations(
    reader: MappedReader,
    pose: PoseSource,
    references: str | Sequence[Reference],
    t: Array,
) -> Array | None:
    """Returns standard deviations (T, 3) from variances or a matrix; None if none is known."""
    if isinstance(references, str):
        table, field = reader.locate(references, pose.in_)
        count = sum(name.startswith(f"{field}[") for name in table.names)
        if count not in schema.COVARIANCES:
            raise RecordingError(
                f"{table.place}: {field!r} has {count} numbers; a covariance has 3, 9 or 36."
            )
        references = [f"{references}[{k}]" for k in range(count)]
    columns = []
    for k in schema.COVARIANCES[len(references)]:
        value = _make_plain_value(references[k])
        series = reader.read_series(
            "pose.covariance", value, pose, held=False, allow_infinite=True
        )
        is_positive = series.values > 0.0
        # Both neighbours must be known.
        is_known = np.interp(t, series.t, is_positive) == 1.0
        variance = np.interp(t, series.t, np.where(is_positive, series.values, 0.0))
        columns.append(np.sqrt(np.where(is_known, variance, np.nan)))
    sigma = np.stack(columns, axis=1)
    is_unknown = np.isnan(sigma)
    if is_unknown.all():
        return None
    if is_unknown.any():
        rows = int(is_unknown.any(axis=1).sum())
        reader.add_notes(
            f"pose: {rows} of {len(t)} rows have a variance that is not positive: unknown."
        )
    return sigma


def _shift_to_zero(
    streams: dict[str, Stream], main_clock: str, reader: MappedReader
) -> dict[str, Stream]:
    """Shifts stamps to start near 0; clocks that overlap the main clock share its origin."""
    spans = _find_spans(streams, reader.source.place)
    _check_durations(streams, reader.source.place)
    start, stop = spans.get(main_clock) or next(iter(spans.values()))
    overlapping = [a for a, b in spans.values() if a <= stop and b >= start]
    origins = dict.fromkeys(spans, min(overlapping))
    for clock, (first, last) in spans.items():
        if first > stop or last < start:
            origins[clock] = first
            reader.add_notes(
                f"The clock {clock!r} was set to 0 at its first stamp, {first:.3f} s."
            )
    return {
        name: replace(stream, t=stream.t - origins[stream.clock])
        for name, stream in streams.items()
    }


def _find_spans(
    streams: dict[str, Stream], place: str
) -> dict[str, tuple[float, float]]:
    """Returns first and last stamp of each clock [s]; streams of one clock must overlap."""
    spans: dict[str, tuple[float, float]] = {}
    for name, stream in streams.items():
        first = float(stream.t[0])
        last = float(stream.t[-1])
        start, stop = spans.get(stream.clock, (first, last))
        if first > stop or last < start:
            raise RecordingError(
                f"{place}: {name} lasts from {first:.3f} to {last:.3f} s, the streams "
                f"before it from {start:.3f} to {stop:.3f} s, on one clock; check "
                "their `time:`, or give one of them a separate `clock:`."
            )
        spans[stream.clock] = min(first, start), max(last, stop)
    return spans


def _check_durations(streams: dict[str, Stream], place: str) -> None:
    """Refuses streams that last far longer or shorter than the pose, as with a wrong unit."""
    pose_s = float(np.ptp(streams["pose"].t))
    if pose_s < MIN_POSE_S:
        raise RecordingError(
            f"{place}: the pose lasts {pose_s:.3g} s; add `unit:` to its `time:`, "
            "such as s, min or h."
        )
    for name, stream in streams.items():
        duration_s = float(np.ptp(stream.t))
        if duration_s and not 1.0 / MOST_RATIO < duration_s / pose_s < MOST_RATIO:
            raise RecordingError(
                f"{place}: {name} lasts {duration_s:.4g} s, the pose {pose_s:.4g} s; "
                "add `unit:` to the `time:` that has the wrong unit."
            )
