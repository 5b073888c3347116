"""Reads the streams of a recording of any form as its mapping says."""

from collections.abc import Mapping as Names
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array, east_and_north, wrap_angle
from nics_drl_bridge.recording import mapping as schema
from nics_drl_bridge.recording import recording as recordings
from nics_drl_bridge.recording import stamping
from nics_drl_bridge.recording.episodes import split_by_time, split_table
from nics_drl_bridge.recording.joining import join
from nics_drl_bridge.recording.mapping import (
    ImuSource,
    Mapping,
    Measured,
    PoseSource,
    Reference,
    Value,
    explain_no_command,
)
from nics_drl_bridge.recording.names import split_words
from nics_drl_bridge.recording.pose_source import guess_source_by_names
from nics_drl_bridge.recording.recording import (
    MeasuredBy,
    Recording,
    Stream,
    check_streams,
    find_implausible_pose,
)
from nics_drl_bridge.recording.table import Source, read_numbers
from nics_drl_bridge.recording.values import (
    MappedReader,
    Series,
    combine_series,
    get_unit,
)

QUATERNION_TOLERANCE = 0.05
MOST_TILT_DEG = 40.0  # median, of a robot that drives on wheels
# share of poses whose quaternion is zero: the tracker had lost the body
MOST_UNTRACKED = 0.05
NO_LENGTH = 1e-9
SHORTEST_S = 1.0
SHORT_OF_EARTH = {"lat", "lon", "lng", "long"}  # short names of latitude and longitude
NEAR_DEG = 1.0  # a drive is within so much of its latitude and longitude
MOST_RATIO = 100.0  # of durations of two streams of a drive


def read_mapped(source: Source, mapping: Mapping) -> Recording:
    """Reads the streams of a mapping; ConfigError, RecordingError: what is missing or wrong."""
    if mapping.episode is None:
        return _read_drive(source, mapping)[0]
    plain = mapping.model_copy(update={"episode": None})
    single = split_table(source, mapping)
    if not single:
        recording, since = _read_drive(source, plain)
        return split_by_time(source, mapping, recording, since)
    drives = []
    for episode in single:
        try:
            drives.append(replace(_read_drive(episode, plain)[0], source=episode.place))
        except RecordingError as error:
            raise RecordingError(f"episode {episode.episode}: {error}") from None
    return replace(join(drives), source=source.place)


def _read_drive(source: Source, mapping: Mapping) -> tuple[Recording, float]:
    """Reads a drive, and what was subtracted from the stamps of its pose [s]."""
    reader = MappedReader(source, mapping)
    _check_commands(reader, mapping.command)
    found: dict[str, Stream] = {"pose": read_pose(reader, mapping.pose)}
    groups: Names[str, Names[str, Value]] = {
        "command": mapping.command,
        "state": mapping.state,
    }
    for name, values in groups.items():
        if values:
            held = name == "command"
            parts = [
                reader.read_series(f"{name}.{k}", v, None, held)
                for k, v in values.items()
            ]
            found[name] = combine_series(name, parts, held)
    if mapping.imu is not None and mapping.imu.heading is not None:
        found["imu"] = _read_turn_rate(reader, mapping.imu, mapping.imu.heading)
    for name in ("wheels", "imu", "odometry"):
        if name not in found and (stream := getattr(mapping, name)) is not None:
            found[name] = _read_measured(reader, name, stream)
    for name, stream in found.items():
        keep, note = stamping.select_new_rows(stream.t, stream.values, name)
        reader.add_notes(note)
        found[name] = stream.rows(keep)
    names = (*mapping.state, *mapping.command)
    streams = cast(Any, found)
    measured_by = mapping.pose.measured_by or _guess_pose_source(source, mapping)
    made = Recording(
        **streams,
        source=source.place,
        variables=names,
        latency=source.latency,
        measured_by=measured_by,
    )
    check_streams(
        made,
        {"command": len(mapping.command), "state": len(mapping.state), "wheels": 2},
    )
    shifted: Any = _shift_to_zero(found, mapping.clock or schema.ROBOT_CLOCK, reader)
    since = float(found["pose"].t[0] - shifted["pose"].t[0])
    return replace(made, **shifted, repairs=tuple(reader.notes)), since


