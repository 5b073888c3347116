"""Opens a drive: a bag, a table, an archive or a folder of tables, by a mapping or by roles."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from nics_drl_bridge.arguments import check_path
from nics_drl_bridge.config import check_no_device, find_config
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.bag_file import is_bag, open_bag
from nics_drl_bridge.recording.bag_table import Bag
from nics_drl_bridge.recording.mapped import read_mapped
from nics_drl_bridge.recording.mapping import DriveMapping, load_mapping
from nics_drl_bridge.recording.recording import (
    Recording,
    check,
    is_recording,
    load_recording,
)
from nics_drl_bridge.recording.role_mapping import write_mapping
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
AnyMapping = DriveMapping | TopicRoles | str | Path | None


def open_drive(
    source: str | Path, robot: RobotSpec | str | None = None, mapping: AnyMapping = None
) -> tuple[RobotSpec, Recording]:
    """Opens a drive with its robot, by a mapping, its file, or the roles of a bag's topics.

    The robot is the named one, that of the mapping or of the drive, or the default; command ranges
    that it omits are as recorded. Raises RecordingError or ConfigError if the drive is missing or
    unreadable, or if it does not fit robot or mapping.
    """
    path = Path(source)
    if isinstance(mapping, (str, Path)):
        mapping = load_mapping(mapping)
    is_mapped = isinstance(mapping, DriveMapping)
    if robot is None and not is_mapped and path.exists() and is_bag(path):
        robot = DEFAULT_ROBOT
    drive, known = _read(path, robot, mapping)
    if known is None and is_mapped:
        raise ConfigError(
            "the mapping names no robot; add `robot:` to it, or give --robot."
        )
    spec = _build_with_ranges(known, drive)
    if isinstance(mapping, DriveMapping):
        _check_units_fit_robot(mapping, spec)
    return spec, reorder_variables(drive, spec)


def open_drives(
    sources: Sequence[Path], robot: str | None = None, mapping: AnyMapping = None
) -> tuple[RobotSpec, list[Recording]]:
    """Opens drives of one robot, whose ranges cover all of them."""
    twice = [path for path in sources if sources.count(path) > 1]
    if twice:
        raise RecordingError(f"{twice[0]}: is given twice; name each recording once.")
    specs = []
    drives = []
    for path in sources:
        spec, drive = open_drive(path, robot, mapping)
        specs.append(spec)
        drives.append(drive)
    first = specs[0]
    for path, spec in zip(sources, specs, strict=True):
        has_variables = spec.variable_names == first.variable_names
        if not has_variables or spec.textbook != first.textbook:
            raise RecordingError(
                f"{path}: is a drive of {spec.name!r}, {sources[0]} of {first.name!r}; "
                "fit only drives of one robot together."
            )
    if len(specs) > 1:
        commands = _merge_ranges([spec.command for spec in specs])
        states = _merge_ranges([spec.state for spec in specs])
        first = first.model_copy(update={"command": commands, "state": states})
    return first, [check(drive, first) for drive in drives]


def read_recording(
    path: str | Path,
    spec: RobotSpec | None = None,
    topics: TopicRoles | None = None,
    mapping: DriveMapping | str | Path | None = None,
) -> Recording:
    """Reads a drive by a mapping or its file, else without one; a bag then needs its robot.

    Raises RecordingError or ConfigError if the recording is missing or unreadable, or does not fit
    robot or mapping.
    """
    check_path("recording", path)
    chosen = choose_mapping(topics, mapping)
    if spec is not None:
        return open_drive(path, spec, chosen)[1]
    if isinstance(chosen, (str, Path)):
        chosen = load_mapping(chosen)
    return _read(Path(path), None, chosen)[0]


def choose_mapping(
    topics: TopicRoles | None, mapping: DriveMapping | str | Path | None
) -> AnyMapping:
    """Returns the mapping, else the roles of topics. Raises ConfigError if both are given."""
    if mapping is None:
        return topics
    if topics not in (None, TopicRoles()):
        raise ConfigError(
            "--topics and --topic can't be combined with --map; name the topics in "
            "the map."
        )
    return mapping


Robot = RobotSpec | str | dict[str, Any] | None


def _read(
    path: Path, robot: RobotSpec | str | None, mapping: DriveMapping | TopicRoles | None
) -> tuple[Recording, Robot]:
    """Returns a drive, and the robot as far as it is known: built, or only its definition."""
    has_bag = path.exists() and is_bag(path)
    if isinstance(mapping, TopicRoles) and mapping != TopicRoles() and not has_bag:
        raise RecordingError(
            f"{path}: is not a bag; remove --topics and --topic, which are for bags "
            "only."
        )
    if is_recording(path):
        drive = load_recording(path)
        named = mapping.robot if isinstance(mapping, DriveMapping) else None
        return drive, robot or named or drive.robot
    if isinstance(mapping, DriveMapping):
        definition = robot if isinstance(robot, str) else mapping.robot
        known: Robot = robot or definition
        if mapping.command_topic is not None and known is not None:
            known = _build(known)
        drive = _read_by_mapping(path, known, mapping)
        if definition is not None:
            drive = replace(drive, robot=read_definition(definition))
        return drive, known
    if has_bag:
        if robot is None:
            raise RecordingError(f"{path}: is a bag; give its robot as a RobotSpec.")
        spec = _build(robot)
        with open_bag(path) as opened:
            bag = Bag(opened)
            by_roles = write_mapping(mapping or TopicRoles(), bag, spec)
            return read_mapped(bag, by_roles, spec), spec
    if _holds(path, FILES):
        file = find_config(FOLDER, "recordings")
        mapping = load_mapping(file)
        known = robot or mapping.robot
        if not _holds(path, WHEELS):
            mapping = mapping.model_copy(update={"wheels": None})
        try:  # its robot may be any with as many commands
            drive = replace(_read_by_mapping(path, None, mapping), variables=())
        except RecordingError as error:
            raise RecordingError(
                f"{error} The mapping is {file}; choose another with --map."
            ) from None
        return drive, known
    if path.suffix == ".npz":
        return load_recording(path), robot  # which names its fault
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    raise RecordingError(
        f"{path}: is neither a bag nor a folder with {' and '.join(FILES)} nor an .npz "
        f"file; describe its content with --map; `nics inspect {path.name} --map "
        "my.yaml` drafts a mapping."
    )


def _build(robot: RobotSpec | str | dict[str, Any]) -> RobotSpec:
    return robot if isinstance(robot, RobotSpec) else build_robot(robot)


def _read_by_mapping(path: Path, robot: Robot, mapping: DriveMapping) -> Recording:
    spec = robot if isinstance(robot, RobotSpec) else None
    with open_source(path) as source:
        return read_mapped(source, mapping, spec)


def _holds(path: Path, files: tuple[str, ...]) -> bool:
    return all((path / name).is_file() for name in files)


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


def _check_units_fit_robot(mapping: DriveMapping, spec: RobotSpec) -> None:
    """Refuses commands and states whose units are not of the robot's kind (ConfigError)."""
    for stream, values in (("command", spec.command), ("state", spec.state)):
        for variable in values:
            value = getattr(mapping, stream).get(variable.name)
            if value is None or value.scale != 1.0 or value.maximum is not None:
                continue  # a scaled value may be in the robot's unit
            si = get_unit(value).si
            if si and si != variable.unit != "1":
                cure = "check its unit, or give `scale:`"
                if si.startswith("ticks") and variable.unit.startswith("rad"):
                    cure = "add `ticks_per_turn:`, the counts of a turn of the wheel"
                raise ConfigError(
                    f"{stream}.{variable.name}: is in {si}, where {variable.unit} is "
                    f"needed; {cure}."
                )


