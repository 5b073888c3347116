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
from nics_drl_bridge.robot.spec import CommandVariable, RobotSpec

Array = NDArray[np.float64]
IMPLAUSIBLE = 10.0
"""A command beyond this multiple of its limit is a fault, and refused."""
LEAST_STEP_S = 1e-3
"""Motions closer in time than this are not published: their derivatives would be noise."""
PERIOD_S = 0.02
"""Period of the gate's ticks [s]. A limit that allows the whole range within one is a typo."""
SNAP = 1e-12
"""A value this close to its target, as a share of the greatest value, has reached it."""
GREATEST = 1e300
"""Numbers are clipped to this before a multiplication: inf times 0 would be NaN."""
STILL = 1e-9
LEAST_MOTION = 0.01
"""If no speed may exceed this, the robot can't be driven [m/s or rad/s]."""
LONGEST_START_S, STARTED = 10.0, 0.01
"""Within the first [s] a command must be able to reach the second (share of its greatest value)."""
SPEED, TURN = "m/s", "rad/s"


class CommandLimit(Schema):
    """Limits of one command, in its unit; an angle's rate is the steering rate.

    Attributes:
        min, max: bounds of its value; zero lies between them.
        rate: greatest change per second, in both directions.
        jerk: greatest change of the rate per second.
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
    """Stopping behaviour, for the shield: distance = v latency + v^2 / (2 deceleration).

    Attributes:
        latency: time from a command until the robot follows it, lags included [s].
        deceleration: of the braking that follows [m/s^2].
        margin: clearance kept around the footprint [m].
        obstacle_speed: at which moving obstacles may approach; 0 treats all as static [m/s].
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
        shield: measured stopping behaviour.
    """

    robot: str
    commands: dict[str, CommandLimit]
    shield: Stopping | None = None


@dataclass(frozen=True)
class Limits:
    """Limits of a robot's commands, in the order of the commands.

    Attributes:
        low, high: (C,) least and greatest value.
        rate: (C,) greatest change per second.
        jerk: (C,) greatest change of the rate per second.
        linear: (C,) True for a speed [m/s].
        turn: (C,) True for a turn rate [rad/s]. The rest are angles.
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
        name: of a shipped file in `config/limits`, or path of a YAML file.
        robot: whose commands are limited.

    Raises:
        ConfigError: a key is missing or unknown; the file is for another robot; a limit exceeds
            what the robot or a period of the gate allows, or would never let the robot move.
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
    for variable in robot.command:
        _check(f"{path}: key 'commands.{variable.name}", file.commands[variable.name], variable)
    each = [file.commands[wanted] for wanted in names]
    units = np.array([variable.unit for variable in robot.command])
    limits = Limits(
        low=np.array([limit.min for limit in each]),
        high=np.array([limit.max for limit in each]),
        rate=np.array([limit.rate for limit in each]),
        jerk=np.array([limit.jerk for limit in each]),
        linear=units == SPEED,
        turn=units == TURN,
    )
    if greatest(limits, limits.linear | limits.turn) < LEAST_MOTION:
        raise ConfigError(
            f"{path}: the robot could never move: none of its speeds and turn rates may reach "
            f"{LEAST_MOTION:g}; raise a `max`."
        )
    return limits


def _check(key: str, limit: CommandLimit, variable: CommandVariable) -> None:
    """Raises ConfigError for limits beyond the robot or a period, or too low for any motion."""
    unit, low, high = variable.unit, min(variable.min, 0.0), max(variable.max, 0.0)
    if limit.min < low:
        raise ConfigError(
            f"{key}.min': {limit.min:g} {unit} is beyond the robot's own limit; "
            f"give at least {low:g}."
        )
    if limit.max > high:
        raise ConfigError(
            f"{key}.max': {limit.max:g} {unit} is beyond the robot's own limit; "
            f"give at most {high:g}."
        )
    span, far = high - low, max(-limit.min, limit.max)
    for name, slope, share, value in (
        ("rate", f"{unit}/s", PERIOD_S, limit.rate),
        ("jerk", f"{unit}/s^2", PERIOD_S**2, limit.jerk),
    ):
        if value > span / share:
            raise ConfigError(
                f"{key}.{name}': {value:g} {slope} crosses the robot's whole range within a period "
                f"of the gate, {PERIOD_S:g} s, and limits nothing; give at most {span / share:g}."
            )
    for name, reach in (
        ("rate", limit.rate * LONGEST_START_S),
        ("jerk", limit.jerk * LONGEST_START_S**2 / 2.0),
    ):
        if reach < STARTED * far:
            raise ConfigError(
                f"{key}.{name}': {getattr(limit, name):g} would never let it move: after "
                f"{LONGEST_START_S:g} s it has come to {reach:.2g} of {far:g} {unit}; raise it."
            )


