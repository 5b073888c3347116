"""Limits of a command: its value and its first and second derivative."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.spec import CommandVariable, RobotSpec

# a command beyond this multiple of its limit is a fault, and refused
IMPLAUSIBLE = 10.0
# motions closer in time are not published: their derivatives would be noise
LEAST_STEP_S = 1e-3
PERIOD_S = 0.02  # of the gate's ticks [s]; a limit that allows the whole range within one is a typo
SNAP = 1e-12  # a value this close to its target, as a share of the greatest value, has reached it
GREATEST = 1e300  # numbers are clipped to this before a multiplication: inf times 0 would be NaN
STILL = 1e-9
LEAST_NORMAL = float(
    np.finfo(np.float64).tiny
)  # numbers nearer to zero lose digits: denormal
# if no speed may exceed this, the robot can't be driven [m/s or rad/s]
LEAST_MOTION = 0.01
LONGEST_START_S, STARTED = 10.0, 0.01
"""Within the first [s] a command must be able to reach the second (share of its greatest value)."""
SPEED = "m/s"
TURN = "rad/s"
# greatest turn rate of a robot that is commanded by steering angle [rad/s]
CAR_TURN = 4.0


class CommandLimit(Schema):
    """Limits of one command, in its unit; an angle's rate is the steering rate."""

    min: float = Field(le=0.0)  # least value that the gate lets pass
    max: float = Field(ge=0.0)  # greatest value that the gate lets pass
    rate: float = Field(gt=0.0)  # greatest change per second, in both directions
    jerk: float = Field(gt=0.0)  # greatest change of the rate per second

    @model_validator(mode="after")
    def _ordered(self) -> "CommandLimit":
        if not self.min < self.max:
            raise ValueError("min must be less than max")
        return self


class Stopping(Schema):
    """Stopping behaviour, for the shield: distance = v latency + v^2 / (2 deceleration)."""

    latency: float = Field(
        ge=0.0
    )  # from a command until the robot follows it, with lags [s]
    deceleration: float = Field(gt=0.0)  # of the braking that follows [m/s^2]
    margin: float = Field(
        default=0.05, ge=0.0
    )  # clearance kept around the footprint [m]
    obstacle_speed: float = Field(
        default=1.0, ge=0.0
    )  # of approaching ones; 0: static [m/s]


class LimitsFile(Schema):
    """A file of limits. Only `shield` may be left out; it is then derived from the model."""

    robot: str  # name of the robot it is for
    commands: dict[str, CommandLimit]  # by the name of the command in the RobotSpec
    shield: Stopping | None = None  # measured


@dataclass(frozen=True)
class Limits:
    """Limits of a robot's commands (C,), in the order of the commands; see `CommandLimit`."""

    low: Array
    high: Array
    rate: Array
    jerk: Array
    linear: NDArray[np.bool_]  # True for a speed [m/s]
    turn: NDArray[np.bool_]  # True for a turn rate [rad/s]; the rest are angles


def load_limits(name: str | Path, robot: RobotSpec) -> Limits:
    """Reads limits, shipped or of a YAML file; ConfigError names the key that can't be used."""
    path = find_config(name, "limits")
    file = load_yaml(path, LimitsFile)
    if file.robot != robot.name:
        other = f"the limits are for {file.robot!r}, not for {robot.name!r}"
        raise ConfigError(f"{path}: key 'robot': {other}; name the file of this robot.")
    names = [variable.name for variable in robot.command]
    for given in file.commands:
        if given not in names:
            raise ConfigError(
                f"{path}: unknown key 'commands.{given}'; {suggest(given, names)}"
            )
    for variable in robot.command:
        if variable.name not in file.commands:
            raise ConfigError(
                f"{path}: the key 'commands.{variable.name}' is missing; add it."
            )
        _check(
            f"{path}: key 'commands.{variable.name}",
            file.commands[variable.name],
            variable,
        )
    low, high, rate, jerk = (
        np.array([getattr(file.commands[each], bound) for each in names])
        for bound in ("min", "max", "rate", "jerk")
    )
    units = np.array([variable.unit for variable in robot.command])
    limits = Limits(low, high, rate, jerk, linear=units == SPEED, turn=units == TURN)
    speeds = limits.linear | limits.turn
    if (speeds.any() or robot.takes_cmd_vel) and get_maximum(
        limits, speeds
    ) < LEAST_MOTION:
        fault = f"none of its speeds and turn rates may reach {LEAST_MOTION:g}"
        raise ConfigError(
            f"{path}: the robot could never move: {fault}; raise a `max`."
        )
    return limits


def _check(key: str, limit: CommandLimit, variable: CommandVariable) -> None:
    """Raises ConfigError for limits beyond the robot or a period, or too low for any motion."""
    unit = variable.unit
    low = min(variable.min, 0.0)
    high = max(variable.max, 0.0)
    for name, value, beyond, bound in (
        ("min", limit.min, limit.min < low, f"at least {low:g}"),
        ("max", limit.max, limit.max > high, f"at most {high:g}"),
    ):
        if beyond:
            fault = f"{value:g} {unit} is beyond the robot's own limit"
            raise ConfigError(f"{key}.{name}': {fault}; give {bound}.")
    span = high - low
    far = max(-limit.min, limit.max)
    for name, order, per in (("rate", 1, "/s"), ("jerk", 2, "/s^2")):
        value = getattr(limit, name)
        most = span / PERIOD_S**order
        reach = value * LONGEST_START_S**order / order
        if value > most:
            fault = f"{value:g} {unit}{per} crosses the robot's whole range"
            within = f"within a period of the gate, {PERIOD_S:g} s, and limits nothing"
            raise ConfigError(
                f"{key}.{name}': {fault} {within}; give at most {most:g}."
            )
        if reach < STARTED * far:
            come = f"after {LONGEST_START_S:g} s it has come to {reach:.2g} of {far:g} {unit}"
            fault = f"{value:g} would never let it move: {come}"
            raise ConfigError(f"{key}.{name}': {fault}; raise it.")


