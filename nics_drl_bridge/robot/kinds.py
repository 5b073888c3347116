"""Kinds of robots: textbook kinematics and a drawing for each; `spec` finds them by name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec, StateVariable, find_kind, kind_names
from nics_drl_bridge.robot.template import Template

Array = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class Textbook:
    """Textbook kinematics of a robot."""

    twist: Callable[[Array], Array]  # gives the body twist (..., 3) for a state (..., S)
    target: Callable[[Array], Array]  # gives the state (..., S) that a command (..., C) requests
    lag: Array  # (S,) time constants of first-order actuators [s]
    rate: Array  # (S,) of rate-limited actuators [its unit/s]; inf for first-order ones
    structure: dict[str, tuple[str, ...]]  # possible products of states, by component of the twist
    # gives the command (..., C), maybe out of range, that leads to a twist (..., 3), if known
    command: Callable[[Array], Array] | None = None

    def steady(self, command: Array) -> Array:
        """Returns the body twist (..., 3) to which commands (..., C) lead when they are held."""
        return self.twist(self.target(command))

    def respond(self, state: Array, goal: Array, t: Array | float) -> Array:
        """Returns the exact state (..., S) at time t [s] on its way from `state` to `goal`."""
        gap = state - goal
        ramp = np.sign(gap) * np.maximum(np.abs(gap) - np.where(self.limited, self.rate, 0) * t, 0)
        return goal + np.where(self.limited, ramp, gap * np.exp(-t / self.lag))

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Mask (S,) of the rate-limited actuators."""
        return np.isfinite(self.rate)


@dataclass(frozen=True)
class Pivot:
    """Vertical axis about which a wheel is steered; another joint follows the variable's."""

    link: str
    joint: str
    angle: StateVariable


@dataclass(frozen=True)
class Wheel:
    """A wheel that stands on the ground; its joint `turns` by the state variable of its name."""

    name: str
    place: tuple[float, float]  # x, y in `base_link` [m]
    radius: float  # [m]
    turns: bool = False
    pivot: Pivot | None = None


@dataclass(frozen=True)
class Drawing:
    """Looks of a robot: wheels, a box (length, width) or cylinder (radius), its x and height."""

    body: tuple[float, float] | float
    centre: tuple[float, float]
    wheels: tuple[Wheel, ...]


def wheels_at(
    spec: RobotSpec, places: Sequence[tuple[float, float]], radius: float, names: tuple[str, ...]
) -> tuple[Wheel, ...]:
    """Returns wheels at places; those of a state of as many wheels turn by its variables."""
    if turns := bool(spec.state) and all(v.unit == "rad/s" and v.twist is None for v in spec.state):
        names = tuple(v.name for v in spec.state)
    both = zip(names, places, strict=True)
    return tuple(Wheel(name, place, radius, turns=turns) for name, place in both)


@dataclass(frozen=True)
class RobotKind:
    """A kind of robot. Its functions raise KeyError for a parameter that the spec lacks."""

    kinematics: Callable[[RobotSpec], Textbook] | None  # of its actuators; None: not known
    drawing: Callable[[RobotSpec], Drawing]
    template: Template = field(default_factory=Template)
    sideways: bool = False  # True if it is driven sideways by commands other than a twist's
    slips: bool = False  # True if it moves otherwise than the twist that is commanded
    front_drive: bool = False  # True if the speed is that of the steered wheel


def textbook(spec: RobotSpec) -> Textbook:
    """Returns a robot's textbook kinematics; ConfigError if its spec names none or does not fit."""
    book = actuated(spec)
    if spec.state and all(v.twist is not None for v in spec.state):
        return _through_lags(spec, book)
    if len(spec.state) != len(book.lag):
        have = ", ".join(v.name for v in spec.state) or "none"
        needed = f"the {spec.textbook} kinematics need a state of {len(book.lag)} actuators"
        fix = "correct `state:`, or leave it to the kind"
        raise ConfigError(f"robot {spec.name!r}: {needed}, not {have}; {fix}.")
    return book


def actuated(spec: RobotSpec) -> Textbook:
    """Returns the textbook kinematics of a robot's actuators; ConfigError as `textbook`."""

    def make(kind: RobotKind) -> Textbook:
        if kind.kinematics is None:
            fault = f"no textbook tells where the commands of the kind {spec.textbook!r} lead"
            fix = "do without, by a recording and its model, or choose another kind"
            raise ConfigError(f"robot {spec.name!r}: {fault}; {fix}.")
        return kind.kinematics(spec)

    return _made(spec, make)


def has_textbook(spec: RobotSpec) -> bool:
    """True if a robot's textbook kinematics are known, but maybe for a parameter."""
    kind = None if spec.textbook is None else find_kind(spec.textbook)
    return getattr(kind, "kinematics", None) is not None