def _check_commands(reader: MappedReader, commands: Names[str, Value]) -> None:
    """Refuses what was measured, by the name of its column, where a command is needed."""
    for name, value in commands.items():
        table, which = reader.locate(value.from_)
        is_number = isinstance(which, int) or (
            which not in table.names and which.isdecimal()
        )
        known = is_number and int(which) < len(table.names)
        column = table.names[int(which)] if known else str(which)
        if why := explain_no_command(column):
            raise ConfigError(f"{table.place}: command.{name}: {why}.")
        words = {*split_words(column)}
        if words & SHORT_OF_EARTH and _is_place_on_earth(read_numbers(table, which)):
            fault = f"{column!r} looks like a latitude or longitude, and was not sent to the robot"
            raise ConfigError(
                f"{table.place}: command.{name}: {fault}; name a column that was."
            )


def _is_place_on_earth(values: Array) -> bool:
    """True for values that stay within a degree, far from zero, as places on the earth do."""
    known = values[np.isfinite(values)]
    return len(known) > 0 and np.ptp(known) < NEAR_DEG <= np.abs(known).max()


def _guess_pose_source(source: Source, mapping: Mapping) -> MeasuredBy:
    """Returns what measured the pose, by the names of its topic or file, columns and frames."""
    pose = mapping.pose
    values = (pose.x, pose.y, pose.heading)
    references = [value.from_ for value in values if value is not None]
    tables = [pose.in_, *(str(each).partition(":")[0] for each in references)]
    topics = [name for table in tables if table for name in (table, f"/{table}")]
    kinds = [source.get_table(name).kind for name in topics if name in source.names]
    kind = next((each for each in kinds if each), "")
    names = [pose.in_, pose.clock, *pose.frames, *references]
    return guess_source_by_names(
        (str(name) for name in names if name is not None), kind
    )


def _read_turn_rate(reader: MappedReader, imu: ImuSource, heading: Value) -> Stream:
    """Reads a second heading as accelerations of zero and the turn rate that integrates to it."""
    heading = heading.model_copy(update={"unit": heading.unit or "rad"})
    unit = get_unit(heading).si
    if unit != "rad":
        raise ConfigError(
            f"imu.heading: is in {unit}, where rad is needed; check its unit."
        )
    series = reader.read_series("imu.heading", heading, imu, held=False)
    joined = combine_series("imu", [series], held=False)
    t = joined.t
    keep = np.concatenate([[True], np.diff(t) > 0.0])
    joined = joined.rows(keep)
    t = t[keep]
    if len(t) < 2:
        return replace(joined, values=np.zeros((len(t), 3)))
    turned = np.unwrap(joined.values[:, 0])
    rate = np.gradient(turned, t)
    return replace(
        joined, values=np.stack([np.zeros_like(t), np.zeros_like(t), rate], axis=1)
    )


def _check_units(reader: MappedReader, pose: Stream) -> None:
    """Refuses poses, as they were recorded, that only a wrong unit explains."""
    mapping = reader.mapping
    if isinstance(mapping.robot, dict):
        given = mapping.robot.get("footprint_radius")
    else:
        given = None
    radius = float(given) if isinstance(given, (int, float)) else 0.0
    if fault := find_implausible_pose(pose.t, pose.values, radius=radius):
        time = mapping.pose.time or mapping.time
        line = fault.line.replace("...", str(time.columns[0] if time else "t"))
        said = f"{reader.source.place}: pose: {fault.reason}; {fault.cause}"
        raise RecordingError(f"{said}: write `{line}` into the mapping, below `pose:`.")


def _read_measured(reader: MappedReader, name: str, stream: Measured) -> Stream:
    """Reads a stream of measurements; values that it lacks are zero."""
    parts: list[Series | None] = []
    for key, kinds in schema.SI[name].items():
        value: Value | None = getattr(stream, key)
        if (
            value is not None
            and value.unit is not None
            and get_unit(value).si not in kinds
        ):
            fault = f"{name}.{key}: is in {get_unit(value).si}"
            raise ConfigError(
                f"{fault}, where {' or '.join(kinds)} is needed; check its unit."
            )
        parts.append(
            reader.read_series(f"{name}.{key}", value, stream, False) if value else None
        )
    joined = combine_series(
        name, [part for part in parts if part is not None], held=False
    )
    columns = iter(joined.values.T)
    full = [
        np.zeros(len(joined.t)) if part is None else next(columns) for part in parts
    ]
    return replace(joined, values=np.stack(full, axis=1))


