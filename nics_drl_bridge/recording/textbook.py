"""Textbook kinematics of the three wheeled robots, the source of synthetic recordings.

Siegwart, Nourbakhsh, Scaramuzza: Introduction to Autonomous Mobile Robots, ch. 3; the paper's
reference for Table I. The actuators are first-order lags or rate-limited.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import POSE_RATES, CmdVelField, RobotSpec, require_textbook

Array = NDArray[np.float64]
INTEGRATION_STEP_S = 1e-3


@dataclass(frozen=True)
class Textbook:
    """Kinematics of a type of robot.

    Attributes:
        twist: gives the body twist (..., 3) for a state (..., S).
        target: gives the state (..., S) that a command (..., C) requests.
        lag: (S,) time constants of first-order actuators [s]; unused for rate-limited ones.
        rate: (S,) greatest rates of the state of rate-limited actuators [its unit/s]; inf for
            first-order ones.
        structure: possible products of state variables in each degree of freedom of the twist.
    """

    twist: Callable[[Array], Array]
    target: Callable[[Array], Array]
    lag: Array
    rate: Array
    structure: dict[str, tuple[str, ...]]

    def respond(self, state: Array, goal: Array, t: Array | float) -> Array:
        """Returns the exact state (..., S) at time t [s] on its way from `state` to `goal`."""
        gap = state - goal
        ramp = np.sign(gap) * np.maximum(np.abs(gap) - np.where(self.limited, self.rate, 0) * t, 0)
        return goal + np.where(self.limited, ramp, gap * np.exp(-t / self.lag))

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Mask (S,) of the rate-limited actuators."""
        return np.isfinite(self.rate)


def textbook(spec: RobotSpec) -> Textbook:
    """Returns the textbook kinematics of a robot, with the parameters of its spec.

    Commands are identified by their field of `cmd_vel`, speed and steering of a car by their
    units. The order of wheels is left, right; or front left, front right, rear left, rear right.
    An actuator is of first order (`wheel_lag`, `speed_lag`, `steering_lag` [s]) or rate-limited
    (`wheel_rate`, `speed_rate`, `steering_rate` [its unit/s]).

    Raises:
        ConfigError: the spec names none, lacks a parameter, or has other variables.
    """
    kind = require_textbook(spec)
    try:
        return _BUILDERS[kind](spec)
    except KeyError as error:
        raise ConfigError(
            f"robot {spec.name!r}: the {kind} kinematics need the parameter {error}; add it under "
            "`parameters:`."
        ) from None


def _ackermann(spec: RobotSpec) -> Textbook:
    p, (v, phi) = spec.parameters, _states(spec, ("m/s", "rad"))
    wheelbase, command = p["wheelbase"], _commands(spec, ("linear.x", "angular.z"))

    def twist(state: Array) -> Array:
        speed, steering = state[..., v], state[..., phi]
        turn = speed * np.tan(steering) / wheelbase
        return np.stack([speed, np.zeros_like(speed), turn], axis=-1)

    order = np.argsort([v, phi])
    names = [spec.state[i].name for i in (v, phi)]
    lag, rate = _actuators(p, ("speed", "steering"))
    return Textbook(
        twist=twist,
        target=lambda given: given[..., command][..., order],
        lag=lag[order],
        rate=rate[order],
        structure={"vx": (names[0],), "vy": (), "wz": ("*".join(names),)},
    )


def _differential(spec: RobotSpec) -> Textbook:
    p = spec.parameters
    inverse = np.array([[1, -p["track"] / 2], [1, p["track"] / 2]]) / p["wheel_radius"]
    forward = np.zeros((3, 2))
    forward[[0, 2]] = np.linalg.inv(inverse)
    return _wheeled(spec, inverse, forward, ("linear.x", "angular.z"), ("vx", "wz"))


def _mecanum(spec: RobotSpec) -> Textbook:
    p = spec.parameters
    arm = p["half_length"] + p["half_width"]
    inverse = np.array([[1, -1, -arm], [1, 1, arm], [1, 1, -arm], [1, -1, arm]]) / p["wheel_radius"]
    fields: tuple[CmdVelField, ...] = ("linear.x", "linear.y", "angular.z")
    forward = np.asarray(np.linalg.pinv(inverse), dtype=np.float64)
    return _wheeled(spec, inverse, forward, fields, POSE_RATES)


def _wheeled(
    spec: RobotSpec,
    inverse: Array,
    forward: Array,
    fields: tuple[CmdVelField, ...],
    moves: tuple[str, ...],
) -> Textbook:
    """Builds the kinematics of a robot whose twist is linear in its wheel speeds.

    Args:
        spec: the robot.
        inverse: (S, C) wheel speeds per command, in the order of `fields`.
        forward: (3, S) body twist per wheel speed.
        fields: of `cmd_vel`.
        moves: the degrees of freedom that the wheels can move.
    """
    if len(spec.state) != len(inverse):
        raise ConfigError(
            f"robot {spec.name!r}: the {spec.textbook} kinematics have {len(inverse)} wheels as "
            f"state, not {len(spec.state)} variables; correct `state:`."
        )
    command = _commands(spec, fields)
    names = tuple(v.name for v in spec.state)
    lag, rate = _actuators(spec.parameters, ("wheel",) * len(inverse))
    return Textbook(
        twist=lambda state: state @ forward.T,
        target=lambda given: given[..., command] @ inverse.T,
        lag=lag,
        rate=rate,
        structure={dof: names if dof in moves else () for dof in POSE_RATES},
    )


