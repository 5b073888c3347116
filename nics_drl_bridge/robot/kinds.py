"""Kinds of robots: textbook kinematics and a drawing for each; `spec` finds them by name.

Commands are identified by their field of `cmd_vel`, without any by their name, else by their place;
speed and steering angle in the state by their units. An actuator is of first order (parameters
`wheel_lag`, `speed_lag`, `steering_lag` [s]) or rate-limited (`wheel_rate`, `speed_rate`,
`steering_rate` [its unit/s]). Siegwart, Nourbakhsh, Scaramuzza: Introduction to Autonomous Mobile
Robots, ch. 3; the paper's reference for Table I.
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
    kind_names,
)
from nics_drl_bridge.robot.template import Template

BEYOND = 0.01  # share of a limit by which rounded figures may lie beyond it
# least likeness of a misspelt parameter; other parameters' are less alike
MISSPELT = 0.8
MOST_VARIED = 6
AT_ONCE_S = 1e-9  # lag of a robot whose commands are what its wheels do
T = TypeVar("T")


@dataclass(frozen=True)
class Textbook:
    """Textbook kinematics of a robot."""

    twist: Callable[
        [Array], Array
    ]  # gives the body twist (..., 3) for a state (..., S)
    target: Callable[
        [Array], Array
    ]  # gives the state (..., S) that a command (..., C) requests
    lag: Array  # (S,) time constants of first-order actuators [s]
    rate: Array  # (S,) of rate-limited actuators [its unit/s]; inf for first-order ones
    structure: dict[
        str, tuple[str, ...]
    ]  # possible products of states, by component of the twist
    # gives the command (..., C), maybe out of range, that leads to a twist (..., 3), if known
    command: Callable[[Array], Array] | None = None

    def compute_twist(self, command: Array) -> Array:
        """Returns the body twist (..., 3) to which commands (..., C) lead when they are held."""
        return self.twist(self.target(command))

    def respond(self, state: Array, goal: Array, t: Array | float) -> Array:
        """Returns the exact state (..., S) at time t [s] on its way from `state` to `goal`."""
        gap = state - goal
        ramp = np.sign(gap) * np.maximum(
            np.abs(gap) - np.where(self.limited, self.rate, 0) * t, 0
        )
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


def disc(spec: RobotSpec) -> Drawing:
    """The looks of a robot of which no more is known."""
    return Drawing(spec.footprint_radius, (0.0, 0.02), ())


def place_wheels(
    spec: RobotSpec,
    places: Sequence[tuple[float, float]],
    radius: float,
    names: tuple[str, ...],
) -> tuple[Wheel, ...]:
    """Returns wheels at places; those of a state of as many wheels turn by its variables."""
    if turns := bool(spec.state) and all(
        v.unit == "rad/s" and v.twist is None for v in spec.state
    ):
        names = tuple(v.name for v in spec.state)
    both = zip(names, places, strict=True)
    return tuple(Wheel(name, place, radius, turns=turns) for name, place in both)


def places_of_four(parameters: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Returns x, y in `base_link` [m] of a robot's four wheels by name; KeyError without lengths.

    They stand at `half_length` and `half_width`, each half a `track` where it is not given.
    """
    x, y = (
        parameters[k] if k in parameters else 0.5 * parameters["track"]
        for k in ("half_length", "half_width")
    )
    return {
        f"{end}_{side}": (s * x, t * y)
        for end, s in (("front", 1.0), ("rear", -1.0))
        for side, t in (("left", 1.0), ("right", -1.0))
    }


@dataclass(frozen=True)
class RobotKind:
    """A kind of robot. Its functions raise KeyError for a parameter that the spec lacks."""

    kinematics: (
        Callable[[RobotSpec], Textbook] | None
    )  # of its actuators; None: not known
    drawing: Callable[[RobotSpec], Drawing]
    template: Template = field(default_factory=Template)
    # True if it is driven sideways by commands other than a twist's
    sideways: bool = False
    slips: bool = False  # True if it moves otherwise than the twist that is commanded
    front_drive: bool = False  # True if the speed is that of the steered wheel