def _through_lags(spec: RobotSpec, book: Textbook) -> Textbook:
    """Returns the kinematics of a robot whose state is its twist, behind lags of its actuators."""
    # Speeds take the lag of the first actuator, the turn rate that of the last, as of a steering.
    dofs = [POSE_RATES.index(v.twist) for v in spec.state if v.twist is not None]
    if book.limited.any():
        fault = "a rate limit of an actuator needs the actuators as state"
        raise ConfigError(f"robot {spec.name!r}: {fault}; give lags, or correct `state:`.")
    usual = [float(book.lag[-1 if dof == 2 else 0]) for dof in dofs]
    named = zip(spec.state, usual, strict=True)
    lag = np.array([spec.parameters.get(f"{v.name}_lag", one) for v, one in named])

    def twist(state: Array) -> Array:
        whole = np.zeros((*state.shape[:-1], 3))
        whole[..., dofs] = state
        return whole

    names: dict[str, tuple[str, ...]] = dict.fromkeys(POSE_RATES, ())
    names |= {str(v.twist): (v.name,) for v in spec.state}
    target = lambda command: book.steady(command)[..., dofs]  # noqa: E731
    return Textbook(twist, target, lag, np.full(len(lag), np.inf), names, book.command)


def drawing(spec: RobotSpec) -> Drawing:
    """Returns the looks of a robot. Raises ConfigError as `textbook` does."""
    return _made(spec, lambda kind: kind.drawing(spec))


def _made(spec: RobotSpec, make: Callable[[RobotKind], T]) -> T:
    robot, kind = f"robot {spec.name!r}", find_kind(require_textbook(spec))
    if kind is None:
        known = ", ".join(kind_names())
        raise ConfigError(f"{robot}: `textbook:` must be one of {known}, not {spec.textbook!r}.")
    try:
        return make(kind)
    except KeyError as error:
        needed = f"the {spec.textbook} kinematics need the parameter {error}"
        raise ConfigError(f"{robot}: {needed}; add it under `parameters:`.") from None


def require_textbook(spec: RobotSpec) -> str:
    """Returns the name of a robot's kind. Raises ConfigError if it names none."""
    if spec.textbook is None:
        fix = "add `textbook:` to its YAML file or give a recording."
        raise ConfigError(f"robot {spec.name!r} names no textbook kinematics; {fix}")
    return spec.textbook


def steady_twist(spec: RobotSpec, command: ArrayLike) -> Array:
    """Returns the body twist (..., 3) to which commands (..., C) lead when they are held.

    Raises ConfigError if neither kinematics nor wheelbase of a robot are known that needs them.
    """
    if commands_twist(spec):
        return spec.to_cmd_vel(command)
    if spec.textbook is None and spec.steers:
        return _by_turn_rate(spec).to_cmd_vel(command)
    return actuated(spec).steady(np.asarray(command, dtype=np.float64))


def command_for(spec: RobotSpec, twist: ArrayLike) -> Array:
    """Returns the command (..., C) within its limits that leads to a body twist (..., 3), if any.

    A car that is to turn on the spot stands. Raises ConfigError as `steady_twist`.
    """
    twist = np.asarray(twist, dtype=np.float64)
    if commands_twist(spec):
        command = spec.from_cmd_vel(twist)
    elif spec.textbook is None and spec.steers:
        command = _by_turn_rate(spec).from_cmd_vel(twist)
    else:
        book = actuated(spec)
        if book.command is None:
            fault = f"which command leads to a twist is not known of a {spec.textbook}"
            raise ConfigError(f"robot {spec.name!r}: {fault}; use continuous actions, no planner.")
        command = book.command(twist)
    return np.clip(command, spec.command_low, spec.command_high)


def reach(spec: RobotSpec) -> Array:
    """Returns the greatest steady twist (3,) of a robot's commands; ConfigError: see there."""
    rest = np.clip(0.0, spec.command_low, spec.command_high)
    ends = zip(spec.command_low, rest, spec.command_high, strict=True)
    corners = np.array(list(product(*ends)))
    return np.asarray(np.abs(steady_twist(spec, corners)).max(axis=0))


def _by_turn_rate(spec: RobotSpec) -> RobotSpec:
    return spec.model_copy(update={"angular_is": "turn_rate"})


def commands_twist(spec: RobotSpec) -> bool:
    """True if a robot's commands are the components of its body twist, but for their lags."""
    if not all(command.is_twist for command in spec.command):
        return False
    kind = None if spec.textbook is None else find_kind(spec.textbook)
    return not getattr(kind, "slips", False)
