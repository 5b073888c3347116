"""DriveMapping: which column or message field of a recording is which stream, and in what unit."""

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, field_validator, model_validator

from nics_drl_bridge.config import Schema, load_yaml
from nics_drl_bridge.errors import suggest

TURN = 2.0 * math.pi


class UnitOfData(NamedTuple):
    """A unit: SI value = factor x value; `ticks` become radians once a turn's ticks are known."""

    si: str  # unit in SI; 1 for shares and counts
    factor: float


# SI value of each unit, by its SI unit
FACTORS: dict[str, dict[str, float]] = {
    "m": {
        "m": 1.0,
        "dm": 1e-1,
        "cm": 1e-2,
        "mm": 1e-3,
        "um": 1e-6,
        "km": 1e3,
        "ft": 0.3048,
        "in": 0.0254,
    },
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360.0, "rev": TURN},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "m/s": {
        "m/s": 1.0,
        "cm/s": 1e-2,
        "mm/s": 1e-3,
        "mph": 0.44704,
        "knots": 1852.0 / 3600.0,
        "km/h": 1.0 / 3.6,
        "kmh": 1.0 / 3.6,
        "kph": 1.0 / 3.6,
        "ft/s": 0.3048,
    },
    "rad/s": {
        "rad/s": 1.0,
        "deg/s": TURN / 360.0,
        "rpm": TURN / 60.0,
        "rev/s": TURN,
        "mrad/s": 1e-3,
    },
    "m/s^2": {
        "m/s^2": 1.0,
        "cm/s^2": 1e-2,
        "mm/s^2": 1e-3,
        "g": 9.80665,
        "mg": 9.80665e-3,
    },
    "V": {"V": 1.0, "mV": 1e-3},
    "A": {"A": 1.0, "mA": 1e-3},
    "N": {"N": 1.0},
    "N*m": {"N*m": 1.0},
    "1": {"1": 1.0, "share": 1.0, "%": 1e-2},
    "ticks": {"ticks": 1.0},
    "ticks/s": {"ticks/s": 1.0},
}
UNITS = {
    name: UnitOfData(si, factor)
    for si, factors in FACTORS.items()
    for name, factor in factors.items()
}
SHARES = ("share", "%", "1")
TICKS = {"ticks": "rad", "ticks/s": "rad/s"}
RATES = {
    "m": "m/s",
    "rad": "rad/s",
    "ticks": "ticks/s",
    "m/s": "m/s^2",
    "rad/s": "rad/s^2",
}


def word_set(text: str) -> frozenset[str]:
    """Returns the words of a text, split at white space."""
    return frozenset(text.split())


def split_words(name: str) -> list[str]:
    """Splits a name into its words: `vicon x`, `q.x`, `Left_Tick`, `cmdVel`."""
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^A-Za-z]+", parts.lower()) if word]


def write_reference(reference: str) -> str:
    """Returns a reference as YAML that is also valid within a list."""
    plain = re.fullmatch(r"[A-Za-z/][\w/. -]*(:[\w. -]+)?|\d+", reference)
    is_word = reference.lower() not in ("true", "false", "null")
    return reference if plain and is_word else f'"{reference}"'


def check_unit(name: str) -> str:
    """Returns the name of a unit. Raises ValueError with a suggestion if it is unknown."""
    if str(name) not in UNITS:
        raise ValueError(f"is no known unit ({suggest(str(name), UNITS)})")
    return str(name)


# Words of columns that can't be commands: positions on Earth, and uncertainties
PLACES_ON_EARTH = word_set("latitude longitude altitude")
SHORT_OF_EARTH = word_set("lat lon lng long")
NEAR_DEG = 1.0  # a drive stays within this range of latitude and longitude
NO_COMMANDS = PLACES_ON_EARTH | word_set(
    "covariance covariances cov covar variance variances"
)

NO_COMMAND_NAMED = (
    "command: is empty, but a model learns the robot's motion from its commands; "
    "name its columns, or, if it was not recorded, record it together with the pose, "
    "such as geometry_msgs/Twist on cmd_vel"
)

ARRIVAL = "arrival"
HEADER = "header"
ROBOT_CLOCK = "robot"
# Indices of the variances of x, y and heading: alone, or in a 3 x 3 or 6 x 6 matrix by rows
COVARIANCES = {3: (0, 1, 2), 9: (0, 4, 8), 36: (0, 7, 35)}

# A column by name or by number from 0; FILE:COLUMN in a folder, /topic:message.field in a bag.
Reference = str | int
Condition = float | str | bool | list[float | str]


def _expand_reference(key: str) -> Any:
    """Lets a plain reference, or a list of them, stand for the model with only that key."""

    def expand(value: Any) -> Any:
        if isinstance(value, (str, int, list)) and not isinstance(value, bool):
            return {key: value}
        return value

    return BeforeValidator(expand)