def _commands(spec: RobotSpec, fields: tuple[CmdVelField, ...]) -> list[int]:
    """Returns the indices of the commands for fields of `cmd_vel`; in order if they name none."""
    have = [c.cmd_vel for c in spec.command]
    if not any(have):
        return list(range(len(have)))
    missing = [field for field in fields if field not in have]
    if missing:
        raise ConfigError(
            f"robot {spec.name!r}: the {spec.textbook} kinematics need a command with "
            f"`cmd_vel: {missing[0]}`; add it."
        )
    return [have.index(field) for field in fields]


def _states(spec: RobotSpec, units: tuple[str, ...]) -> list[int]:
    """Returns the indices of the state variables with the given units."""
    have = [v.unit for v in spec.state]
    if sorted(have) != sorted(units):
        raise ConfigError(
            f"robot {spec.name!r}: the {spec.textbook} kinematics need a state in "
            f"{' and '.join(units)}, not in {', '.join(have) or 'nothing'}; correct `state:`."
        )
    return [have.index(unit) for unit in units]


def _actuators(p: dict[str, float], parts: tuple[str, ...]) -> tuple[Array, Array]:
    """Returns time constants and greatest rates (S,) of actuators, by parameter names."""
    rate = np.array([p.get(f"{part}_rate", np.inf) for part in parts])
    lag = [p[f"{part}_lag"] if f"{part}_rate" not in p else 1.0 for part in parts]
    return np.array(lag), rate


_BUILDERS: dict[str, Callable[[RobotSpec], Textbook]] = {
    "ackermann": _ackermann,
    "differential": _differential,
    "mecanum": _mecanum,
}


def integrate(
    book: Textbook, pose: Array, state: Array, command: Array, dt: float
) -> tuple[Array, Array]:
    """Moves robots for `dt` under a constant command.

    The state is exact. The pose follows arcs of at most 1 ms by the Magnus expansion of fourth
    order (Iserles, Norsett 1999), whose error is below 1e-11 m even over seconds.

    Args:
        book: the kinematics.
        pose: (..., 3).
        state: (..., S).
        command: (..., C).
        dt: duration [s].

    Returns:
        Pose (..., 3) and state (..., S) after `dt`.
    """
    steps = max(1, int(np.ceil(dt / INTEGRATION_STEP_S - 1e-9)))
    h, goal = dt / steps, book.target(command)
    for k in range(steps):
        pose = geometry.compose(pose, geometry.exp(_arc(book, state, goal, k * h, h)))
    return pose, book.respond(state, goal, dt)


def _arc(book: Textbook, state: Array, goal: Array, since: Array | float, h: float) -> Array:
    """Returns body twist x duration (..., 3) of a substep that begins `since` [s] after `state`."""
    early, late = (
        book.twist(book.respond(state, goal, since + (0.5 + sign * np.sqrt(3.0) / 6.0) * h))
        for sign in (-1.0, 1.0)
    )
    wa, wb = early[..., 2], late[..., 2]
    bracket = np.stack(
        [
            wb * early[..., 1] - wa * late[..., 1],
            wa * late[..., 0] - wb * early[..., 0],
            np.zeros_like(wa),
        ],
        axis=-1,
    )
    return np.asarray((early + late) * (h / 2.0) + bracket * (np.sqrt(3.0) / 12.0 * h * h))


def record(
    spec: RobotSpec,
    rng: np.random.Generator,
    duration: float = 60.0,
    dt: float = 0.01,
    hold: float = 0.5,
) -> Recording:
    """Drives a textbook robot with random commands and records it.

    Args:
        spec: the robot.
        rng: draws the commands, uniform within their limits, every `hold` seconds.
        duration: of the drive [s].
        dt: sample period [s].
        hold: time for which each command is held [s].

    Returns:
        Command, pose and state on one clock, without noise.
    """
    book = textbook(spec)
    inner = max(1, int(np.ceil(dt / INTEGRATION_STEP_S - 1e-9)))
    h, per_hold = dt / inner, round(hold / dt)
    holds = int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    state, arcs = _follow(book, held, per_hold * inner, h)
    pose = _chain(geometry.exp(arcs))
    t = np.asarray(np.arange(holds * per_hold) * dt, dtype=np.float64)
    return Recording(
        Stream(t, np.repeat(held, per_hold, axis=0)),
        Stream(t, pose[::inner]),
        Stream(t, state[::inner]),
        source=f"textbook {spec.name}",
        variables=spec.variable_names,
    )


def _follow(book: Textbook, held: Array, steps: int, h: float) -> tuple[Array, Array]:
    """Returns the states at the start of each of `steps` substeps per command, and their arcs."""
    since = np.asarray(np.arange(steps)[:, None] * h, dtype=np.float64)
    state = np.zeros(len(book.lag))
    states, arcs = [], []
    for goal in book.target(held):
        states.append(book.respond(state, goal, since))
        arcs.append(_arc(book, state, goal, since, h))
        state = book.respond(state, goal, steps * h)
    return np.concatenate(states), np.concatenate(arcs)


def _chain(relative: Array) -> Array:
    """Chains relative poses (T, 3) to the poses (T, 3) at their starts, from the origin on."""
    heading = np.concatenate([[0.0], np.cumsum(relative[:-1, 2])])
    moved = geometry.rotate(relative[:, :2], heading)
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(moved[:-1], axis=0)])
    return np.concatenate([position, geometry.wrap_angle(heading)[:, None]], axis=1)
