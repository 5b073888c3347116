"""The generator: from a recording to a SimulatorModel, one readable folder on disk."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field

from nics_drl_bridge import files
from nics_drl_bridge.arguments import check_arguments, check_path, format_value
from nics_drl_bridge.config import (
    Schema,
    dump_yaml,
    find_config,
    list_shipped,
    parse_yaml,
    read_text,
    validate,
)
from nics_drl_bridge.errors import ConfigError, FitError, ModelError, suggest
from nics_drl_bridge.identify.calibration import (
    Alpha,
    Calibration,
    Order,
    Settings,
    parse_alpha,
    parse_order,
)
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.sensor import AnySensor, Sensor, check_sensors
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Shape
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.lidar.table import TABLE_FILES, LidarTable
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.noise import Latency, Noise
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.robot.taylor import NamedTaylorModel, TaylorModel

if TYPE_CHECKING:
    from nics_drl_bridge.identify.identify import Identified

FORMATS = "nics_drl_bridge/simulator_model/"  # common prefix of all versions
FORMAT = f"{FORMATS}4"
MODEL_FILE = "model.yaml"
TABLE_FOLDER = "lidar_table"
REPORT_FILE = "report.txt"
_OF_TABLE = (f"{TABLE_FOLDER}/{name}" for name in (files.SUMS, *TABLE_FILES))
MODEL_FILES = (MODEL_FILE, REPORT_FILE, *_OF_TABLE)  # in addition to the manifest
# Files that `nics generate` draws, including pictures that only earlier versions wrote.
REPORT_PAGE = "report.html"
PICTURES_FOLDER = "pictures"
PICTURES = (
    "accuracy",
    "alignment",
    "bursts",
    "inputs",
    "mounting",
    "noise",
    "paths",
    "residuals",
    "timing",
    "wheels",
)
DRAWN_FILES = (REPORT_PAGE, *(f"{PICTURES_FOLDER}/{name}.png" for name in PICTURES))
CONTROL_PERIOD_S = Settings.control_period_s
DEFAULT_LIDAR = "paper"
BUILTIN_SEED = 0


class Timing(NamedTuple):
    """Times of a simulator in whole substeps, the steps of the model's kinematics."""

    dt: float  # length of a substep [s]
    substeps: int  # in a control period
    delay: int  # common latency of the commands [substeps]


@dataclass(frozen=True)
class SimulatorModel:
    """Everything that a fast simulator needs to know about a robot."""

    robot: RobotSpec
    kinematics: TaylorModel  # fitted and pruned
    # identified from the recording: clock offset, latency, sensor frames, noise
    calibration: Calibration
    lidar: LidarSpec
    table: LidarTable  # baked ranges to the obstacles' shapes and the robot itself
    noise: Noise = field(default_factory=Noise)  # sensor and motion noise
    # time between commands [s], a multiple of `kinematics.dt`
    control_period: float = CONTROL_PERIOD_S
    report: str = ""  # how the model was made, in plain text
    # latency of scans and odometry, if it was measured in the recording
    latency: Latency = field(default_factory=Latency)
    sensors: tuple[Sensor, ...] = ()  # other than the lidar
    # True: a gyro measured or confirmed the recorded headings
    gyro: bool = False

    def __post_init__(self) -> None:
        robot = self.robot
        fitted = (self.kinematics.variables, self.kinematics.dofs)
        needed = (robot.variable_names, robot.dof_names)
        if fitted != needed:
            reason = f"robot {robot.name!r} needs {needed}; generate the model again."
            raise ModelError(
                f"the kinematics have variables and rates {fitted}, {reason}"
            )
        check_sensors(self.sensors, (self.lidar.frame,))
        period = self.control_period
        dt = self.kinematics.dt
        steps = period / dt
        if not 0.5 < steps < np.inf or abs(steps - round(steps)) > 1e-6:
            reason = (
                f"is not a multiple of the model's step {dt} s; change one of them."
            )
            raise ModelError(f"control_period {period} s {reason}")

    @property
    def timing(self) -> Timing:
        """Length of a substep, substeps per control period, command delay."""
        dt = self.kinematics.dt
        delay = max(0, round(self.calibration.command_latency_s / dt))
        return Timing(dt, round(self.control_period / dt), delay)

    @cached_property
    def text(self) -> str:
        """The content of `model.yaml`."""
        # The kinematics already hold the input curves; a new calibration has a copy.
        calibration = asdict(self.calibration)
        del calibration["inputs"]
        kinematics = self.kinematics.named.model_dump(
            exclude_none=True, exclude_defaults=True
        )
        data = {
            "format": FORMAT,
            "control_period": self.control_period,
            "robot": self.robot.model_dump(mode="json"),
            "kinematics": kinematics,
            "calibration": calibration,
            "lidar": self.lidar.model_dump(mode="json"),
            "noise": self.noise.model_dump(mode="json"),
        }
        if self.latency.measured:
            data["latency"] = self.latency.model_dump(mode="json")
        if self.sensors:
            data["sensors"] = [
                sensor.model_dump(mode="json") for sensor in self.sensors
            ]
        if self.gyro:
            data["gyro"] = True
        return dump_yaml(data)

    @property
    def fingerprint(self) -> str:
        """Identifies the model: 16 digits of the SHA-256 of `text` and the table's fingerprint."""
        return files.hash_bytes(f"{self.text}{self.table.fingerprint}".encode())[:16]


