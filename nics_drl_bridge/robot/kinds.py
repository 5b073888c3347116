"""Kinds of robots: textbook kinematics and a drawing for each; `spec` finds them by name.

Commands are identified by their field of `cmd_vel`; if there is none, by name, else by order. Speed
and steering angle in the state are identified by unit. An actuator is first-order (parameters
`wheel_lag`, `speed_lag`, `steering_lag` [s]) or rate-limited (`wheel_rate`, `speed_rate`,
`steering_rate` [its unit/s]). See Siegwart, Nourbakhsh, Scaramuzza: Introduction to Autonomous
Mobile Robots, ch. 3, which the paper cites for Table I.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array, Bicycle
from nics_drl_bridge.robot import spec as specs
from nics_drl_bridge.robot.spec import (
    POSE_RATES,
    RobotSpec,
    StateVariable,
    find_kind,
    list_kinds,
)
from nics_drl_bridge.robot.template import Template

LIMIT_TOLERANCE = 0.01  # fraction by which rounded values may exceed a limit
# Minimum similarity of a misspelt parameter; names of different parameters are less similar
MISSPELT_NAME = 0.8
MAX_VARIED = 6  # maximum number of commands whose ends are combined
NO_LAG_S = 1e-9  # lag of actuators that respond at once
T = TypeVar("T")


@dataclass(frozen=True)
class Textbook:
    """Textbook kinematics of a robot."""

    twist: Callable[[Array], Array]  # body twist (..., 3) for a state (..., S)
    target: Callable[[Array], Array]  # state (..., S) to which a command (..., C) tends
    lag: Array  # (S,) time constants of first-order actuators [s]
    rate: Array  # (S,) maximum rates of actuators [their unit/s]; inf for first-order ones
    # Terms that may occur (products of states), by component of the twist
    structure: dict[str, tuple[str, ...]]
    # Command (..., C), possibly out of range, that leads to a twist (..., 3); None if unknown
    command: Callable[[Array], Array] | None = None

    def compute_twist(self, command: Array) -> Array:
        """Returns the body twist (..., 3) to which held commands (..., C) lead."""
        return self.twist(self.target(command))

    def respond(self, state: Array, goal: Array, t: Array | float) -> Array:
        """Returns the exact state (..., S) at time t [s] from `state` to `goal`."""
        gap = state - goal
        rate = np.where(self.limited, self.rate, 0)
        ramp = np.sign(gap) * np.maximum(np.abs(gap) - rate * t, 0)
        return goal + np.where(self.limited, ramp, gap * np.exp(-t / self.lag))

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Mask (S,) of the rate-limited actuators."""
        return np.isfinite(self.rate)


@dataclass(frozen=True)
class Pivot:
    """Vertical axis about which a wheel is steered."""

    link: str
    joint: str  # follows the joint named like the angle, if its own name differs
    angle: StateVariable


@dataclass(frozen=True)
class Wheel:
    """A wheel on the ground; if it `turns`, its joint follows the state variable of its name."""

    name: str
    place: tuple[float, float]  # x, y in `base_link` [m]
    radius: float  # [m]
    turns: bool = False
    pivot: Pivot | None = None


@dataclass(frozen=True)
class Drawing:
    """Appearance of a robot: its body and its wheels."""

    # length and width of a box, or radius of a cylinder [m]
    body: tuple[float, float] | float
    centre: tuple[float, float]  # x and height of the body's centre [m]
    wheels: tuple[Wheel, ...]


def draw_disc(spec: RobotSpec) -> Drawing:
    """Draws a disc without wheels."""
    return Drawing(spec.footprint_radius, (0.0, 0.02), ())


def place_wheels(
    spec: RobotSpec,
    places: Sequence[tuple[float, float]],
    radius: float,
    names: tuple[str, ...],
) -> tuple[Wheel, ...]:
    """Returns wheels at places [m]; if the state is the wheel speeds, they turn accordingly."""
    turns = bool(spec.state) and all(
        v.unit == "rad/s" and v.twist is None for v in spec.state
    )
    if turns:
        names = tuple(v.name for v in spec.state)
    return tuple(
        Wheel(name, place, radius, turns=turns)
        for name, place in zip(names, places, strict=True)
    )