def textbook(spec: RobotSpec) -> Textbook:
    """Returns a robot's textbook kinematics; ConfigError if its spec names none or does not fit."""
    book = actuated(spec)
    if spec.state and all(v.twist is not None for v in spec.state):
        return _through_lags(spec, book)
    if not spec.state and not _made(
        spec, lambda kind: kind.template.moves or kind.template.state
    ):
        return replace(book, lag=np.full(len(book.lag), AT_ONCE_S))
    if len(spec.state) != len(book.lag):
        have = ", ".join(v.name for v in spec.state) or "none"
        needed = (
            f"the {spec.textbook} kinematics need a state of {len(book.lag)} actuators"
        )
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
    return getattr(find_kind(spec.textbook or ""), "kinematics", None) is not None


def _through_lags(spec: RobotSpec, book: Textbook) -> Textbook:
    """Returns the kinematics of a robot whose state is its twist, behind lags of its actuators."""
    # Speeds take the lag of the first actuator, the turn rate that of the last, as of a steering.
    dofs = [POSE_RATES.index(v.twist) for v in spec.state if v.twist is not None]
    if book.limited.any():
        fault = "a rate limit of an actuator needs the actuators as state"
        raise ConfigError(
            f"robot {spec.name!r}: {fault}; give lags, or correct `state:`."
        )
    named = zip(
        spec.state,
        [float(book.lag[-1 if dof == 2 else 0]) for dof in dofs],
        strict=True,
    )
    lag = np.array([spec.parameters.get(f"{v.name}_lag", one) for v, one in named])

    def twist(state: Array) -> Array:
        whole = np.zeros((*state.shape[:-1], 3))
        whole[..., dofs] = state
        return whole

    names: dict[str, tuple[str, ...]] = dict.fromkeys(POSE_RATES, ())
    names |= {str(v.twist): (v.name,) for v in spec.state}
    target = lambda command: book.compute_twist(command)[..., dofs]  # noqa: E731
    return Textbook(twist, target, lag, np.full(len(lag), np.inf), names, book.command)


def drawing(spec: RobotSpec) -> Drawing:
    """Returns the looks of a robot. Raises ConfigError as `textbook` does."""
    return _made(spec, lambda kind: kind.drawing(spec))


def _made(spec: RobotSpec, make: Callable[[RobotKind], T]) -> T:
    robot = f"robot {spec.name!r}"
    kind = find_kind(require_textbook(spec))
    if kind is None:
        known = ", ".join(kind_names())
        raise ConfigError(
            f"{robot}: `textbook:` must be one of {known}, not {spec.textbook!r}."
        )
    try:
        return make(kind)
    except KeyError as error:
        needed = f"the {spec.textbook} kinematics need the parameter {error}"
        usual = {
            *kind.template.parameters,
            *kind.template.lengths,
        }  # no slips of the pen
        own = [name for name in spec.parameters if name not in usual]
        near = difflib.get_close_matches(str(error.args[0]), own, n=1, cutoff=MISSPELT)
        fix = f"is {near[0]!r} it?" if near else "add it under `parameters:`."
        raise ConfigError(f"{robot}: {needed}; {fix}") from None


def require_textbook(spec: RobotSpec) -> str:
    """Returns the name of a robot's kind. Raises ConfigError if it names none."""
    if spec.textbook is None:
        fix = "add `textbook:` to its YAML file or give a recording."
        raise ConfigError(f"robot {spec.name!r} names no textbook kinematics; {fix}")
    return spec.textbook


def compute_steady_twist(spec: RobotSpec, command: ArrayLike) -> Array:
    """Returns the body twist (..., 3) to which commands (..., C) lead when they are held.

    Raises ConfigError if neither kinematics nor wheelbase of a robot are known that needs them.
    """
    if is_twist_commanded(spec):
        return spec.to_cmd_vel(command)
    if spec.textbook is None and spec.steers:
        return _by_turn_rate(spec).to_cmd_vel(command)
    return actuated(spec).compute_twist(np.asarray(command, dtype=np.float64))