def read_pose(reader: MappedReader, pose: PoseSource) -> Stream:
    """Reads poses, with their deviations where a covariance is mapped."""
    if pose.x is None:
        pose = _complete_pose(reader, pose)
    parts = []
    factors = []
    whole = list[Value]()
    for key, kinds in schema.SI["pose"].items():
        value: Value | None = getattr(pose, key)
        if value is None:
            parts.append(_read_heading(reader, pose, pose.quaternion or ""))
            factors.append(schema.UNITS[pose.heading_unit].factor)
            continue
        unit = value.unit or (pose.heading_unit if key == "heading" else pose.unit)
        value = value.model_copy(update={"unit": unit})
        kinds = kinds if key != "y" else (get_unit(whole[0]).si,)
        whole.append(value)
        if get_unit(value).si not in kinds:
            fault = f"pose.{key}: is in {get_unit(value).si}, not in {kinds[0]}"
            raise ConfigError(f"{fault}; check its unit.")
        parts.append(reader.read_series(f"pose.{key}", value, pose, held=False))
        factors.append(abs(get_unit(value).factor * value.scale))
        if (
            key == "y" and get_unit(value).si == "rad"
        ):  # longitude, latitude; covariances are in m
            ground = east_and_north(parts[0].values, parts[1].values)
            parts = [
                each._replace(values=v) for each, v in zip(parts, ground, strict=True)
            ]
            factors = [1.0, 1.0]
    _check_units(reader, combine_series("pose", parts, held=False))
    heading = parts[2]
    parts[2] = heading._replace(
        values=np.unwrap(heading.values)
    )  # as it may be interpolated
    made = combine_series("pose", parts, held=False)
    made.values[:, 2] = wrap_angle(made.values[:, 2])
    if pose.covariance is None:
        return made
    sigma = _read_deviations(reader, pose, pose.covariance, made.t)
    return made if sigma is None else replace(made, sigma=sigma * np.array(factors))


def _read_heading(
    reader: MappedReader, pose: PoseSource, given: str | Sequence[Reference]
) -> Series:
    """Returns the heading of quaternions; those of length 0 are left out."""
    each = [f"{given}.{axis}" for axis in "xyzw"] if isinstance(given, str) else given
    parts = [
        reader.read_series(
            "pose.quaternion", Value.model_validate({"from": which}), pose, held=False
        )
        for which in each
    ]
    made = combine_series("pose.quaternion", parts, held=False)
    norm = np.linalg.norm(made.values, axis=1)
    lost = norm < NO_LENGTH
    if lost.any() and lost.mean() <= MOST_UNTRACKED:
        some = f"{int(lost.sum())} of {len(lost)} rows without orientation"
        reader.add_notes(f"pose: {some} were left out.")
        made = made.rows(~lost)
        norm = norm[~lost]
    for k in np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_TOLERANCE)[:1]:
        where = (
            f"{reader.source.place}: pose: {made.t[k] - made.t[0]:.3f} s from the start"
        )
        fault = f"{where} the quaternion has the length {norm[k]:.3f} and not 1"
        raise RecordingError(f"{fault}; list its columns in the order x, y, z, w.")
    if recordings.is_w_first(made.values):
        raise RecordingError(f"{reader.source.place}: pose: {recordings.W_FIRST}.")
    x, y, z, w = made.values.T
    tilt = np.degrees(
        np.median(np.arccos(np.clip(np.abs(1.0 - 2.0 * (x * x + y * y)), 0.0, 1.0)))
    )
    if tilt > MOST_TILT_DEG:
        fault = f"pose: by its quaternion the body is tilted by {tilt:.0f} deg"
        advice = "list its columns in the order x, y, z, w, or, if y is up, as [qz, qx, qy, qw]"
        raise RecordingError(f"{reader.source.place}: {fault}; {advice}.")
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return Series(made.t, heading, made.clock)


POSES = (
    ("pose.pose.position.{}", "pose.pose.orientation", "pose.covariance"),
    ("pose.position.{}", "pose.orientation", None),
    ("transform.translation.{}", "transform.rotation", None),
    ("position.{}", "orientation", None),
    ("{}", "theta", None),
)
"""Fields of messages that are poses: position, orientation, covariance."""


