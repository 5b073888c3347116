"""Kinds of robots: textbook kinematics and a drawing for each; `spec` finds them by name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import RobotSpec, StateVariable, find_kind, kind_names

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


@dataclass(frozen=True)
class RobotKind:
    """A kind of robot. Both functions raise KeyError for a parameter that the spec lacks."""

    kinematics: Callable[[RobotSpec], Textbook]
    drawing: Callable[[RobotSpec], Drawing]


def textbook(spec: RobotSpec) -> Textbook:
    """Returns a robot's textbook kinematics; ConfigError if its spec names none or does not fit."""
    return _made(spec, lambda kind: kind.kinematics(spec))


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

    Raises ConfigError if it steers, and neither its kinematics nor its wheelbase is known.
    """
    if spec.steers and spec.textbook is not None:
        book = textbook(spec)
        return book.twist(book.target(np.asarray(command, dtype=np.float64)))
    twist = spec.to_cmd_vel(command)
    if spec.steers:
        twist[..., 2] = twist[..., 0] * np.tan(twist[..., 2]) / spec.wheelbase
    return twist
