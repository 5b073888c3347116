"""Readers of recordings: `FORMATS` recognises a recording and names the function that reads it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.arguments import check_path
from nics_drl_bridge.config import check_no_device, find_config
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.bag_file import is_bag, open_bag
from nics_drl_bridge.recording.bag_reader import load_bag
from nics_drl_bridge.recording.bag_table import Bag
from nics_drl_bridge.recording.mapped import read_mapped
from nics_drl_bridge.recording.mapping import Mapping, load_mapping
from nics_drl_bridge.recording.recording import (
    Recording,
    check,
    is_recording,
    load_recording,
)
from nics_drl_bridge.recording.table import Source
from nics_drl_bridge.recording.table_files import Files
from nics_drl_bridge.recording.topic_roles import TopicRoles, assign
from nics_drl_bridge.recording.values import get_unit
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, read_definition

FOLDER = "xtark_folder"  # shipped mapping of a folder that is read without a mapping
# Files that such a folder must have, and may have
FILES = ("cmd.csv", "vrpn.csv")
WHEELS = ("L_wheel.csv", "R_wheel.csv")
# Maximum size of each of these; with --map, tables may be larger
MAX_FILE_BYTES = 64 * 2**20


class Format(NamedTuple):
    """A format of recordings; the reader gets path, robot and roles of topics."""

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, RobotSpec | None, TopicRoles], Recording]
    has_topics: bool = False


def _holds(path: Path, files: tuple[str, ...]) -> bool:
    return all((path / name).is_file() for name in files)


def _load_folder(path: Path, *_: object) -> Recording:
    """Reads a folder by its shipped mapping; wheels may be missing, and its robot may be any."""
    file = find_config(FOLDER, "recordings")
    mapping = load_mapping(file)
    wheels = _holds(path, WHEELS)
    if not wheels:
        mapping = mapping.model_copy(update={"wheels": None})
    for name in FILES + WHEELS * wheels:
        if (path / name).stat().st_size > MAX_FILE_BYTES:
            raise RecordingError(
                f"{path / name}: is larger than {MAX_FILE_BYTES // 2**20} MB, which "
                f"few drives are; cut it, or give --map {file}."
            )
    try:
        with open_source(path) as source:
            return replace(read_mapped(source, mapping), variables=())
    except RecordingError as error:
        raise RecordingError(
            f"{error} The mapping is {file}; choose another with --map."
        ) from None


FORMATS = (
    Format("a bag", lambda p: p.exists() and is_bag(p), load_bag, has_topics=True),
    Format(
        f"a folder with {' and '.join(FILES)}", lambda p: _holds(p, FILES), _load_folder
    ),
    Format(
        "an .npz file",
        lambda p: p.suffix == ".npz",
        lambda path, *_: load_recording(path),
    ),
)
"""The first format that recognises a path reads it."""


def read_recording(
    path: str | Path,
    spec: RobotSpec | None = None,
    topics: TopicRoles | None = None,
    mapping: Mapping | str | Path | None = None,
) -> Recording:
    """Reads a recording by a mapping or its file, else in one of `FORMATS`; a bag needs its robot.

    Raises RecordingError or ConfigError if the recording is missing or unreadable, or does not fit
    robot or mapping.
    """
    check_path("recording", path)
    path = Path(path)
    topics = topics or TopicRoles()
    if mapping is not None and not is_recording(path):
        return _read_by_mapping(path, spec, topics, mapping)
    recognised = [form for form in FORMATS if form.recognises(path)]
    file_format = next(iter(recognised), None)
    if topics != TopicRoles() and not (file_format and file_format.has_topics):
        raise RecordingError(
            f"{path}: is no bag; leave out --topics and --topic, which are for bags "
            "only."
        )
    if file_format is not None:
        return file_format.read(path, spec, topics)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    names = " nor ".join(form.name for form in FORMATS)
    raise RecordingError(
        f"{path}: is neither {names}; say what is what in it with --map; `nics inspect "
        f"{path.name} --map my.yaml` begins one."
    )


def explain_no_mapping(path: Path) -> str:
    """Returns why a recording is read without a mapping; empty if it needs one."""
    if is_recording(path):
        return "was written by this package"
    if _holds(path, FILES):
        return f"has the files of config/recordings/{FOLDER}.yaml, by which it is read"
    if not is_bag(path):
        return ""
    with open_bag(path) as bag:
        try:
            topics = assign(TopicRoles(), bag.types, bag.empty, bag.place)
        except RecordingError:
            return ""
    used = " and ".join(
        topics[role] for role in ("cmd_vel", "pose", "odom") if role in topics
    )
    return f"has topics of known names and types ({used})"


def _read_by_mapping(
    path: Path,
    spec: RobotSpec | None,
    topics: TopicRoles,
    mapping: Mapping | str | Path,
) -> Recording:
    if topics != TopicRoles():
        raise ConfigError(
            "--topics and --topic do not go with --map; name the topics in the map."
        )
    mapping = _load_if_path(mapping)
    with open_source(path, mapping) as source:
        recording = read_mapped(source, mapping)
    if mapping.robot is not None:
        recording = replace(recording, robot=read_definition(mapping.robot))
    if spec is None:
        return recording
    _check_units(mapping, spec)
    return reorder_variables(recording, spec)


def _check_units(mapping: Mapping, spec: RobotSpec) -> None:
    """Refuses commands and states whose units are not of the robot's kind (ConfigError)."""
    for stream, values in (("command", spec.command), ("state", spec.state)):
        for variable in values:
            value = getattr(mapping, stream).get(variable.name)
            if value is None or value.scale != 1.0 or value.maximum is not None:
                continue  # a scaled value may be in the robot's unit
            si = get_unit(value).si
            if si and si != variable.unit != "1":
                turns = si.startswith("ticks") and variable.unit.startswith("rad")
                if turns:
                    cure = "add `ticks_per_turn:`, the counts of a turn of the wheel"
                else:
                    cure = "check its unit, or give `scale:`"
                raise ConfigError(
                    f"{stream}.{variable.name}: is in {si}, where {variable.unit} is "
                    f"needed; {cure}."
                )


