"""Textbook kinematics of the three wheeled robots, the source of synthetic recordings.

Siegwart, Nourbakhsh, Scaramuzza: Introduction to Autonomous Mobile Robots, ch. 3; the
paper's reference for Table I. The actuators are first-order lags, solved exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kinematics.recording import Recording, Stream
from nics_drl_bridge.kinematics.spec import RobotSpec, require_textbook

Array = NDArray[np.float64]
INTEGRATION_STEP_S = 1e-3


@dataclass(frozen=True)
class Textbook:
    """The kinematics of a kind of robot.

    Attributes:
        twist: body twist (..., 3) of a state (..., S).
        target: the state (..., S) that a command (..., C) asks for.
        lag: (S,) time constants with which the state follows [s].
        structure: for each degree of freedom of the twist, the products of state variables
            that can occur in it.
    """

    twist: Callable[[Array], Array]
    target: Callable[[Array], Array]
    lag: Array
    structure: dict[str, tuple[str, ...]]


def textbook(spec: RobotSpec) -> Textbook:
    """The textbook kinematics of a robot, with the parameters of its spec.

    Raises:
        ConfigError: the spec names none, or lacks a parameter.
    """
    kind = require_textbook(spec)
    try:
        return _BUILDERS[kind](spec.parameters)
    except KeyError as error:
        raise ConfigError(
            f"robot {spec.name!r}: the {kind} kinematics need the parameter {error}; add it under "
            "`parameters:`."
        ) from None


def _ackermann(p: dict[str, float]) -> Textbook:
    wheelbase = p["wheelbase"]

    def twist(state: Array) -> Array:
        speed, steering = state[..., 0], state[..., 1]
        return np.stack(
            [speed, np.zeros_like(speed), speed * np.tan(steering) / wheelbase], axis=-1
        )

    return Textbook(
        twist=twist,
        target=lambda command: command,
        lag=np.array([p["speed_lag"], p["steering_lag"]]),
        structure={"vx": ("speed",), "vy": (), "wz": ("speed*steering",)},
    )


def _differential(p: dict[str, float]) -> Textbook:
    r, track = p["wheel_radius"], p["track"]

    def twist(state: Array) -> Array:
        left, right = state[..., 0], state[..., 1]
        return np.stack(
            [r * (left + right) / 2, np.zeros_like(left), r * (right - left) / track], -1
        )

    def target(command: Array) -> Array:
        v, w = command[..., 0], command[..., 1]
        return np.stack([(v - w * track / 2) / r, (v + w * track / 2) / r], axis=-1)

    wheels = ("left_wheel", "right_wheel")
    return Textbook(
        twist, target, np.full(2, p["wheel_lag"]), {"vx": wheels, "vy": (), "wz": wheels}
    )


def _mecanum(p: dict[str, float]) -> Textbook:
    r, arm = p["wheel_radius"], p["half_length"] + p["half_width"]
    # Columns: vx, vy, wz. Rows: front left, front right, rear left, rear right.
    inverse = np.array([[1, -1, -arm], [1, 1, arm], [1, 1, -arm], [1, -1, arm]]) / r
    forward = np.linalg.pinv(inverse)
    wheels = tuple(
        f"{place}_wheel" for place in ("front_left", "front_right", "rear_left", "rear_right")
    )
    return Textbook(
        twist=lambda state: state @ forward.T,
        target=lambda command: command @ inverse.T,
        lag=np.full(4, p["wheel_lag"]),
        structure={"vx": wheels, "vy": wheels, "wz": wheels},
    )


_BUILDERS: dict[str, Callable[[dict[str, float]], Textbook]] = {
    "ackermann": _ackermann,
    "differential": _differential,
    "mecanum": _mecanum,
}


def integrate(
    book: Textbook, pose: Array, state: Array, command: Array, dt: float
) -> tuple[Array, Array]:
    """Moves robots for `dt` under a constant command.

    The state's lag is exact; the pose follows arcs of at most 1 ms.

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
    h = dt / steps
    goal = book.target(command)
    decay, half = np.exp(-h / book.lag), np.exp(-h / 2 / book.lag)
    for _ in range(steps):
        middle = goal + (state - goal) * half
        pose = geometry.compose(pose, geometry.exp(book.twist(middle) * h))
        state = goal + (state - goal) * decay
    return pose, state


def record(
    spec: RobotSpec,
    rng: np.random.Generator,
    duration: float = 60.0,
    dt: float = 0.01,
    hold: float = 0.5,
) -> Recording:
    """Drives a textbook robot at random and records it.

    Args:
        spec: the robot.
        rng: draws the commands, uniform within their limits, anew every `hold` seconds.
        duration: of the drive [s].
        dt: sample period [s].
        hold: how long a command is held [s].

    Returns:
        Command, pose and state on one clock, without noise.
    """
    book = textbook(spec)
    inner = max(1, int(np.ceil(dt / INTEGRATION_STEP_S - 1e-9)))
    h, per_hold = dt / inner, round(hold / dt)
    holds = int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    state, middle = _follow(book, held, per_hold * inner, h)
    pose = _chain(geometry.exp(book.twist(middle) * h))
    t = np.asarray(np.arange(holds * per_hold) * dt, dtype=np.float64)
    return Recording(
        Stream(t, np.repeat(held, per_hold, axis=0)),
        Stream(t, pose[::inner]),
        Stream(t, state[::inner]),
        source=f"textbook {spec.name}",
        variables=spec.variable_names,
    )


def _follow(book: Textbook, held: Array, steps: int, h: float) -> tuple[Array, Array]:
    """States at the start and in the middle of each of `steps` substeps per held command."""
    since = np.arange(steps)[:, None] * h
    decay, decay_middle = np.exp(-since / book.lag), np.exp(-(since + h / 2) / book.lag)
    state = np.zeros(len(book.lag))
    starts, middles = [], []
    for goal in book.target(held):
        starts.append(goal + (state - goal) * decay)
        middles.append(goal + (state - goal) * decay_middle)
        state = goal + (state - goal) * np.exp(-steps * h / book.lag)
    return np.concatenate(starts), np.concatenate(middles)


def _chain(relative: Array) -> Array:
    """The poses (T, 3), from the origin on, that relative poses (T, 3) lead through."""
    heading = np.concatenate([[0.0], np.cumsum(relative[:-1, 2])])
    moved = geometry.rotate(relative[:, :2], heading)
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(moved[:-1], axis=0)])
    return np.concatenate([position, geometry.wrap_angle(heading)[:, None]], axis=1)
