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

# a command beyond this multiple of its limit is rejected as a fault
IMPLAUSIBLE = 10.0
# minimum time between published motions; shorter ones give noisy derivatives [s]
MIN_STEP_S = 1e-3
PERIOD_S = 0.02  # of the gate's ticks [s]; a limit that allows the full range within one is a typo
SNAP = 1e-12  # a value this close to its target, as a fraction of the maximum, has reached it
HUGE = 1e300  # numbers are clipped to this before a multiplication: inf times 0 would be NaN
STILL = 1e-9
# numbers closer to zero are denormal and lose digits
SMALLEST_NORMAL = float(np.finfo(np.float64).tiny)
# if all speed limits are below this, the robot can't be driven [m/s or rad/s]
MIN_MOTION = 0.01
# Within this time [s] a command must be able to reach this fraction of its maximum.
LONGEST_START_S = 10.0
STARTED = 0.01
HARDEST = 1e4  # maximum deceleration of a robot [m/s^2]
SPEED = "m/s"
TURN = "rad/s"
# maximum turn rate of a robot that is commanded by steering angle [rad/s]
CAR_TURN = 4.0


class CommandLimit(Schema):
    """Limits of one command, in its unit; an angle's rate is the steering rate."""

    min: float = Field(le=0.0)  # minimum that passes the gate
    max: float = Field(ge=0.0)  # maximum that passes the gate
    rate: float = Field(gt=0.0)  # maximum change per second, in both directions
    jerk: float = Field(gt=0.0)  # maximum change of the rate per second

    @model_validator(mode="after")
    def _ordered(self) -> "CommandLimit":
        if not self.min < self.max:
            raise ValueError("min must be less than max")
        return self


class Stopping(Schema):
    """Stopping behaviour, for the shield: distance = v latency + v^2 / (2 deceleration)."""

    # time from a command until the robot follows it, including lags [s]
    latency: float = Field(ge=0.0, le=10.0)
    # deceleration of the following braking [m/s^2]
    deceleration: float = Field(ge=1e-3, le=HARDEST)
    # clearance kept around the footprint [m]
    margin: float = Field(default=0.05, ge=0.0, le=10.0)
    # speed of approaching obstacles [m/s]; 0 if all are static
    obstacle_speed: float = Field(default=1.0, ge=0.0, le=100.0)