def find_command(spec: RobotSpec, twist: ArrayLike) -> Array:
    """Returns the command (..., C) within its limits that leads to a body twist (..., 3), if any.

    A car that is to turn on the spot stands. Raises ConfigError as `steady_twist`.
    """
    twist = np.asarray(twist, dtype=np.float64)
    if is_twist_commanded(spec):
        command = spec.from_cmd_vel(twist)
    elif spec.textbook is None and spec.steers:
        command = _by_turn_rate(spec).from_cmd_vel(twist)
    else:
        book = actuated(spec)
        if book.command is None:
            fault = f"which command leads to a twist is not known of a {spec.textbook}"
            raise ConfigError(
                f"robot {spec.name!r}: {fault}; use continuous actions, no planner."
            )
        command = book.command(twist)
    return np.clip(command, spec.command_low, spec.command_high)


def reach(spec: RobotSpec) -> Array:
    """Returns the greatest steady twist (3,) of a robot's commands; ConfigError: see there."""
    return np.asarray(np.abs(compute_steady_twist(spec, _corners(spec))).max(axis=0))


def _corners(spec: RobotSpec) -> Array:
    """All combinations (K, C) of least, nearest to zero, and greatest commands."""
    ends = np.stack([spec.command_low, np.zeros(len(spec.command)), spec.command_high])
    ends[1] = np.clip(ends[1], ends[0], ends[2])
    # No kind uses more; if there are more, they are not varied one by one.
    return np.array(list(product(*ends.T))) if ends.shape[1] <= MOST_VARIED else ends


def describe_overdrive(spec: RobotSpec) -> str | None:
    """A sentence if a robot's commands ask for more than a wheel's or a steering's own limit."""
    if not (has_textbook(spec) and spec.state and _own_state(spec)):
        return None
    asked = textbook(spec).target(_corners(spec))
    for values, one in zip(asked.T, spec.state, strict=True):
        worst = float(values[np.abs(values).argmax()])
        if (
            not one.min - BEYOND * abs(one.min)
            <= worst
            <= one.max + BEYOND * abs(one.max)
        ):
            limits = f"beyond its limits {one.min:g} and {one.max:g}"
            fix = "narrow the commands, or widen the limits of the state"
            return f"the commands ask for {one.name} at {worst:.3g} {one.unit}, {limits}; {fix}."
    return None


def _by_turn_rate(spec: RobotSpec) -> RobotSpec:
    return spec.model_copy(update={"angular_is": "turn_rate"})


def is_twist_commanded(spec: RobotSpec) -> bool:
    """True if a robot's commands are the components of its body twist, but for their lags."""
    return all(command.is_twist for command in spec.command) and not slips(spec)


def slips(spec: RobotSpec) -> bool:
    """True if a robot's kind moves otherwise than the twist that is commanded."""
    return bool(getattr(find_kind(spec.textbook or ""), "slips", False))


def steered(
    spec: RobotSpec,
    geometry: Bicycle,
    names: tuple[str, ...],
    gain: tuple[float, float] = (1, 1),
) -> Textbook:
    """Builds the kinematics of a robot that is driven by a speed and a steering angle.

    Both are its actuators, and the `gain` times its commands, in any order; its turn rate is, to
    second order, a multiple of their product. `names` are usual ones of the commands.
    """
    v, phi = _states(spec)
    command = _commands(spec, ("linear.x", "angular.z"), names, 2)
    order = np.argsort([v, phi])
    speed, angle = (
        spec.state[i].name if _own_state(spec) else names[i] for i in (v, phi)
    )
    lag, rate = _actuators(spec.parameters, ("speed", "steering"))
    return Textbook(
        twist=lambda state: geometry.twist(state[..., v], state[..., phi]),
        target=lambda given: (given[..., command] * gain)[..., order],
        lag=lag[order],
        rate=rate[order],
        structure={"vx": (speed,), "vy": (), "wz": (f"{speed}*{angle}",)},
        command=lambda twist: _placed(
            spec, command, np.stack(geometry.command(twist), axis=-1) / gain
        ),
    )