def places_of_four(parameters: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Returns x, y [m] in `base_link` of a robot's four wheels by name.

    They stand at `half_length` and `half_width`, each by default half a `track`. Raises KeyError if
    these are unknown.
    """
    x, y = (
        parameters[name] if name in parameters else 0.5 * parameters["track"]
        for name in ("half_length", "half_width")
    )
    return {
        "front_left": (x, y),
        "front_right": (x, -y),
        "rear_left": (-x, y),
        "rear_right": (-x, -y),
    }


@dataclass(frozen=True)
class RobotKind:
    """A kind of robot. Its functions raise KeyError for a parameter that the spec lacks."""

    # kinematics of its actuators; None if unknown
    kinematics: Callable[[RobotSpec], Textbook] | None
    drawing: Callable[[RobotSpec], Drawing]
    template: Template = field(default_factory=Template)
    # True if it moves sideways although no command has a field of `cmd_vel`
    sideways: bool = False
    slips: bool = False  # True if its twist differs from the commanded one
    front_drive: bool = False  # True if its commanded speed is the steered wheel's


def textbook(spec: RobotSpec) -> Textbook:
    """Returns a robot's textbook kinematics.

    Raises ConfigError if its spec names none or does not fit them.
    """
    book = find_actuator_kinematics(spec)
    if spec.state and all(v.twist is not None for v in spec.state):
        return _add_lags(spec, book)
    if not spec.state and not _apply_to_kind(
        spec, lambda kind: kind.template.moves or kind.template.state
    ):
        return replace(book, lag=np.full(len(book.lag), NO_LAG_S))
    if len(spec.state) != len(book.lag):
        names = ", ".join(v.name for v in spec.state) or "none"
        raise _make_error(
            spec,
            f"need a state of {len(book.lag)} actuators, not {names}; correct "
            "`state:`, or remove it to use the kind's.",
        )
    return book


def find_actuator_kinematics(spec: RobotSpec) -> Textbook:
    """Returns the textbook kinematics of the actuators. Raises ConfigError like `textbook`."""
    book = _apply_to_kind(spec, lambda kind: kind.kinematics and kind.kinematics(spec))
    if book is None:
        raise ConfigError(
            f"robot {spec.name!r}: the kind {spec.textbook!r} has no textbook "
            "kinematics; use a recording and its model instead, or choose another kind."
        )
    return book


def has_textbook(spec: RobotSpec) -> bool:
    """Returns True if a robot's textbook kinematics are known; parameters may still be missing."""
    return getattr(find_kind(spec.textbook or ""), "kinematics", None) is not None


def _add_lags(spec: RobotSpec, book: Textbook) -> Textbook:
    """Returns the kinematics of a robot whose state is its twist, which lags like its actuators."""
    if book.limited.any():
        raise ConfigError(
            f"robot {spec.name!r}: a rate limit of an actuator needs the actuators as "
            "state; give lags, or correct `state:`."
        )
    dofs = []
    lags = []
    structure: dict[str, tuple[str, ...]] = dict.fromkeys(POSE_RATES, ())
    for v in spec.state:
        twist = v.twist or "vx"
        dofs.append(POSE_RATES.index(twist))
        # Speeds take the lag of the first actuator, turn rates the lag of the last one (steering).
        actuator = -1 if twist == "wz" else 0
        lags.append(spec.parameters.get(f"{v.name}_lag", book.lag[actuator]))
        structure[twist] = (v.name,)

    def compose_twist(state: Array) -> Array:
        twist = np.zeros((*state.shape[:-1], 3))
        twist[..., dofs] = state
        return twist

    return Textbook(
        twist=compose_twist,
        target=lambda command: book.compute_twist(command)[..., dofs],
        lag=np.array(lags),
        rate=np.full(len(lags), np.inf),
        structure=structure,
        command=book.command,
    )


def draw_robot(spec: RobotSpec) -> Drawing:
    """Returns the drawing of a robot. Raises ConfigError like `textbook`."""
    return _apply_to_kind(spec, lambda kind: kind.drawing(spec))


def _apply_to_kind(spec: RobotSpec, function: Callable[[RobotKind], T]) -> T:
    """Applies a function to a robot's kind. Raises ConfigError if kind or parameter is unknown."""
    kind = find_kind(require_textbook(spec))
    if kind is None:
        raise ConfigError(
            f"robot {spec.name!r}: `textbook:` must be one of {', '.join(list_kinds())}, "
            f"not {spec.textbook!r}."
        )
    try:
        return function(kind)
    except KeyError as error:
        usual = {*kind.template.parameters, *kind.template.lengths}
        unusual = [name for name in spec.parameters if name not in usual]
        name = str(error.args[0])
        near = difflib.get_close_matches(name, unusual, n=1, cutoff=MISSPELT_NAME)
        fix = f"is {near[0]!r} it?" if near else "add it under `parameters:`."
        raise _make_error(spec, f"need the parameter {error}; {fix}") from None


def require_textbook(spec: RobotSpec) -> str:
    """Returns the name of a robot's kind. Raises ConfigError if it names none."""
    if spec.textbook is None:
        raise ConfigError(
            f"robot {spec.name!r} names no textbook kinematics; add `textbook:` to its "
            "YAML file or give a recording."
        )
    return spec.textbook


def _choose_conversion(spec: RobotSpec) -> RobotSpec | Textbook:
    """Returns what converts between a robot's commands and its twist."""
    if is_twist_commanded(spec):
        return spec
    if spec.textbook is None and spec.steers:
        return spec.model_copy(update={"angular_is": "turn_rate"})
    return find_actuator_kinematics(spec)


def compute_steady_twist(spec: RobotSpec, command: ArrayLike) -> Array:
    """Returns the body twist (..., 3) to which held commands (..., C) lead.

    Raises ConfigError if kinematics or wheelbase are needed but unknown.
    """
    conversion = _choose_conversion(spec)
    if isinstance(conversion, RobotSpec):
        return conversion.to_cmd_vel(command)
    return conversion.compute_twist(np.asarray(command, dtype=np.float64))


def find_command(spec: RobotSpec, twist: ArrayLike) -> Array:
    """Returns the command (..., C) within its limits that leads to a body twist (..., 3), if any.

    A car that should turn on the spot stops instead. Raises ConfigError like
    `compute_steady_twist`.
    """
    conversion = _choose_conversion(spec)
    twist = np.asarray(twist, dtype=np.float64)
    if isinstance(conversion, RobotSpec):
        command = conversion.from_cmd_vel(twist)
    elif conversion.command is not None:
        command = conversion.command(twist)
    else:
        raise ConfigError(
            f"robot {spec.name!r}: the kind {spec.textbook!r} does not define which "
            "command leads to a twist; use continuous actions and no planner."
        )
    return np.clip(command, spec.command_low, spec.command_high)


def reach(spec: RobotSpec) -> Array:
    """Returns the maximum steady twist (3,). Raises ConfigError like `compute_steady_twist`."""
    twists = compute_steady_twist(spec, _combine_ends(spec))
    return np.asarray(np.abs(twists).max(axis=0))


def _combine_ends(spec: RobotSpec) -> Array:
    """Returns combinations (K, C) of minimum, rest (or nearest to it) and maximum commands.

    More than `MAX_VARIED` commands are not combined: all are at the same end.
    """
    rest = np.clip(0.0, spec.command_low, spec.command_high)
    ends = np.stack([spec.command_low, rest, spec.command_high])
    if ends.shape[1] > MAX_VARIED:
        return ends
    return np.array(list(product(*ends.T)))


def describe_overdrive(spec: RobotSpec) -> str | None:
    """Returns a sentence if commands exceed the limits of wheels or steering."""
    if not (has_textbook(spec) and spec.state and _has_actuator_state(spec)):
        return None
    targets = textbook(spec).target(_combine_ends(spec))
    for values, v in zip(targets.T, spec.state, strict=True):
        worst = float(values[np.abs(values).argmax()])
        low = v.min - LIMIT_TOLERANCE * abs(v.min)
        high = v.max + LIMIT_TOLERANCE * abs(v.max)
        if not low <= worst <= high:
            return (
                f"the commands require {v.name} of {worst:.3g} {v.unit}, beyond its "
                f"limits {v.min:g} and {v.max:g}; narrow the commands, or widen the "
                "limits of the state."
            )
    return None


def is_twist_commanded(spec: RobotSpec) -> bool:
    """Returns True if a robot's commands are components of its body twist, except for lags."""
    return all(command.is_twist for command in spec.command) and not slips(spec)


def slips(spec: RobotSpec) -> bool:
    """Returns True if the twist of a robot's kind differs from the commanded one."""
    return bool(getattr(find_kind(spec.textbook or ""), "slips", False))


def make_steered(
    spec: RobotSpec,
    geometry: Bicycle,
    names: tuple[str, ...],
    gain: tuple[float, float] = (1, 1),
) -> Textbook:
    """Returns the kinematics of a robot that is driven by a speed and a steering angle.

    Both are its actuators, which follow its commands, in any order, times the `gain`. To second
    order, its turn rate is a multiple of their product. `names` are the commands' usual names.
    """
    places = _find_state_places(spec)
    speed, angle = places
    columns = _find_columns(spec, ("linear.x", "angular.z"), names, 2)
    order = np.argsort(places)
    if _has_actuator_state(spec):
        names = tuple(v.name for v in spec.state)
    turn_term = f"{names[speed]}*{names[angle]}"
    lag, rate = _read_actuators(spec.parameters, ("speed", "steering"))

    def compute_command(twist: Array) -> Array:
        values = np.stack(geometry.command(twist), axis=-1) / gain
        return _place_values(spec, columns, values)

    return Textbook(
        twist=lambda state: geometry.twist(state[..., speed], state[..., angle]),
        target=lambda command: (command[..., columns] * gain)[..., order],
        lag=lag[order],
        rate=rate[order],
        structure={"vx": (names[speed],), "vy": (), "wz": (turn_term,)},
        command=compute_command,
    )


def find_steering_angle(spec: RobotSpec) -> StateVariable | None:
    """Returns the state variable of a steered robot's steering angle, if any."""
    if not _has_actuator_state(spec):
        return None
    return spec.state[_find_state_places(spec)[1]]


def make_wheeled(
    spec: RobotSpec,
    inverse: Array,
    forward: Array,
    moves: tuple[str, ...],
    wheels: tuple[str, ...],
    slip: float = 1.0,
) -> Textbook:
    """Returns the kinematics of a robot whose twist is linear in its wheel speeds, its actuators.

    `inverse` (W, M) gives the wheel speeds per component of the twist in `moves`, and `forward`
    (3, W) the body twist per wheel speed. `slip` scales the turn rate. The robot is commanded by
    its twist, or by its wheel speeds with the usual names `wheels`.
    """
    if _has_actuator_state(spec) and len(spec.state) != len(inverse):
        raise _make_error(
            spec,
            f"have {len(inverse)} wheels as state, not {len(spec.state)} variables; "
            "correct `state:`.",
        )
    dofs = [POSE_RATES.index(dof) for dof in moves]
    fields = tuple(specs.CMD_VEL_FIELDS[dof] for dof in dofs)
    wheels_from_command = inverse
    command_from_twist = np.eye(len(dofs))
    if all(c.unit == "rad/s" and c.cmd_vel is None for c in spec.command):
        columns = _find_columns(spec, fields, wheels, len(inverse))
        wheels_from_command = np.eye(len(inverse))
        command_from_twist = inverse
    else:
        columns = _find_columns(spec, fields, (), len(dofs))
    slip_factors = np.array([1.0, 1.0, slip])
    twist_from_wheels = forward * slip_factors[:, None]
    if _has_actuator_state(spec):
        wheels = tuple(v.name for v in spec.state)
    lag, rate = _read_actuators(spec.parameters, ("wheel",) * len(inverse))

    def compute_command(twist: Array) -> Array:
        values = (twist / slip_factors)[..., dofs] @ command_from_twist.T
        return _place_values(spec, columns, values)

    return Textbook(
        twist=lambda state: state @ twist_from_wheels.T,
        target=lambda command: command[..., columns] @ wheels_from_command.T,
        lag=lag,
        rate=rate,
        structure={dof: wheels if dof in moves else () for dof in POSE_RATES},
        command=compute_command,
    )


def _has_actuator_state(spec: RobotSpec) -> bool:
    """Returns True if the state consists of actuators."""
    return any(v.twist is None for v in spec.state)


def _find_columns(
    spec: RobotSpec,
    fields: tuple[specs.CmdVelField, ...],
    names: tuple[str, ...],
    count: int,
) -> list[int]:
    """Returns the indices of commands by field of `cmd_vel`, or by name if none has a field."""
    command_fields = [c.cmd_vel for c in spec.command]
    if not any(command_fields):
        if len(command_fields) != count:
            raise _make_error(
                spec,
                f"need {count} commands, not {len(command_fields)}; correct `command:`.",
            )
        command_names = [c.name for c in spec.command]
        if names and set(names) == set(command_names):
            return [command_names.index(name) for name in names]
        return list(range(count))
    for name in fields:
        if name not in command_fields:
            raise _make_error(spec, f"need a command with `cmd_vel: {name}`; add it.")
    return [command_fields.index(name) for name in fields]


def _place_values(spec: RobotSpec, columns: list[int], values: Array) -> Array:
    """Returns commands (..., C) with values in some columns, else 0."""
    command = np.zeros((*values.shape[:-1], len(spec.command)))
    command[..., columns] = values
    return command


def _make_error(spec: RobotSpec, reason: str) -> ConfigError:
    return ConfigError(f"robot {spec.name!r}: the {spec.textbook} kinematics {reason}")


def _find_state_places(spec: RobotSpec) -> tuple[int, int]:
    """Returns the indices of speed and steering angle in the state."""
    if not _has_actuator_state(spec):
        return 0, 1
    units = [v.unit for v in spec.state]
    if sorted(units) != ["m/s", "rad"]:
        raise _make_error(
            spec,
            f"need a state in m/s and rad, not in {', '.join(units) or 'nothing'}; "
            "correct `state:`.",
        )
    return units.index("m/s"), units.index("rad")


def _read_actuators(
    parameters: dict[str, float], parts: tuple[str, ...]
) -> tuple[Array, Array]:
    """Returns lags [s] and rate limits of actuators; each has one or the other."""
    lag = np.ones(len(parts))
    rate = np.full(len(parts), np.inf)
    for i, part in enumerate(parts):
        if f"{part}_rate" in parameters:
            rate[i] = parameters[f"{part}_rate"]
        else:
            lag[i] = parameters[f"{part}_lag"]
    return lag, rate