def _merge_ranges(drives: Sequence[Sequence[Any]]) -> tuple[Any, ...]:
    """Returns variables whose ranges cover those of all drives."""
    merged = []
    for variables in zip(*drives, strict=True):
        low = min(variable.min for variable in variables)
        high = max(variable.max for variable in variables)
        merged.append(variables[0].model_copy(update={"min": low, "max": high}))
    return tuple(merged)


def _build_with_ranges(robot: Robot, recording: Recording) -> RobotSpec:
    """Returns a robot; command ranges that its definition omits are as recorded."""
    if isinstance(robot, RobotSpec):
        return robot
    commands = recording.command.values.T
    ranges = [(float(row.min()), float(row.max())) for row in commands]
    names = recording.variables[-len(ranges) :]
    return build_robot(robot or DEFAULT_ROBOT, dict(zip(names, ranges, strict=False)))


def reorder_variables(recording: Recording, spec: RobotSpec) -> Recording:
    """Orders a recording's columns like a robot's variables. Raises ConfigError if they differ."""
    if not recording.variables:
        return check(recording, spec)
    count = recording.command.values.shape[1]
    made: dict[str, Any] = {}
    for part, recorded, variables in (
        ("command", recording.variables[-count:], spec.command),
        ("state", recording.variables[:-count], spec.state),
    ):
        names = [variable.name for variable in variables]
        stream = recording.streams.get(part)
        if stream is None:
            continue
        if set(recorded) != set(names):
            raise ConfigError(
                f"{recording.source}: the {part} is {', '.join(recorded)}, that of the "
                f"robot {spec.name!r} is {', '.join(names)}; choose the recorded "
                "robot, or use its names in the mapping."
            )
        order = [recorded.index(name) for name in names]
        made[part] = replace(stream, values=stream.values[:, order])
    return check(replace(recording, **made, variables=spec.variable_names), spec)


@contextmanager
def open_source(path: Path) -> Iterator[Source]:
    """Opens a recording in any format. Raises RecordingError if there is nothing to read."""
    if not check_no_device(path).exists():
        raise RecordingError(f"{path}: no such file or folder; check the path.")
    if not is_bag(path):
        yield Files(path)
        return
    with open_bag(path) as file:
        yield Bag(file)