def steering_angle(spec: RobotSpec) -> StateVariable | None:
    """Returns the state variable of the steering angle of a robot that is `steered`, if any."""
    return spec.state[_states(spec)[1]] if _own_state(spec) else None


def wheeled(
    spec: RobotSpec,
    inverse: Array,
    forward: Array,
    moves: tuple[str, ...],
    wheels: tuple[str, ...],
    slip: float = 1.0,
) -> Textbook:
    """Builds the kinematics of a robot whose twist is linear in its wheel speeds, its actuators.

    `inverse` (W, M) gives wheel speeds per component of the twist that the wheels can move, by name
    in `moves`; `forward` (3, W) the body twist per wheel speed, whose turn rate slips by a factor.
    It is commanded by its twist, else by its wheel speeds, with the usual names `wheels`.
    """
    if _own_state(spec) and len(spec.state) != len(inverse):
        needed = f"have {len(inverse)} wheels as state, not {len(spec.state)} variables"
        raise _unfit(spec, f"{needed}; correct `state:`.")
    dofs = [POSE_RATES.index(dof) for dof in moves]
    fields = tuple(specs.CMD_VEL_FIELDS[dof] for dof in dofs)
    by_wheels = all(c.unit == "rad/s" and c.cmd_vel is None for c in spec.command)
    into = np.eye(len(inverse)) if by_wheels else inverse
    command = _commands(spec, fields, wheels if by_wheels else (), into.shape[1])
    undone = inverse if by_wheels else np.eye(len(dofs))
    slipping = np.array([1.0, 1.0, slip])
    out = forward * slipping[:, None]
    names = tuple(v.name for v in spec.state) if _own_state(spec) else wheels
    lag, rate = _actuators(spec.parameters, ("wheel",) * len(inverse))
    return Textbook(
        twist=lambda state: state @ out.T,
        target=lambda given: given[..., command] @ into.T,
        lag=lag,
        rate=rate,
        structure={dof: names if dof in moves else () for dof in POSE_RATES},
        command=lambda twist: _placed(
            spec, command, (twist / slipping)[..., dofs] @ undone.T
        ),
    )


def _own_state(spec: RobotSpec) -> bool:
    """True if the state consists of actuators."""
    return any(v.twist is None for v in spec.state)


def _commands(
    spec: RobotSpec,
    fields: tuple[specs.CmdVelField, ...],
    names: tuple[str, ...],
    count: int,
) -> list[int]:
    have = [c.cmd_vel for c in spec.command]
    if not any(have):
        if len(have) != count:
            raise _unfit(
                spec, f"need {count} commands, not {len(have)}; correct `command:`."
            )
        called = [c.name for c in spec.command]
        if names and set(names) == set(called):
            return [called.index(name) for name in names]
        return list(range(len(have)))
    for one in fields:
        if one not in have:
            raise _unfit(spec, f"need a command with `cmd_vel: {one}`; add it.")
    return [have.index(field) for field in fields]


def _placed(spec: RobotSpec, places: list[int], values: Array) -> Array:
    """Returns commands (..., C) with values at places, else 0."""
    command = np.zeros((*values.shape[:-1], len(spec.command)))
    command[..., places] = values
    return command


def _unfit(spec: RobotSpec, reason: str) -> ConfigError:
    return ConfigError(f"robot {spec.name!r}: the {spec.textbook} kinematics {reason}")


def _states(spec: RobotSpec) -> tuple[int, int]:
    if not _own_state(spec):
        return 0, 1
    have = [v.unit for v in spec.state]
    if sorted(have) != ["m/s", "rad"]:
        given = ", ".join(have) or "nothing"
        raise _unfit(
            spec, f"need a state in m/s and rad, not in {given}; correct `state:`."
        )
    return have.index("m/s"), have.index("rad")


def _actuators(p: dict[str, float], parts: tuple[str, ...]) -> tuple[Array, Array]:
    rate = np.array([p.get(f"{part}_rate", np.inf) for part in parts])
    lag = [p[f"{part}_lag"] if f"{part}_rate" not in p else 1.0 for part in parts]
    return np.array(lag), rate