class _File(Schema):
    format: str
    control_period: float = Field(gt=0.0)
    robot: RobotSpec
    kinematics: NamedTaylorModel
    calibration: Calibration
    lidar: LidarSpec
    noise: Noise
    latency: Latency = Field(default_factory=Latency)
    sensors: tuple[AnySensor, ...] = ()
    gyro: bool = False


@check_arguments("generate")
def generate(
    recording: Recording | Sequence[Recording],
    robot: RobotSpec | SimulatorModel | str | Path,
    lidar: LidarSpec | str | Path | None = None,
    shapes: Sequence[Shape] = (),
    order: Order = Settings.order,
    alpha: Alpha = Settings.alpha,
    assume: bool = Settings.assume,
    strict: bool = Settings.strict,
    anyway: bool = False,
    sensors: Sequence[Sensor] = (),
) -> "tuple[SimulatorModel, Identified]":
    """Calibrates, fits and prunes the kinematics, and bakes the lidar table.

    Raises RecordingError if the recording does not fit the robot, FitError if the model is useless.

    Args:
        recording: a recording, or several of one robot, which are fitted together.
        robot: a RobotSpec, a name, a YAML file, or a model of the robot; also called `model`.
        lidar: a LidarSpec, a name or a YAML file; by default the robot's own.
        shapes: obstacles to bake, in addition to the robot's own footprint.
        order: order of the Taylor model; `auto` chooses the one that predicts best.
        alpha: pruning threshold of Eq. 2; `auto` finds the knee.
        assume: True uses textbook terms, marked as assumed, where the drive shows
            nothing.
        strict: True refuses a drive that did not vary each input independently.
        anyway: True accepts a model that predicts hardly better than a robot at rest.
        sensors: sensors besides the lidar.
    """
    # Imported here because it loads slowly, and most users only open existing models.
    from nics_drl_bridge.identify.identify import identify, join_recordings
    from nics_drl_bridge.identify.report import explain_uselessness, format_report

    _check_given(recording, shapes, sensors)
    alpha = parse_alpha(str(alpha))
    order = parse_order(str(order))
    robot = _get_spec(robot)
    if not isinstance(lidar, LidarSpec):
        lidar = mount_lidar(robot, None if lidar is None else str(lidar))
    if not isinstance(recording, Recording):
        recording = join_recordings(recording, robot)
    identified = identify(
        recording, robot, order=order, alpha=alpha, assume=assume, strict=strict
    )
    reason = explain_uselessness(identified)
    if reason and not anyway:
        raise FitError(reason)
    # Its state may differ if the fit fell back to the textbook model.
    robot = identified.drive.spec
    # With a slow lidar, the control period is the time between two scans.
    dt = identified.model.dt
    steps = max(CONTROL_PERIOD_S, 1.0 / lidar.rate) / dt
    model = SimulatorModel(
        robot,
        identified.model,
        replace(identified.calibration, inputs=()),
        lidar,
        bake(lidar, (*shapes, footprint_shape(robot))),
        identified.noise,
        round(round(steps) * dt, 9),
        format_report(recording.source, identified),
        recording.latency,
        tuple(sensors),
        identified.recording.gyro is not None,
    )
    return model, identified