def get_maximum(limits: Limits, which: NDArray[np.bool_]) -> float:
    """Returns the greatest magnitude allowed for some commands (C,); 0 if there are none."""
    return float(np.maximum(-limits.low, limits.high)[which].max(initial=0.0))


def get_maximum_speeds(limits: Limits) -> tuple[float, float]:
    """Returns the greatest speed [m/s] and turn rate [rad/s] that the commands allow."""
    each = np.maximum(-limits.low, limits.high)
    turn = get_maximum(limits, limits.turn) if limits.turn.any() else CAR_TURN
    return float(np.hypot.reduce(each[limits.linear])), turn


def is_implausible(command: Array, limits: Limits) -> bool:
    """True if a command (C,) is so far out of range that it must be a fault."""
    return bool(
        (np.abs(command) / IMPLAUSIBLE > np.maximum(-limits.low, limits.high)).any()
    )


def is_within(value: Array, limits: Limits) -> bool:
    """True if every value (C,) is a number within its limits."""
    return bool(((value >= limits.low) & (value <= limits.high)).all())  # False for NaN


def flush_denormals(values: Array) -> Array:
    """Returns values (...) of which those that are denormal, hence no speeds, are exactly zero."""
    return np.where(np.abs(values) < LEAST_NORMAL, 0.0, values)


def saturate(command: Array, limits: Limits) -> Array:
    """Returns the command (C,) within its limits, speeds and turns scaled alike: the same path."""
    speeds = limits.linear | limits.turn
    factor = 1.0
    out = flush_denormals(np.clip(command, -GREATEST, GREATEST))  # 0 times inf is NaN
    for i, value in enumerate(out):
        bound = limits.high[i] if value > 0.0 else limits.low[i]
        if bound == 0.0:
            out[i] = 0.0
        elif speeds[i] and abs(value) > abs(bound):
            factor = min(factor, bound / value)
    out[speeds] *= factor
    return flush_denormals(np.clip(out, limits.low, limits.high))


def follow(
    value: Array,
    slope: Array,
    target: Array,
    dt: float,
    limits: Limits,
    waits: bool = True,
) -> tuple[Array, Array]:
    """Moves a command (C,) and its slope towards its target as fast as rate and jerk allow."""
    # The turn waits for the speed, so that an accelerating robot is on its path from the start.
    wanted = target.copy()
    after = value.copy()
    change = slope.copy()
    given = (value, slope, wanted, limits.low, limits.high, limits.rate, limits.jerk)
    for turning in (False, True):
        if turning and waits:
            wanted[limits.turn] *= _compute_progress(
                after[limits.linear], target[limits.linear]
            )
        for i in np.flatnonzero(limits.turn == turning):
            after[i], change[i] = _follow_one(dt, *(float(each[i]) for each in given))
    return after, change


def _compute_progress(speed: Array, wanted: Array) -> float:
    """Returns the share of the wanted speed that is reached, along its direction, in [0, 1]."""
    most = float(np.abs(wanted).max(initial=0.0))
    if most < STILL:
        return 1.0
    along = wanted / most  # keeps the squares from overflowing
    return min(1.0, max(0.0, float((speed / most) @ along) / float(along @ along)))


def _follow_one(
    dt: float,
    value: float,
    slope: float,
    target: float,
    least_value: float,
    most_value: float,
    rate: float,
    jerk: float,
) -> tuple[float, float]:
    # A slope a can be brought back to zero within a change of a^2 / (2 jerk) whatever the coming
    # intervals, as the sum over them lies below the integral: a value that far within the bounds
    # stays so. In shares of the greatest value and steps of this interval, nothing overflows.
    scale = max(-least_value, most_value)
    low = least_value / scale
    high = most_value / scale
    here = value / scale
    there = target / scale
    step = min(dt / scale, GREATEST)  # per unit of slope
    least = -(high - low)
    most = high - low
    rate_step = min(rate * step, most)
    before = min(max(slope * step, least), most)
    jerk_step = min(jerk * dt * step, 2.0 * most)
    wanted = _step_towards(there - here, jerk_step)
    wanted = min(
        max(wanted, before - jerk_step, -rate_step), before + jerk_step, rate_step
    )
    wanted = min(wanted, _step_towards(high - here, jerk_step))
    wanted = max(wanted, _step_towards(low - here, jerk_step))
    after = here + wanted
    change = min(max(wanted / step if step > 0.0 else 0.0, -rate), rate)
    if abs(there - after) < SNAP:
        return target, change
    return min(max(after * scale, least_value), most_value), change


def _step_towards(gap: float, jerk: float) -> float:
    """Returns the greatest step a that can still end at a gap: a + a^2 / (2 jerk) = gap."""
    reach = 2.0 * jerk * abs(gap)
    if reach == 0.0:
        return 0.0
    # Not as root minus jerk, which cancels to rounding error for small gaps.
    return math.copysign(reach / (math.sqrt(jerk * jerk + reach) + jerk), gap)