def _load_if_path(mapping: Mapping | str | Path) -> Mapping:
    return mapping if isinstance(mapping, Mapping) else load_mapping(mapping)


def read_robot_and_drive(
    path: Path,
    robot: str | None,
    topics: TopicRoles,
    mapping: Mapping | str | Path | None,
) -> tuple[RobotSpec, Recording]:
    """Reads a drive with its robot: the named one, the mapping's, the drive's, or the default."""
    if mapping is not None:
        mapping = _load_if_path(mapping)
        if robot is not None:
            mapping = mapping.model_copy(update={"robot": robot})
        drive = read_recording(path, None, topics, mapping)
        spec = build_mapped_robot(mapping, drive)
        _check_units(mapping, spec)
        return spec, reorder_variables(drive, spec)
    if not is_recording(path):
        definition: str | dict[str, Any] | None = robot
        # It may be a folder that is read by its shipped mapping.
        if not robot and _holds(path, FILES) and not is_bag(path):
            definition = load_mapping(find_config(FOLDER, "recordings")).robot
        spec = build_robot(definition or DEFAULT_ROBOT)
        return spec, read_recording(path, spec, topics)
    drive = read_recording(path, None, topics)
    spec = _build_with_ranges(
        robot or drive.robot or DEFAULT_ROBOT, drive, drive.variables
    )
    return spec, drive if drive.robot is None else reorder_variables(drive, spec)


def read_robot_and_drives(
    paths: Sequence[Path],
    robot: str | None,
    topics: TopicRoles,
    mapping: Mapping | str | Path | None,
) -> tuple[RobotSpec, list[Recording]]:
    """Reads drives of one robot, whose ranges cover all of them."""
    twice = [path for path in paths if paths.count(path) > 1]
    if twice:
        raise RecordingError(f"{twice[0]}: is given twice; give each recording once.")
    specs = []
    drives = []
    for path in paths:
        spec, drive = read_robot_and_drive(path, robot, topics, mapping)
        specs.append(spec)
        drives.append(drive)
    first = specs[0]
    for path, spec in zip(paths, specs, strict=True):
        has_variables = spec.variable_names == first.variable_names
        if not has_variables or spec.textbook != first.textbook:
            raise RecordingError(
                f"{path}: is a drive of {spec.name!r}, {paths[0]} of {first.name!r}; "
                "fit only drives of one robot together."
            )
    if len(specs) > 1:
        commands = _merge_ranges([spec.command for spec in specs])
        states = _merge_ranges([spec.state for spec in specs])
        first = first.model_copy(update={"command": commands, "state": states})
    return first, [check(drive, first) for drive in drives]


def _merge_ranges(drives: Sequence[Sequence[Any]]) -> tuple[Any, ...]:
    """Returns variables whose ranges cover those of all drives."""
    merged = []
    for variables in zip(*drives, strict=True):
        low = min(variable.min for variable in variables)
        high = max(variable.max for variable in variables)
        merged.append(variables[0].model_copy(update={"min": low, "max": high}))
    return tuple(merged)


def build_mapped_robot(
    mapping: Mapping | str | Path, recording: Recording
) -> RobotSpec:
    """Returns the robot of a mapping; command ranges that it omits are as recorded."""
    mapping = _load_if_path(mapping)
    robot = mapping.robot or recording.robot
    if robot is None:
        raise ConfigError(
            "the mapping names no robot; add `robot:` to it, or give --robot."
        )
    variables = recording.variables or tuple(mapping.command)
    return _build_with_ranges(robot, recording, variables)


def _build_with_ranges(
    robot: str | dict[str, Any], recording: Recording, variables: tuple[str, ...]
) -> RobotSpec:
    """Returns a robot; command ranges that it omits are as recorded."""
    low, high = (f(recording.command.values, axis=0).tolist() for f in (np.min, np.max))
    names = variables[-len(low) :]
    return build_robot(
        robot, dict(zip(names, zip(low, high, strict=True), strict=False))
    )


def reorder_variables(recording: Recording, spec: RobotSpec) -> Recording:
    """Orders a recording's columns like a robot's variables. Raises ConfigError if they differ."""
    if not recording.variables:
        return check(recording, spec)
    count = recording.command.values.shape[1]
    made: dict[str, Any] = {}
    parts = {
        "command": (slice(-count, None), spec.command),
        "state": (slice(-count), spec.state),
    }
    for part, (place, variables) in parts.items():
        recorded = recording.variables[place]
        names = [variable.name for variable in variables]
        stream = recording.streams.get(part)
        if stream is None:
            continue
        if set(recorded) != set(names):
            raise ConfigError(
                f"{recording.source}: the {part} is {', '.join(recorded)}, that of the "
                f"robot {spec.name!r} is {', '.join(names)}; use the robot's names in "
                "the mapping."
            )
        order = [recorded.index(name) for name in names]
        made[part] = replace(stream, values=stream.values[:, order])
    return check(replace(recording, **made, variables=spec.variable_names), spec)


@contextmanager
def open_source(path: Path, mapping: Mapping | None = None) -> Iterator[Source]:
    """Opens a recording in any format. Raises RecordingError if there is nothing to read."""
    if not check_no_device(path).exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    if not is_bag(path):
        yield Files(path)
        return
    with open_bag(path) as file:
        yield Bag(file, mapping)