def _check_given(recording: object, shapes: object, sensors: object) -> None:
    """Raises ConfigError if the recording, shapes or sensors have a wrong type."""
    recordings = list(recording) if isinstance(recording, list | tuple) else [recording]
    if not recordings or not all(isinstance(item, Recording) for item in recordings):
        needed = "a Recording, as read_recording(path) returns, or a list of them"
        raise ConfigError(
            f"generate: recording={format_value(recording)}: must be {needed}."
        )
    for name, value in (("shapes", shapes), ("sensors", sensors)):
        fits = isinstance(value, list | tuple) and all(
            isinstance(item, Schema) for item in value
        )
        if not fits:
            needed = f"a list of {name} of this package"
            raise ConfigError(
                f"generate: {name}={format_value(value)}: must be {needed}."
            )


def _get_spec(robot: object) -> RobotSpec:
    if isinstance(robot, RobotSpec):
        return robot
    if isinstance(robot, SimulatorModel):
        return robot.robot
    if isinstance(robot, str | Path):
        return open_model(robot).robot if Path(robot).is_dir() else load_robot(robot)
    needed = "a RobotSpec, a robot's name or YAML file, or a model"
    raise ConfigError(f"generate: robot={format_value(robot)}: must be {needed}.")


def footprint_shape(robot: RobotSpec) -> Circle | Polygon:
    """Returns the shape of the robot's footprint around its `base_link`."""
    if robot.footprint is None:
        return Circle(radius=robot.footprint_radius)
    return Polygon(points=robot.footprint)


def mount_lidar(robot: RobotSpec, name: str | None = None) -> LidarSpec:
    """Returns a lidar, by name or file, mounted as in the robot's file.

    By default it is the lidar named in the robot's file, or else the paper's. Raises ConfigError.
    """
    spec = load_lidar(name or robot.lidar or DEFAULT_LIDAR)
    mount = robot.lidar_mount
    return spec if mount is None else spec.model_copy(update={"mount": mount})


@lru_cache(maxsize=8)
def builtin_model(robot: str, content: str = "") -> SimulatorModel:
    """Returns a model with the textbook kinematics of a shipped robot or a robot's YAML file.

    Each model is made once; for a file, once for each `content`. That of a shipped robot is
    shipped, too, and not generated unless the robot or its lidar was edited.
    """
    spec = load_robot(robot)
    if Path(robot, MODEL_FILE).is_file():
        sys.stderr.write(
            f"nics_drl_bridge: {robot!r} is shipped; the folder is ./{robot}\n"
        )
    if robot in list_shipped("models"):
        path = find_config(robot, "models")
        file = _read_file(path)
        if (file.robot, file.lidar) == (spec, mount_lidar(spec)):
            table = bake(file.lidar, [footprint_shape(spec)])
            return _assemble(file, table, read_text(path.with_suffix(".txt")))
    return generate_textbook_model(spec)


def generate_textbook_model(robot: RobotSpec) -> SimulatorModel:
    """Generates a model from a drive of a robot that moves as its textbook says."""
    drive = textbook.record(robot, np.random.default_rng(BUILTIN_SEED))
    return generate(drive, robot, mount_lidar(robot), ())[0]