class LimitsFile(Schema):
    """A file of limits. Only `shield` is optional; by default it is derived from the model."""

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
    """Reads limits, shipped or from a YAML file. ConfigError names the faulty key."""
    path = find_config(name, "limits")
    file = load_yaml(path, LimitsFile)
    if file.robot != robot.name:
        fault = f"the limits are for {file.robot!r}, not for {robot.name!r}"
        raise ConfigError(f"{path}: key 'robot': {fault}; name the file of this robot.")
    names = [variable.name for variable in robot.command]
    for name in file.commands:
        if name not in names:
            raise ConfigError(
                f"{path}: unknown key 'commands.{name}'; {suggest(name, names)}"
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
    commands = [file.commands[name] for name in names]
    units = np.array([variable.unit for variable in robot.command])
    limits = Limits(
        low=np.array([command.min for command in commands]),
        high=np.array([command.max for command in commands]),
        rate=np.array([command.rate for command in commands]),
        jerk=np.array([command.jerk for command in commands]),
        linear=units == SPEED,
        turn=units == TURN,
    )
    speeds = limits.linear | limits.turn
    if (speeds.any() or robot.takes_cmd_vel) and get_maximum(
        limits, speeds
    ) < MIN_MOTION:
        fault = f"none of its speeds and turn rates may reach {MIN_MOTION:g}"
        raise ConfigError(
            f"{path}: the robot could never move: {fault}; raise a `max`."
        )
    return limits


def _check_bounds(key: str, limit: CommandLimit, variable: CommandVariable) -> float:
    """Returns the robot's range. Raises ConfigError for limits beyond it."""
    low = min(variable.min, 0.0)
    high = max(variable.max, 0.0)
    for name, value, beyond, bound in (
        ("min", limit.min, limit.min < low, f"at least {low:g}"),
        ("max", limit.max, limit.max > high, f"at most {high:g}"),
    ):
        if beyond:
            fault = f"{value:g} {variable.unit} is beyond the robot's own limit"
            raise ConfigError(f"{key}.{name}': {fault}; give {bound}.")
    return high - low


def _check(key: str, limit: CommandLimit, variable: CommandVariable) -> None:
    """Raises ConfigError for limits beyond the robot or a period, or too low for any motion."""
    unit = variable.unit
    span = _check_bounds(key, limit, variable)
    far = max(-limit.min, limit.max)
    for name, order, per in (("rate", 1, "/s"), ("jerk", 2, "/s^2")):
        value = getattr(limit, name)
        maximum = span / PERIOD_S**order
        reach = value * LONGEST_START_S**order / order
        if value > maximum:
            fault = f"{value:g} {unit}{per} crosses the robot's whole range"
            within = f"within a period of the gate, {PERIOD_S:g} s, and limits nothing"
            raise ConfigError(
                f"{key}.{name}': {fault} {within}; give at most {maximum:g}."
            )
        if reach < STARTED * far:
            come = f"after {LONGEST_START_S:g} s it has come to {reach:.2g} of {far:g} {unit}"
            fault = f"{value:g} would never let it move: {come}"
            raise ConfigError(f"{key}.{name}': {fault}; raise it.")


def get_maximum(limits: Limits, which: NDArray[np.bool_]) -> float:
    """Returns the maximum magnitude allowed for some commands (C,); 0 if there are none."""
    return float(np.maximum(-limits.low, limits.high)[which].max(initial=0.0))


def get_maximum_speeds(limits: Limits) -> tuple[float, float]:
    """Returns the maximum speed [m/s] and turn rate [rad/s] that the commands allow."""
    magnitudes = np.maximum(-limits.low, limits.high)
    turn = get_maximum(limits, limits.turn) if limits.turn.any() else CAR_TURN
    return float(np.hypot.reduce(magnitudes[limits.linear])), turn


def is_implausible(command: Array, limits: Limits) -> bool:
    """True if a command (C,) is so far out of range that it must be a fault."""
    return bool(
        (np.abs(command) / IMPLAUSIBLE > np.maximum(-limits.low, limits.high)).any()
    )


def is_within(value: Array, limits: Limits) -> bool:
    """True if every value (C,) is a number within its limits."""
    return bool(((value >= limits.low) & (value <= limits.high)).all())  # False for NaN


def flush_denormals(values: Array) -> Array:
    """Returns values (...) with denormal ones replaced by zero."""
    return np.where(np.abs(values) < SMALLEST_NORMAL, 0.0, values)


def saturate(command: Array, limits: Limits) -> Array:
    """Returns the command (C,) within its limits; speeds and turn rates keep their ratio."""
    speeds = limits.linear | limits.turn
    factor = 1.0
    out = flush_denormals(np.clip(command, -HUGE, HUGE))  # 0 times inf is NaN
    for i, value in enumerate(out):
        bound = limits.low[i] if np.signbit(value) else limits.high[i]
        if bound == 0.0:
            out[i] = 0.0
        elif speeds[i]:
            factor = min(factor, abs(bound) / max(abs(value), abs(bound)))
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
    """Moves a command (C,) and its slope to its target as fast as rate and jerk limits allow."""
    # The turn follows the progress of the speed, so that an accelerating robot stays on
    # its path.
    wanted = target.copy()
    after = value.copy()
    change = slope.copy()
    rows = (value, slope, wanted, limits.low, limits.high, limits.rate, limits.jerk)
    for turning in (False, True):
        if turning and waits:
            wanted[limits.turn] *= _compute_progress(
                after[limits.linear], target[limits.linear]
            )
        for i in np.flatnonzero(limits.turn == turning):
            after[i], change[i] = _follow_one(dt, *(float(row[i]) for row in rows))
    return after, change


def _compute_progress(speed: Array, wanted: Array) -> float:
    """Returns the fraction of the wanted speed reached along its direction, in [0, 1]."""
    maximum = float(np.abs(wanted).max(initial=0.0))
    if maximum < STILL:
        return 1.0
    along = wanted / maximum  # keeps the squares from overflowing
    return min(1.0, max(0.0, float((speed / maximum) @ along) / float(along @ along)))


def _follow_one(
    dt: float,
    value: float,
    slope: float,
    target: float,
    min_value: float,
    max_value: float,
    rate: float,
    jerk: float,
) -> tuple[float, float]:
    # A slope a can be reduced to zero within a change of a^2 / (2 jerk) for any future
    # intervals, because the sum over them is below the integral. A value with this
    # margin therefore stays within its bounds. Values are fractions of the maximum and
    # slopes are steps per interval, so that nothing overflows.
    scale = max(-min_value, max_value)
    low = min_value / scale
    high = max_value / scale
    now = value / scale
    goal = target / scale
    step_per_slope = min(dt / scale, HUGE)
    span = high - low
    rate_step = min(rate * step_per_slope, span)
    last_step = min(max(slope * step_per_slope, -span), span)
    jerk_step = min(jerk * dt * step_per_slope, 2.0 * span)
    step = _step_towards(goal - now, jerk_step)
    step = min(
        max(step, last_step - jerk_step, -rate_step), last_step + jerk_step, rate_step
    )
    step = min(step, _step_towards(high - now, jerk_step))
    step = max(step, _step_towards(low - now, jerk_step))
    after = now + step
    new_slope = 0.0
    if step_per_slope > 0.0:
        new_slope = step / step_per_slope
    new_slope = min(max(new_slope, -rate), rate)
    if abs(goal - after) < SNAP:
        return target, new_slope
    return min(max(after * scale, min_value), max_value), new_slope


def _step_towards(gap: float, jerk: float) -> float:
    """Returns the maximum step a that can still end at a gap: a + a^2 / (2 jerk) = gap."""
    reach = 2.0 * jerk * abs(gap)
    if reach == 0.0:
        return 0.0
    # Not as root minus jerk, which suffers from cancellation for small gaps.
    return math.copysign(reach / (math.sqrt(jerk * jerk + reach) + jerk), gap)
