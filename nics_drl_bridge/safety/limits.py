"""Limits of a command: its value and its first and second derivative."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]
IMPLAUSIBLE = 10.0
"""A command beyond this many times its limit is no wish but a fault, and refused."""
LEAST_STEP_S = 1e-3
"""Motions closer in time than this are not published: their derivatives would be noise."""
SNAP = 1e-12
"""A value this near to its target is there."""
STILL = 1e-9
SPEED, TURN = "m/s", "rad/s"


class CommandLimit(Schema):
    """Limits of one command, in its unit; an angle's rate is the steering rate.

    Attributes:
        min, max: of its value; zero lies between them.
        rate: greatest change per second, in both directions.
        jerk: greatest change of that per second.
    """

    min: float = Field(le=0.0)
    max: float = Field(ge=0.0)
    rate: float = Field(gt=0.0)
    jerk: float = Field(gt=0.0)

    @model_validator(mode="after")
    def _ordered(self) -> CommandLimit:
        if not self.min < self.max:
            raise ValueError("min must be less than max")
        return self


class Stopping(Schema):
    """How the robot stops, for the shield: distance = v latency + v^2 / (2 deceleration).

    Attributes:
        latency: from a command until the robot has taken it up, lags included [s].
        deceleration: with which it then brakes [m/s^2].
        margin: kept free around the footprint [m].
        obstacle_speed: at which what moves may come on; 0 to take everything to stand [m/s].
    """

    latency: float = Field(ge=0.0)
    deceleration: float = Field(gt=0.0)
    margin: float = Field(default=0.05, ge=0.0)
    obstacle_speed: float = Field(default=1.0, ge=0.0)


class LimitsFile(Schema):
    """A file of limits. Only `shield` may be left out; `stopping` then derives it from the model.

    Attributes:
        robot: name of the robot it is for.
        commands: limits by the name of the command in the RobotSpec.
        shield: how the robot stops, measured.
    """

    robot: str
    commands: dict[str, CommandLimit]
    shield: Stopping | None = None


@dataclass(frozen=True)
class Limits:
    """What a robot may be told, in the order of its commands.

    Attributes:
        low, high: (C,) least and greatest value.
        rate: (C,) greatest change per second.
        jerk: (C,) greatest change of that per second.
        linear: (C,) whether it is a speed [m/s].
        turn: (C,) whether it is a turn rate [rad/s]. The rest are angles.
    """

    low: Array
    high: Array
    rate: Array
    jerk: Array
    linear: NDArray[np.bool_]
    turn: NDArray[np.bool_]


def load_limits(name: str | Path, robot: RobotSpec) -> Limits:
    """Reads the limits of a robot.

    Args:
        name: of a shipped file in `config/limits`, or the path of a YAML file.
        robot: whose commands they limit.

    Raises:
        ConfigError: a key is missing, unknown, or belongs to another robot.
    """
    path = find_config(name, "limits")
    file = load_yaml(path, LimitsFile)
    if file.robot != robot.name:
        raise ConfigError(
            f"{path}: key 'robot': the limits are for {file.robot!r}, not for {robot.name!r}; name "
            "the file of this robot."
        )
    names = [variable.name for variable in robot.command]
    for given in file.commands:
        if given not in names:
            raise ConfigError(f"{path}: unknown key 'commands.{given}'; {nearest(given, names)}")
    for wanted in names:
        if wanted not in file.commands:
            raise ConfigError(f"{path}: the key 'commands.{wanted}' is missing; add it.")
    each = [file.commands[wanted] for wanted in names]
    units = np.array([variable.unit for variable in robot.command])
    return Limits(
        low=np.array([limit.min for limit in each]),
        high=np.array([limit.max for limit in each]),
        rate=np.array([limit.rate for limit in each]),
        jerk=np.array([limit.jerk for limit in each]),
        linear=units == SPEED,
        turn=units == TURN,
    )


def implausible(command: Array, limits: Limits) -> bool:
    """Whether a command (C,) is so far out of range that it must be a fault."""
    reach = IMPLAUSIBLE * np.maximum(-limits.low, limits.high)
    return bool((np.abs(command) > reach).any())


def saturate(command: Array, limits: Limits) -> Array:
    """The command (C,) brought within its limits, its path kept.

    Speeds and turn rates shrink by one factor, so that the curvature of the path and the
    direction of the motion stay. What a robot can't do at all (a limit of 0) is dropped.
    """
    speeds, factor = limits.linear | limits.turn, 1.0
    out = command.copy()
    for i, value in enumerate(command):
        bound = limits.high[i] if value > 0.0 else limits.low[i]
        if bound == 0.0:
            out[i] = 0.0
        elif speeds[i] and abs(value) > abs(bound):
            factor = min(factor, bound / value)
    out[speeds] *= factor
    return np.clip(out, limits.low, limits.high)


def follow(
    value: Array, slope: Array, target: Array, dt: float, limits: Limits
) -> tuple[Array, Array]:
    """Moves a command towards its target as fast as rate and jerk allow.

    The turn waits for the speed, so that a robot that speeds up is on its path from the start.

    Args:
        value: (C,) published last.
        slope: (C,) its change per second over the interval before.
        target: (C,) within the limits.
        dt: since the last [s].
        limits: of the robot.

    Returns:
        The next value (C,) and its slope (C,).
    """
    wanted, after, change = target.copy(), value.copy(), slope.copy()
    for turning in (False, True):
        if turning:
            wanted[limits.turn] *= _progress(after[limits.linear], target[limits.linear])
        for i in np.flatnonzero(limits.turn == turning):
            after[i], change[i] = _follow_one(
                float(value[i]), float(slope[i]), float(wanted[i]), dt,
                (float(limits.low[i]), float(limits.high[i])),
                float(limits.rate[i]), float(limits.jerk[i]),
            )  # fmt: skip
    return after, change


def _progress(speed: Array, wanted: Array) -> float:
    """Which part of the wanted speed is reached, along its direction, in [0, 1]."""
    length2 = float(wanted @ wanted)
    if length2 < STILL**2:
        return 1.0
    return min(1.0, max(0.0, float(speed @ wanted) / length2))


def _follow_one(
    value: float,
    slope: float,
    target: float,
    dt: float,
    bounds: tuple[float, float],
    rate: float,
    jerk: float,
) -> tuple[float, float]:
    """One command, see `follow`.

    A slope a can be taken back within a change of a^2 / (2 jerk), whatever the intervals to come:
    the sum over them lies below the integral. So a value with value + a^2 / (2 jerk) within the
    bounds stays within them for ever.
    """
    wanted = _slope_towards(target - value, dt, jerk)
    wanted = min(max(wanted, slope - jerk * dt, -rate), slope + jerk * dt, rate)
    wanted = min(wanted, _slope_towards(bounds[1] - value, dt, jerk))
    wanted = max(wanted, _slope_towards(bounds[0] - value, dt, jerk))
    after = min(max(value + wanted * dt, bounds[0]), bounds[1])
    return (target if abs(target - after) < SNAP else after), wanted


def _slope_towards(gap: float, dt: float, jerk: float) -> float:
    """The greatest slope a over dt that can still end at a gap: a dt + a^2 / (2 jerk) = gap."""
    step, reach = jerk * dt, 2.0 * jerk * abs(gap)
    # Not the difference of root and step, which for small gaps would be mere rounding.
    return math.copysign(reach / (math.sqrt(step * step + reach) + step), gap)