def open_model(
    name: str | Path | SimulatorModel, lidar: str | None = None
) -> SimulatorModel:
    """Opens a model: a shipped robot (`ackermann`), a folder (`./mine`), or a robot's YAML file.

    A `lidar`, shipped or a YAML file, replaces the model's own. Without one, an open model is
    returned unchanged.
    """
    if not isinstance(name, str | Path | SimulatorModel) or name == "":
        needed = "a shipped robot's name, a model's folder, a robot's YAML, or a SimulatorModel"
        raise ModelError(f"model={format_value(name)}: must be {needed}.")
    if lidar is not None:
        model = open_model(name)
        spec = mount_lidar(model.robot, lidar)
        return replace(model, lidar=spec, table=bake(spec, model.table.shapes))
    if isinstance(name, SimulatorModel):
        return name
    # A Path never equals the name of a shipped robot.
    if Path(name).is_dir() and name not in list_shipped("robots"):
        return load_model(name)
    name = str(name)
    is_yaml = name.endswith((".yaml", ".yml"))
    if "/" in name and not is_yaml:
        raise ModelError(f"{name}: no such folder; make one with `nics generate`.")
    if not is_yaml and name not in list_shipped("robots"):
        hint = suggest(name, list_shipped("robots"))
        fix = "or give a model's folder, or a robot's YAML file"
        raise ModelError(f"unknown robot {name!r}; {hint} ({fix}).")
    try:
        content = (read_text(name),) if Path(name).is_file() else ()
        return builtin_model(name, *content)
    except ConfigError as error:
        raise ModelError(str(error)) from None


def check_place(folder: str | Path) -> None:
    """Raises ConfigError, before a long fit, if `save_model` could not write to a folder."""
    if str(folder) in list_shipped("robots"):
        raise ConfigError(
            f"{folder}: a shipped robot has this name; name another folder."
        )
    files.check_folder(folder, MODEL_FILE, FORMATS)


def save_model(model: SimulatorModel, folder: str | Path) -> None:
    """Writes a model as a folder, completely or not at all; see `check_place`.

    It replaces an older model with its report and pictures, and keeps other files in the folder.
    """
    owned = {*MODEL_FILES, files.SUMS, *DRAWN_FILES, *files.names_in_sums(Path(folder))}
    with files.write_whole_folder(
        folder, MODEL_FILE, owned.__contains__, FORMATS
    ) as temporary:
        files.write_text(temporary / MODEL_FILE, model.text)
        files.write_text(temporary / REPORT_FILE, model.report)
        model.table.save(temporary / TABLE_FOLDER)
        files.write_sums(temporary)


def load_model(folder: str | Path) -> SimulatorModel:
    """Reads a model that `save_model` wrote. Raises ConfigError, ModelError."""
    check_path("folder", folder)
    folder = Path(folder)
    path = folder / MODEL_FILE
    if not path.is_file():
        if not folder.exists():
            fix = (
                "make one with `nics generate`; `open_model` opens shipped robots, too"
            )
            raise ModelError(f"{folder}: no such folder; {fix}.")
        raise ModelError(
            f"{folder}: contains no {MODEL_FILE}; make a model with `nics generate`."
        )
    inode = folder.stat().st_ino
    file = _read_file(path)
    files.check_sums(folder, MODEL_FILES, editable=MODEL_FILE)
    table = LidarTable.load(folder / TABLE_FOLDER, checked=True)
    report = read_text(folder / REPORT_FILE)
    if folder.stat().st_ino != inode:
        raise ModelError(f"{folder}: was replaced while it was read; open it again.")
    try:
        return _assemble(file, table, report)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def _read_file(path: Path) -> _File:
    """Reads the YAML file of a model. Raises ConfigError, ModelError."""
    data = parse_yaml(read_text(path), str(path))
    if data.get("format") != FORMAT:
        reason = f"key 'format' is {data.get('format')!r}, not {FORMAT!r}"
        raise ModelError(f"{path}: {reason}; generate the model again.")
    # A file without this key was written before its default changed.
    if isinstance(data.get("robot"), dict):
        data["robot"].setdefault("angular_is", "steering")
    file = validate(data, _File, str(path))
    # A file must state its calibration; the defaults are for a robot without any offset.
    for key in fields(Calibration):
        if key.name not in ("inputs", *data["calibration"]):
            raise ConfigError(
                f"{path}: the key 'calibration.{key.name}' is missing; add it."
            )
    return file


def _assemble(file: _File, table: LidarTable, report: str) -> SimulatorModel:
    parts = vars(file) | {"kinematics": file.kinematics.model()}
    del parts["format"]
    return SimulatorModel(**parts, table=table, report=report)