def _complete_pose(reader: MappedReader, pose: PoseSource) -> PoseSource:
    """Completes a pose of which only the topic is given."""
    table, _ = reader.locate("", pose.in_)
    for position, turned, covariance in POSES:
        x, y = (position.format(axis) for axis in "xy")
        quaternion = f"{turned}.w" in table.names
        if x in table.names and (quaternion or turned in table.names):
            known = {"x": x, "y": y, "quaternion" if quaternion else "heading": turned}
            given = pose.model_dump(by_alias=True, exclude_none=True)
            if covariance is not None and "covariance" not in given:
                known["covariance"] = covariance
            return PoseSource.model_validate({**given, **known})
    fault = f"{table.place}: its messages are no poses of a known form"
    raise RecordingError(
        f"{fault}; name x, y and heading or quaternion in the mapping."
    )


def _read_deviations(
    reader: MappedReader, pose: PoseSource, given: str | Sequence[Reference], t: Array
) -> Array | None:
    """Returns standard deviations (T, 3) from variances or a matrix; None if they say nothing."""
    if isinstance(given, str):
        table, which = reader.locate(given, pose.in_)
        count = sum(name.startswith(f"{which}[") for name in table.names)
        if count not in schema.COVARIANCES:
            fault = f"{table.place}: {which!r} has {count} numbers"
            raise RecordingError(f"{fault}; a covariance has 3, 9 or 36.")
        given = [f"{given}[{k}]" for k in range(count)]
    columns = []
    for k in schema.COVARIANCES[len(given)]:
        value = Value.model_validate({"from": given[k]})
        part = reader.read_series(
            "pose.covariance", value, pose, held=False, infinite=True
        )
        positive = part.values > 0.0
        known = np.interp(t, part.t, positive) == 1.0
        variance = np.interp(t, part.t, np.where(positive, part.values, 0.0))
        columns.append(np.sqrt(np.where(known, variance, np.nan)))
    sigma = np.stack(columns, axis=1)
    unknown = np.isnan(sigma)
    if unknown.all():
        return None
    if unknown.any():
        rows = int(unknown.any(axis=1).sum())
        reader.add_notes(
            f"pose: {rows} of {len(t)} rows have a variance that is not positive: unknown."
        )
    return sigma


def _shift_to_zero(
    found: dict[str, Stream], main: str, reader: MappedReader
) -> dict[str, Stream]:
    """Shifts stamps to begin near 0: by one origin, but for clocks whose spans do not overlap."""
    spans: dict[str, list[float]] = {}
    for name, stream in found.items():
        first = float(stream.t[0])
        last = float(stream.t[-1])
        span = spans.setdefault(stream.clock, [first, last])
        if first > span[1] or last < span[0]:
            fault = (
                f"{reader.source.place}: {name} lasts from {first:.3f} to {last:.3f} s"
            )
            other = f"the streams before it from {span[0]:.3f} to {span[1]:.3f} s, on one clock"
            advice = "check their `time:`, or give one of them a `clock:` of its own"
            raise RecordingError(f"{fault}, {other}; {advice}.")
        span[:] = min(first, span[0]), max(last, span[1])
    pose = found["pose"]
    for name, stream in found.items():
        lasts = np.ptp(stream.t)
        usual = max(np.ptp(pose.t), 1e-9)
        if name == "pose" and lasts < SHORTEST_S:
            fault = f"{reader.source.place}: the pose lasts {lasts:.3g} s"
            raise RecordingError(
                f"{fault}; give the `unit:` of its `time:`, as s, min or h."
            )
        if lasts and not 1.0 / MOST_RATIO < lasts / usual < MOST_RATIO:
            fault = f"{reader.source.place}: {name} lasts {lasts:.4g} s, the pose {usual:.4g} s"
            raise RecordingError(
                f"{fault}; give the `unit:` of the `time:` that is wrong."
            )
    base = spans.get(main) or next(iter(spans.values()))
    origin = {}
    combine_series = [
        span for span in spans.values() if span[0] <= base[1] and span[1] >= base[0]
    ]
    first = min(span[0] for span in combine_series)
    for clock, span in spans.items():
        origin[clock] = first if span in combine_series else span[0]
        if span not in combine_series:
            reader.add_notes(
                f"The clock {clock!r} was set to 0 at its first stamp, {span[0]:.3f} s."
            )
    return {
        n: replace(each, t=each.t - origin[each.clock]) for n, each in found.items()
    }