def greatest(limits: Limits, which: NDArray[np.bool_]) -> float:
    """Returns the greatest magnitude allowed for some commands (C,); 0 if there are none."""
    return float(np.maximum(-limits.low, limits.high)[which].max(initial=0.0))


def implausible(command: Array, limits: Limits) -> bool:
    """True if a command (C,) is so far out of range that it must be a fault."""
    return bool((np.abs(command) / IMPLAUSIBLE > np.maximum(-limits.low, limits.high)).any())


def within(value: Array, limits: Limits) -> bool:
    """True if every value (C,) is a number within its limits."""
    return bool(((value >= limits.low) & (value <= limits.high)).all())  # False for NaN


def saturate(command: Array, limits: Limits) -> Array:
    """Returns the command (C,) within its limits, on the same path.

    Speeds and turn rates are scaled by one common factor, which keeps the curvature of the path
    and the direction of motion. A value whose limit is 0 is dropped.
    """
    speeds, factor = limits.linear | limits.turn, 1.0
    out = np.clip(command, -GREATEST, GREATEST)  # 0 times inf is NaN
    for i, value in enumerate(out):
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

    The turn waits for the speed, so that an accelerating robot is on its path from the start.

    Args:
        value: (C,) last published command.
        slope: (C,) its change per second over the previous interval.
        target: (C,) target within the limits.
        dt: time since the last command [s].
        limits: of the robot.

    Returns:
        The next value (C,) and its slope (C,).
    """
    wanted, after, change = target.copy(), value.copy(), slope.copy()
    for turning in (False, True):
        if turning:
            wanted[limits.turn] *= _progress(after[limits.linear], target[limits.linear])
        for i in np.flatnonzero(limits.turn == turning):
            low, high = float(limits.low[i]), float(limits.high[i])
            after[i], change[i] = _follow_one(
                float(value[i]), float(slope[i]), float(wanted[i]), dt, (low, high),
                float(limits.rate[i]), float(limits.jerk[i]),
            )  # fmt: skip
    return after, change


def _progress(speed: Array, wanted: Array) -> float:
    """Returns the share of the wanted speed that is reached, along its direction, in [0, 1]."""
    most = float(np.abs(wanted).max(initial=0.0))
    if most < STILL:
        return 1.0
    along = wanted / most  # keeps the squares from overflowing
    return min(1.0, max(0.0, float((speed / most) @ along) / float(along @ along)))


def _follow_one(
    value: float,
    slope: float,
    target: float,
    dt: float,
    bounds: tuple[float, float],
    rate: float,
    jerk: float,
) -> tuple[float, float]:
    """Moves one command; see `follow`.

    A slope a can be brought back to zero within a change of a^2 / (2 jerk) whatever the coming
    intervals, because the sum over them lies below the integral. So a value with
    value + a^2 / (2 jerk) within the bounds stays within them.

    The calculation uses shares of the greatest value and steps of this interval. No slope then
    exceeds what one interval can do, the whole range, and no limit causes an overflow.
    """
    scale = max(-bounds[0], bounds[1])
    low, high = bounds[0] / scale, bounds[1] / scale
    here, there = value / scale, target / scale
    step = min(dt / scale, GREATEST)  # per unit of slope
    least, most = -(high - low), high - low
    rate_step, before = min(rate * step, most), min(max(slope * step, least), most)
    jerk_step = min(jerk * dt * step, 2.0 * most)
    wanted = _step_towards(there - here, jerk_step)
    wanted = min(max(wanted, before - jerk_step, -rate_step), before + jerk_step, rate_step)
    wanted = min(wanted, _step_towards(high - here, jerk_step))
    wanted = max(wanted, _step_towards(low - here, jerk_step))
    after = here + wanted
    change = min(max(wanted / step if step > 0.0 else 0.0, -rate), rate)
    if abs(there - after) < SNAP:
        return target, change
    return min(max(after * scale, bounds[0]), bounds[1]), change


def _step_towards(gap: float, jerk: float) -> float:
    """Returns the greatest step a that can still end at a gap: a + a^2 / (2 jerk) = gap."""
    reach = 2.0 * jerk * abs(gap)
    if reach == 0.0:
        return 0.0
    # Not as root minus jerk, which cancels to rounding error for small gaps.
    return math.copysign(reach / (math.sqrt(jerk * jerk + reach) + jerk), gap)