def _check_kind(kinds: tuple[str, ...]) -> Any:
    """Returns a validator that refuses units whose SI unit is not one of `kinds`."""

    def check(unit: str | None) -> str | None:
        if unit is not None and UNITS[check_unit(unit)].si not in kinds:
            fitting = [name for name in UNITS if UNITS[name].si in kinds]
            raise ValueError(f"must be one of {', '.join(fitting)}")
        return unit

    return BeforeValidator(check)


def explain_no_command(column: str) -> str:
    """Returns why a column, by its name, was not sent to the robot; empty if it may have been."""
    words = NO_COMMANDS.intersection(split_words(column))
    if not words:
        return ""
    content = "how uncertain a measurement is"
    if words & PLACES_ON_EARTH:
        content = "where the robot was"
    return f"{column!r} shows {content}, and was not sent to the robot; name a column that was"


def may_be_place_on_earth(column: str) -> bool:
    """True for columns like `lat`, which may hold a latitude or longitude."""
    return not SHORT_OF_EARTH.isdisjoint(split_words(column))


def is_place_on_earth(column: str, low: float, high: float) -> bool:
    """True for `lat` or `lon` whose values stay within a degree, as in a drive."""
    is_near = high - low < NEAR_DEG <= max(abs(low), abs(high))
    return is_near and may_be_place_on_earth(column)


class Time(Schema):
    """Stamps of rows: from a column, from two for seconds and nanoseconds, or at a rate."""

    # column or columns; of a bag's messages also `header` or `arrival`
    from_: Reference | tuple[Reference, Reference] | None = Field(
        default=None, alias="from"
    )
    # unit of the stamps; None: s
    unit: Annotated[str | None, _check_kind(("s",))] = None
    rate: float | None = Field(default=None, gt=0.0)  # rate of rows without stamps [Hz]

    @model_validator(mode="after")
    def _check_source(self) -> "Time":
        if (self.from_ is None) == (self.rate is None):
            raise ValueError("time needs either `from`, a column, or `rate` [Hz]")
        return self

    @property
    def columns(self) -> tuple[Reference, ...]:
        """One column, or two: seconds and nanoseconds."""
        return self.from_ if isinstance(self.from_, tuple) else (self.from_ or 0,)


class Value(Schema):
    """A number in each row: SI value = unit x scale x number + offset."""

    # column by name or number, TABLE:COLUMN or /topic:field
    from_: Reference = Field(alias="from")
    unit: str | None = None  # by default the stream's, or SI
    maximum: float | None = None  # SI value of a full share
    scale: float = 1.0  # -1 reverses the sign
    offset: float = 0.0  # in SI
    # encoder ticks per turn; with it, ticks become angles
    ticks_per_turn: float | None = Field(default=None, gt=0.0)
    differentiate: bool | None = None  # by default true for `ticks`, which are counters
    # value at which a counter overflows; by default determined from the data
    wrap: float | None = Field(default=None, gt=0.0)
    # flags: other columns, with the values at which this value is valid; if not,
    # `otherwise` is used
    when: dict[str, Condition] = Field(default_factory=dict)
    otherwise: float = 0.0  # in SI, for rows whose flags do not match `when`
    # stamps of this value; None: the stream's
    time: Annotated[Time | None, _expand_reference("from")] = None
    clock: str | None = None  # name of the clock of these stamps; None: the stream's

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str | None) -> str | None:
        return None if unit is None else check_unit(unit)

    @model_validator(mode="after")
    def _check_maximum(self) -> "Value":
        if self.maximum is not None and (self.unit or "share") not in SHARES:
            raise ValueError("maximum belongs to the units share and %")
        return self

    @property
    def counts(self) -> bool:
        """True for a counter, whose rate is the value."""
        ticks = self.unit == "ticks" or (
            self.unit is None and self.ticks_per_turn is not None
        )
        return ticks if self.differentiate is None else self.differentiate


AValue = Annotated[Value, _expand_reference("from")]


class Measured(Schema):
    """Keys of all streams: table of their columns, stamps, clock."""

    # file or topic of columns that do not name one
    in_: str | None = Field(default=None, alias="in")
    # stamps; None: those of the whole mapping
    time: Annotated[Time | None, _expand_reference("from")] = None
    # clock of the stamps; two clocks differ by an unknown offset
    clock: str | None = None


