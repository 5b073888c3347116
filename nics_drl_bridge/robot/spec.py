"""RobotSpec: the single definition of a robot's state and command: order, units and limits.

A module of this folder that defines `KIND`, a `kinds.RobotKind`, adds a kind with the module's name
for `textbook:` in YAML files. Its `VARIANTS` are kinds with longer names. Other packages add kinds
through entry points of the group `nics_drl_bridge.kinds`.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

import numpy as np
import pydantic
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator, model_serializer, model_validator

from nics_drl_bridge import extensions, geometry
from nics_drl_bridge.config import (
    Mount,
    Schema,
    find_config,
    parse_yaml,
    read_text,
    validate,
)
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.geometry import Bicycle
from nics_drl_bridge.robot.template import Ranges

CmdVelField = Literal["linear.x", "linear.y", "angular.z"]
CMD_VEL_FIELDS: tuple[CmdVelField, ...] = ("linear.x", "linear.y", "angular.z")
PoseRate = Literal["vx", "vy", "wz"]
POSE_RATES: tuple[PoseRate, ...] = ("vx", "vy", "wz")
POSE_UNITS = ("m/s", "m/s", "rad/s")
DOF_UNITS = dict(zip(POSE_RATES, POSE_UNITS, strict=True))
TWIST_UNITS = dict(zip(CMD_VEL_FIELDS, POSE_UNITS, strict=True))
# SI units of a state or a command; 1 for a ratio or a count.
Unit = Literal[
    "m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2", "N", "N*m", "V", "A", "1"
]
MAX_CORNERS = 512  # maximum number of corners of a footprint
MAX_VARIABLES = 32  # maximum size of a state or a command
# Maximum radius of a footprint [m]; a larger one is probably given in centimetres
MAX_RADIUS = 10.0
LENGTH_PARAMETERS = {
    "wheelbase",
    "track",
    "effective_track",
    "wheel_radius",
    "half_length",
    "half_width",
}
MAX_LENGTH = 20.0  # maximum of these parameters, in radii of the footprint
FARTHEST_STEERED = 3.2  # maximum angle of a steered wheel [rad]
# 1 + cosine at a corner; at sharper corners, a grown outline does not keep its edges parallel
MIN_CORNER = 0.2
MAX_VALUE = 1e6  # maximum absolute value of a variable, in its unit


def list_kinds() -> list[str]:
    """Returns the names of all kinds of robots."""
    names = set(extensions.find_extensions("kinds"))
    for module in iter_modules([str(Path(__file__).parent)]):
        names.update(_load_kinds(module.name))
    return sorted(names)


def find_kind(name: str) -> Any | None:
    """Returns a `kinds.RobotKind`; None if no kind has that name."""
    if name in extensions.find_extensions("kinds"):
        return extensions.load("kinds", name)
    return (_load_kinds(name) or _load_kinds(name.rpartition("_")[0])).get(name)


def _load_kinds(module: str) -> dict[str, Any]:
    place = f"{__package__}.{module}"
    if not module.isidentifier() or find_spec(place) is None:
        return {}
    loaded = import_module(place)
    kind = getattr(loaded, "KIND", None)
    if kind is None:
        return {}
    return {module: kind, **getattr(loaded, "VARIANTS", {})}


class Variable(Schema):
    """A component of the state or of the command."""

    # unique; lowercase letters, digits and _
    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    unit: Unit  # SI unit of its values; 1 for a ratio or a count
    min: float = Field(ge=-MAX_VALUE, le=MAX_VALUE)  # minimum, in this unit
    max: float = Field(ge=-MAX_VALUE, le=MAX_VALUE)  # maximum, in this unit

    @model_validator(mode="after")
    def _check_order(self) -> "Variable":
        if not self.min < self.max:
            raise ValueError(f"min must be less than max of variable {self.name!r}")
        return self


class StateVariable(Variable):
    """A component of the state. It is measured, `follows` a command, or is part of the `twist`."""

    follows: str | None = None  # name of the command that it follows with a lag
    # component of the body twist that it equals; taken from the pose if not measured
    twist: PoseRate | None = None

    @property
    def must_be_measured(self) -> bool:
        """True if neither a command nor the pose determines it."""
        return self.follows is None and self.twist is None


class CommandVariable(Variable):
    """A component of the command, with its field of `cmd_vel` if it has one."""

    # field of `cmd_vel` that carries it; None: driven in process only
    cmd_vel: CmdVelField | None = None

    @property
    def turns(self) -> bool:
        """True for a turn rate or a steering angle."""
        return self.cmd_vel == "angular.z"

    @property
    def steers(self) -> bool:
        """True for a steering angle, whose turn rate depends on the speed."""
        return self.turns and self.unit == "rad"

    @property
    def is_twist(self) -> bool:
        """True for a component of the body twist."""
        return self.cmd_vel is not None and TWIST_UNITS[self.cmd_vel] == self.unit


class RobotSpec(Schema):
    """A robot: its state, commands, footprint and parameters."""

    name: str  # used in messages and in names of files
    description: str = ""  # one sentence for people who read the file
    # its kind, whose textbook kinematics make recordings and replace what a drive did
    # not show
    textbook: str | None = None
    # parameters of its kind [m, s], see the kind's module
    parameters: dict[str, float] = Field(default_factory=dict)
    # names of parameters that its kind assumed; lengths are in proportion to the footprint
    assumed: tuple[str, ...] = ()
    # meaning of `angular.z` for a robot that steers: a turn rate [rad/s], as in any Twist, or the
    # steering angle [rad] itself
    angular_is: Literal["turn_rate", "steering"] = "turn_rate"
    # radius of a circle around `base_link` [m], at most 10; by default it encloses the `footprint`
    footprint_radius: float = Field(ge=1e-3)
    # corners of a polygon instead of the circle, in `base_link` [m], in either direction
    footprint: tuple[tuple[float, float], ...] | None = Field(
        default=None, min_length=3, max_length=MAX_CORNERS
    )
    # default lidar, a shipped one or a YAML file; None: the paper's
    lidar: str | None = Field(default=None, min_length=1)
    # mount of that lidar: x, y [m] and heading [rad] in `base_link`; None: as in the lidar's file
    lidar_mount: Mount | None = None
    # variables that follow commands with a lag or are measured, in the order of every state vector
    state: tuple[StateVariable, ...] = Field(default=(), max_length=MAX_VARIABLES)
    # variables that drive the robot, in the order of every command vector
    command: tuple[CommandVariable, ...] = Field(min_length=1, max_length=MAX_VARIABLES)

    @field_validator("textbook")
    @classmethod
    def _check_textbook(cls, textbook: str | None) -> str | None:
        if textbook is not None and find_kind(textbook) is None:
            raise ValueError(f"must be one of {', '.join(list_kinds())}")
        return textbook

    @model_validator(mode="before")
    @classmethod
    def _add_radius(cls, data: Any) -> Any:
        return _add_circumradius(data) if isinstance(data, dict) else data

    @model_serializer(mode="wrap")
    def _drop_none(
        self, dump: pydantic.SerializerFunctionWrapHandler
    ) -> dict[str, Any]:
        # Models and policies are identified by their content, so an empty key must not change it.
        data: dict[str, Any] = dump(self)
        for name in ("lidar", "lidar_mount"):
            if getattr(self, name) is None:
                data.pop(name, None)  # a partial dump may lack it
        return data

    @model_validator(mode="after")
    def _check_name(self) -> "RobotSpec":
        if any(part in self.name for part in ("/", "\\", "..")):
            raise ValueError(
                f"name {self.name!r}: it is used in file names, so remove .., / and \\"
            )
        return self

    @model_validator(mode="after")
    def _check_footprint(self) -> "RobotSpec":
        if not self.footprint_radius <= MAX_RADIUS:
            raise ValueError(
                f"its footprint reaches {self.footprint_radius:.6g} m from base_link, "
                f"the maximum is {MAX_RADIUS:g} m; lengths are in metres"
            )
        if self.footprint is not None:
            if geometry.has_crossing_edges(np.array(self.footprint)):
                raise ValueError(
                    "edges of footprint cross or touch; list its corners in order"
                )
            reach = _reach(self.footprint)
            radius = self.footprint_radius
            if not math.isclose(reach, radius, rel_tol=1e-6):
                raise ValueError(
                    f"footprint reaches {reach:.6g} m from base_link, footprint_radius "
                    f"is {radius:.6g} m; remove footprint_radius"
                )
        return self

    @model_validator(mode="after")
    def _check_parameters(self) -> "RobotSpec":
        for name, size in self.parameters.items():
            if not size > 0.0 and (name in LENGTH_PARAMETERS or name.endswith("_lag")):
                raise ValueError(f"{name} {size:g}: must be more than 0")
            if (
                name in LENGTH_PARAMETERS
                and abs(size) > MAX_LENGTH * self.footprint_radius
            ):
                raise ValueError(
                    f"{name} {size:g} m is too long for a robot of {self.footprint_radius:.3g} m "
                    "around base_link; lengths are in metres"
                )
        return self

    @model_validator(mode="after")
    def _check_variables(self) -> "RobotSpec":
        fields = [c.cmd_vel for c in self.command]
        twists = [v.twist for v in self.state]
        for names, fault in (
            (
                self.variable_names,
                "every state and command variable needs a unique name",
            ),
            (fields, "two commands share one field of cmd_vel"),
            (twists, "two states are the same component of the twist"),
        ):
            given = [name for name in names if name is not None]
            if len(set(given)) < len(given):
                raise ValueError(fault)
        commands = [c.name for c in self.command]
        for v in self.state:
            if v.follows is not None and v.follows not in commands:
                raise ValueError(
                    f"state {v.name!r} follows {v.follows!r}, which is not a command"
                )
            if v.twist is not None and v.unit != DOF_UNITS[v.twist]:
                raise ValueError(
                    f"state {v.name!r} is {v.twist} of the twist, so its unit is "
                    f"{DOF_UNITS[v.twist]}"
                )
        return self

    def grow_footprint(self, margin: float) -> "RobotSpec":
        """Returns the robot with a footprint that is larger all around by a margin [m].

        With a polygon, `footprint_radius` is kept, because worlds use it to place
        robots; the larger robot is thus placed where the original would be.
        """
        if self.footprint is None:
            radius = self.footprint_radius + margin
            return self.model_copy(update={"footprint_radius": radius})
        corners = np.array(self.footprint)
        next_corners = np.roll(corners, -1, axis=0)
        x, y = (next_corners - corners).T
        doubled_area = np.sum(
            corners[:, 0] * next_corners[:, 1] - corners[:, 1] * next_corners[:, 0]
        )
        normals = np.sign(doubled_area) * np.stack([y, -x], axis=-1)
        normals = normals / np.hypot(x, y)[:, None]  # outward
        last_normals = np.roll(normals, 1, axis=0)
        corner = 1.0 + np.sum(last_normals * normals, axis=-1, keepdims=True)
        shift = margin * (last_normals + normals) / np.maximum(corner, MIN_CORNER)
        moved = (corners + shift).tolist()
        return self.model_copy(update={"footprint": tuple(map(tuple, moved))})

    @property
    def variable_names(self) -> tuple[str, ...]:
        """Names of X = [S, C]."""
        return tuple(v.name for v in (*self.state, *self.command))

    @property
    def variable_units(self) -> tuple[str, ...]:
        """Units of X = [S, C]."""
        return tuple(v.unit for v in (*self.state, *self.command))

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of dQ/dt: the body twist, then the rates of the state."""
        return (*POSE_RATES, *(f"d_{v.name}" for v in self.state))

    @property
    def dof_units(self) -> tuple[str, ...]:
        """Units of dQ/dt."""
        return (*POSE_UNITS, *(f"{v.unit}/s" for v in self.state))

    @property
    def steers(self) -> bool:
        """True if a steering angle is commanded."""
        return any(command.steers for command in self.command)

    @property
    def moves_sideways(self) -> bool:
        """True if it can be driven sideways."""
        fields = [command.cmd_vel for command in self.command]
        if any(fields) or self.textbook is None:
            return "linear.y" in fields
        return bool(getattr(find_kind(self.textbook), "sideways", False))

    @property
    def takes_cmd_vel(self) -> bool:
        """True if every command has a field of `cmd_vel`, which nodes need."""
        return all(command.cmd_vel is not None for command in self.command)

    @property
    def takes_turn_rate(self) -> bool:
        """True if `angular.z` is a turn rate for a robot that is commanded by a steering angle."""
        return self.angular_is == "turn_rate" and self.steers

    @property
    def knows_wheelbase(self) -> bool:
        """True if its wheelbase is given, not only assumed."""
        return (
            self.parameters.get("wheelbase", 0.0) > 0.0
            and "wheelbase" not in self.assumed
        )

    @property
    def wheelbase(self) -> float:
        """Distance between the axles of a robot that steers [m]. Raises ConfigError if unknown."""
        if not self.knows_wheelbase:
            raise ConfigError(
                f"robot {self.name!r} steers, and its wheelbase is not known; add "
                "`wheelbase:` [m] to the `parameters:` of its YAML file."
            )
        return self.parameters["wheelbase"]

    @cached_property
    def command_low(self) -> NDArray[np.float64]:
        """Minimum command (C,)."""
        return np.array([c.min for c in self.command])

    @cached_property
    def command_high(self) -> NDArray[np.float64]:
        """Maximum command (C,)."""
        return np.array([c.max for c in self.command])

    @cached_property
    def _cmd_vel_index(self) -> NDArray[np.intp]:
        places = []
        for command in self.command:
            if command.cmd_vel is None:
                raise ConfigError(
                    f"robot {self.name!r}: the command {command.name!r} names no field "
                    "of cmd_vel; add `cmd_vel:` to it, or drive it in process, "
                    "without ROS 2."
                )
            places.append(CMD_VEL_FIELDS.index(command.cmd_vel))
        return np.array(places, dtype=np.intp)

    @property
    def cmd_vel_places(self) -> tuple[int, ...]:
        """Indices (C,) of the commands in `CMD_VEL_FIELDS`. Raises ConfigError if one has none."""
        return tuple(self._cmd_vel_index.tolist())

    @cached_property
    def bicycle(self) -> Bicycle:
        """Geometry of a robot that steers. Raises ConfigError if its wheelbase is unknown."""
        kind = None if self.textbook is None else find_kind(self.textbook)
        return Bicycle(self.wheelbase, getattr(kind, "front_drive", False))

    def to_cmd_vel(self, command: ArrayLike) -> NDArray[np.float64]:
        """Converts a command (..., C) to `cmd_vel` (..., 3): linear.x, linear.y, angular.z.

        Raises ConfigError if a command has no field, or if a wheelbase is needed but unknown.
        """
        values = self.to_fields(command)
        if self.takes_turn_rate:
            return self.bicycle.twist(values[..., 0], values[..., 2])
        return values

    def from_cmd_vel(self, twist: ArrayLike) -> NDArray[np.float64]:
        """Converts `cmd_vel` (..., 3) to a command (..., C); unused fields are dropped.

        A steering angle follows from speed and turn rate, within its limits; at rest it is 0.
        """
        twist = np.asarray(twist, dtype=np.float64)
        if not self.takes_turn_rate:
            return self.from_fields(twist)
        speed, angle = self.bicycle.command(twist)
        fields = np.stack([speed, twist[..., 1], angle], axis=-1)
        command = self.from_fields(fields)
        limits = np.array(
            [(c.min, c.max) if c.steers else (-np.inf, np.inf) for c in self.command]
        )
        return np.asarray(np.clip(command, *limits.T))

    def pass_through_cmd_vel(self, command: ArrayLike) -> NDArray[np.float64]:
        """Returns commands (..., C) as they arrive through `cmd_vel`, if the robot uses it.

        They differ by rounding, and a car that takes turn rates does not steer at rest.
        """
        if self.takes_cmd_vel and (self.knows_wheelbase or not self.takes_turn_rate):
            return self.from_cmd_vel(self.to_cmd_vel(command))
        return np.asarray(command, dtype=np.float64)

    def require_cmd_vel(self) -> None:
        """Raises ConfigError if a node can't drive the robot, because `to_cmd_vel` fails."""
        self.to_cmd_vel(self.command_low)

    def to_fields(self, command: ArrayLike) -> NDArray[np.float64]:
        """Returns commands (..., C) by field of `cmd_vel` (..., 3); steering angles stay as is."""
        command = np.asarray(command, dtype=np.float64)
        values = np.zeros((*command.shape[:-1], 3))
        values[..., self._cmd_vel_index] = command
        return values

    def from_fields(self, values: ArrayLike) -> NDArray[np.float64]:
        """Returns commands (..., C) from values (..., 3) by field of `cmd_vel`."""
        return np.asarray(values, dtype=np.float64)[..., self._cmd_vel_index]