class PoseSource(Measured):
    """Pose of the tracked body in a fixed frame."""

    x: AValue | None = None  # position; None: the messages of the topic `in` are poses
    y: AValue | None = None  # position along y, 90 degrees counter-clockwise from x
    heading: AValue | None = None  # direction of the body, counter-clockwise from x
    # instead of the heading: x, y, z, w, or the field of a message
    quaternion: str | tuple[Reference, Reference, Reference, Reference] | None = None
    # unit of x and y and their variances; an angle if they are longitude and latitude
    unit: Annotated[str, _check_kind(("m", "rad"))] = "m"
    # unit of the heading and its variance
    heading_unit: Annotated[str, _check_kind(("rad",))] = "rad"
    # variances of x, y, heading; or all of a 3 x 3 or 6 x 6 matrix, by rows; or a message's field
    covariance: str | list[Reference] | None = None
    # what measured it: `odometry`, which drifts, or a `tracker` such as motion capture or a
    # localiser; None: guessed from the names of topic, file and columns
    measured_by: Literal["odometry", "tracker"] | None = None
    frame: str | None = None  # parent of the transforms to use, for a topic like /tf
    child_frame: str | None = None  # their child, the tracked body

    @property
    def frames(self) -> tuple[str | None, str | None]:
        """Parent and child of the transforms to use."""
        return self.frame, self.child_frame

    @model_validator(mode="after")
    def _check_pose(self) -> "PoseSource":
        if (self.x is None) != (self.y is None):
            raise ValueError("pose needs both x and y")
        if self.x is None and self.in_ is None:
            raise ValueError(
                "pose needs x and y, or `in`: a topic whose messages are poses"
            )
        if self.x is not None and (self.heading is None) == (self.quaternion is None):
            raise ValueError("pose needs either heading or quaternion")
        if (
            isinstance(self.covariance, list)
            and len(self.covariance) not in COVARIANCES
        ):
            raise ValueError("covariance needs 3, 9 or 36 columns")
        return self


class WheelSource(Measured):
    """Wheel speeds, in the encoder's units or rad/s."""

    left: AValue  # speed of the left wheel
    right: AValue  # speed of the right wheel


class ImuSource(Measured):
    """Acceleration along x, y and yaw rate."""

    ax: AValue | None = None  # acceleration along x, forward [m/s^2]; None: 0
    ay: AValue | None = None  # acceleration along y, to the left [m/s^2]; None: 0
    yaw_rate: AValue | None = None  # turn rate, counter-clockwise [rad/s]
    # instead of the turn rate: a second heading, such as a compass's, counter-clockwise [rad]
    heading: AValue | None = None

    @model_validator(mode="after")
    def _check_rate(self) -> "ImuSource":
        if (self.yaw_rate is None) == (self.heading is None):
            raise ValueError("imu needs either yaw_rate or heading")
        return self


class OdometrySource(Measured):
    """Body velocity by the robot's own odometry."""

    vx: AValue  # forward [m/s]
    vy: AValue | None = None  # to the left [m/s]; None: 0
    wz: AValue  # turn rate, counter-clockwise [rad/s]


class DriveMapping(Schema):
    """How a recording in any format maps to the streams of a Recording."""

    # a shipped robot's name, a path, or its definition
    robot: str | dict[str, Any] | None = None
    # file or topic of streams that do not name one
    in_: str | None = Field(default=None, alias="in")
    # stamps of all streams; None: a bag's own
    time: Annotated[Time | None, _expand_reference("from")] = None
    # clock of all streams; None: `robot`, unless a bag's headers differ
    clock: str | None = None
    # column whose value changes from one episode to the next; None: one drive
    episode: Reference | None = None
    # pose of the tracked body; a topic alone stands for its `in`
    pose: Annotated[PoseSource, _expand_reference("in")]
    command: dict[str, AValue]  # commands, by the robot's names for them
    # instead of them, written `command: /topic`: velocities or Ackermann drives of a bag
    command_topic: str | None = None
    # measured states, by their names
    state: dict[str, AValue] = Field(default_factory=dict)
    wheels: WheelSource | None = None  # wheel speeds, if they were recorded
    # acceleration and yaw rate, or a second heading, if recorded
    imu: ImuSource | None = None
    # the robot's own body velocity, if it was recorded
    odometry: OdometrySource | None = None

    @model_validator(mode="before")
    @classmethod
    def _require_commands(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        command = data.get("command", True)
        topic = data.get("command_topic")
        if topic and command not in (None, {}, "", True):
            raise ValueError("give `command` or `command_topic`, not both")
        if isinstance(command, str) and command:
            return {**data, "command": {}, "command_topic": command}
        if command in (None, {}, "") and not topic:
            raise ValueError(NO_COMMAND_NAMED)
        if topic:
            return {**data, "command": {}}
        return data

    @model_validator(mode="after")
    def _check_commands(self) -> "DriveMapping":
        for name, value in self.command.items():
            why = explain_no_command(str(value.from_))
            if why:
                raise ValueError(f"command.{name}: {why}")
        return self


SI: dict[str, dict[str, tuple[str, ...]]] = {
    "pose": {"x": ("m", "rad"), "y": ("m", "rad"), "heading": ("rad",)},
    "wheels": dict.fromkeys(("left", "right"), ("m/s", "rad/s", "ticks/s", "1", "V")),
    "imu": {"ax": ("m/s^2",), "ay": ("m/s^2",), "yaw_rate": ("rad/s",)},
    "odometry": {"vx": ("m/s",), "vy": ("m/s",), "wz": ("rad/s",)},
}
"""Values of each stream, in order, with their possible SI units."""


def load_mapping(path: str | Path) -> DriveMapping:
    """Reads a mapping from YAML. Raises ConfigError with file, key and fix."""
    return load_yaml(path, DriveMapping)