def _add_circumradius(data: dict[str, Any]) -> dict[str, Any]:
    outline = data.get("footprint")
    if outline is None or "footprint_radius" in data:
        return data
    # Validation of the field reports faults.
    with suppress(OverflowError, TypeError, ValueError):
        if len(outline) <= MAX_CORNERS:
            data = data | {"footprint_radius": _reach(outline)}
    return data


def _reach(outline: ArrayLike) -> float:
    corners = np.array(outline, dtype=np.float64)
    return float(np.hypot(corners[:, 0], corners[:, 1]).max())


def load_robot(name: str | Path) -> RobotSpec:
    """Loads a shipped robot by name (`ackermann`), or any robot by the path of its YAML file."""
    return build_robot(name)


def build_robot(
    definition: str | Path | Mapping[str, Any], ranges: Ranges | None = None
) -> RobotSpec:
    """Builds a robot from a shipped robot's name, the path of a YAML file, or its content.

    With a `kind` instead of `textbook`, all defaults of the kind may be omitted: names, units and
    ranges of commands, state and parameters. `ranges` (minimum, maximum) of recorded commands, by
    name, are the defaults of their ranges. Raises ConfigError for a faulty definition.
    """
    ranges = ranges or {}
    data = read_definition(definition)
    source = "robot"
    if not isinstance(definition, Mapping):
        source = str(find_config(definition, "robots"))
    if "kind" in data:
        data = _fill_from_kind(data, ranges, source)
    spec = validate(data, RobotSpec, source)
    for c in spec.command:
        end = max(c.min, c.max, key=abs)
        is_recorded = end in ranges.get(c.name, ())  # then the mapping is at fault
        if c.steers and abs(end) > FARTHEST_STEERED and not is_recorded:
            raise ConfigError(
                f"{source}: key 'command': {c.name} reaches {end:g} rad, too far "
                "for a steered wheel; angles are in radians."
            )
    return spec


def read_definition(definition: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """Returns the content of a robot's YAML file; the robot is named after the file by default."""
    if isinstance(definition, Mapping):
        return dict(definition)
    path = find_config(definition, "robots")
    return {"name": path.stem} | parse_yaml(read_text(path), str(path))


def _fill_from_kind(
    data: dict[str, Any], ranges: Ranges, source: str
) -> dict[str, Any]:
    kind = find_kind(str(data["kind"]))
    if kind is None:
        hint = suggest(str(data["kind"]), list_kinds())
        raise ConfigError(f"{source}: key 'kind': there is no {data['kind']!r}; {hint}")
    if "textbook" in data:
        raise ConfigError(
            f"{source}: has a `kind` and a `textbook`; remove one of them."
        )
    whole: dict[str, Any] = kind.template.fill(_add_circumradius(data), ranges)
    return whole
