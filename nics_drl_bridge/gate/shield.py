"""The shield: passes only commands from which the robot can stop before every obstacle.

`shield` decides on each command, after limits of value, rate and jerk:

1. A command from which the robot can stop passes.
2. Any other is reduced until the robot can stop (dynamic window of Fox, Burgard and
   Thrun, 1997): its speed, its speed and turn in proportion, or its turn is removed.

To check whether it can stop, its footprint is swept along arcs until rest, twice:

- in a calm stop, at half the deceleration, with all obstacles static, so that an
  approach ends smoothly;
- in a sudden stop, as hard as it can brake, before obstacles that may approach. The robot keeps
  its twist for the age of the scan, the wait for the next decision and its own reaction. That
  twist is anything between its odometry, the new command, the last one and those before it that the
  scan does not show yet.

See `evidence` for what counts as an obstacle.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.gate import evidence_kernels, ground, shield_kernels
from nics_drl_bridge.gate.arrivals import compute_age
from nics_drl_bridge.gate.evidence import make_static
from nics_drl_bridge.gate.evidence_kernels import MountedBeams, Tolerance
from nics_drl_bridge.gate.footprint import get_body
from nics_drl_bridge.gate.limits import Limits
from nics_drl_bridge.gate.shield_kernels import Stop
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Ground,
    Motion,
    ShieldConfig,
    View,
    replace,
)
from nics_drl_bridge.interface import Array

TimedCommand = tuple[float, Array]  # time of its publication [s], and its values (C,)
BISECTIONS = 6  # number of bisections of the scale by which a motion is reduced
# A turning robot approaches an obstacle at least this fast [m/s] or not at all: by
# creeping on, it would lose the space that it needs to turn.
CREEP_SPEED = 0.1
STEP = 0.02  # distance between two places at which the footprint is checked [m]
CALM_BRAKING = 0.5  # fraction of the deceleration that a calm stop needs
# If a stop may end below this fraction of its bound, the shorter stop is swept as well.
SHORT_STOP = 0.9
# Grid of twists that are swept: speeds along each axis, turn rates, and curvatures of a car.
SPEED_COUNT = 3
TURN_RATE_COUNT = 9
CURVATURE_COUNT = 18
# Above this speed [m/s] the curvature of a car is computed from its odometry.
CURVATURE_SPEED = 0.1


class Threat(NamedTuple):
    """Obstacles before which the robot must be able to stop.

    Attributes:
        obstacles: (P, 3), see `evidence`.
        stops: in which none of them may come too near.
        commands: (C,) each, besides the new one, that the robot may follow.
        odometry: (3,) twist that the robot may have; None if only the commands count.
    """

    obstacles: Array
    stops: list[Stop]
    commands: tuple[Array, ...] = ()
    odometry: Array | None = None


def shield(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Reduces a motion until the robot can stop before every obstacle.

    A motion from which the robot can stop passes as it is. Otherwise:

    - If the turn on the spot is safe, the turn rate is kept and only the speed is
      reduced: an obstacle ahead must not prevent the robot from turning away.
    - Otherwise, speed and turn rate are scaled by the same factor, which keeps the
      robot on its path. If only a creep remains, but the robot could stop from
      `CREEP_SPEED` straight ahead, the turn is removed instead: an obstacle at its side
      must not prevent the robot from leaving straight ahead.

    A creep is a speed below `CREEP_SPEED` with a turn, of a robot that can turn on the
    spot. It would end so close to an obstacle that the robot could no longer turn. A
    commanded creep therefore passes unchanged only if the robot could also stop from
    `CREEP_SPEED`; if only the turn is safe, the speed becomes zero.
    """
    limiter = config.shield
    # Without a scan, the gate has already stopped.
    if limiter is None or config.limits is None or state.obstacles is None:
        return motion
    limits = config.limits
    speed = float(np.abs(motion.value[limits.linear]).max(initial=0.0))
    turns = bool(motion.value[limits.turn].any())
    turns_on_the_spot = turns and limiter.wheelbase == 0.0
    if speed == 0.0 and not turns:
        return motion
    threats = _list_threats(config, limiter, state, now)

    def can_stop(speed_scale: float, turn_scale: float) -> bool:
        value = _scale_command(limits, motion.value, speed_scale, turn_scale)
        return all(_is_free(config, limiter, threat, value) for threat in threats)

    is_creep = turns_on_the_spot and 0.0 < speed < CREEP_SPEED
    if can_stop(1.0, 1.0) and (not is_creep or can_stop(CREEP_SPEED / speed, 1.0)):
        return motion
    speed_scale, turn_scale = _choose_scales(can_stop, speed, turns, turns_on_the_spot)
    # What is not scaled goes on changing, such as a steering angle.
    is_kept = ~limits.linear & (~limits.turn | (turn_scale == 1.0))
    return replace(
        motion,
        value=_scale_command(limits, motion.value, speed_scale, turn_scale),
        slope=np.where(is_kept, motion.slope, 0.0),
        shielded=True,
    )


def _scale_command(
    limits: Limits, command: Array, speed_scale: float, turn_scale: float
) -> Array:
    """Returns a command (C,) with other speeds and turn rates."""
    turn_scales = np.where(limits.turn, turn_scale, 1.0)
    return command * np.where(limits.linear, speed_scale, turn_scales)


def _choose_scales(
    can_stop: Callable[[float, float], bool],
    speed: float,
    turns: bool,
    turns_on_the_spot: bool,
) -> tuple[float, float]:
    """Returns the factors on speed and turn rate from which the robot can stop; see `shield`."""
    if turns and can_stop(0.0, 1.0):
        scale = _find_maximum_scale(lambda scale: can_stop(scale, 1.0))
        if turns_on_the_spot and scale * speed < CREEP_SPEED:
            return 0.0, 1.0
        return scale, 1.0
    scale = _find_maximum_scale(lambda scale: can_stop(scale, scale))
    would_creep = turns_on_the_spot and scale * speed < CREEP_SPEED
    if would_creep and speed > 0.0 and can_stop(CREEP_SPEED / speed, 0.0):
        return _find_maximum_scale(lambda scale: can_stop(scale, 0.0)), 0.0
    return scale, scale


def _find_maximum_scale(can_stop: Callable[[float], bool]) -> float:
    """Returns the maximum scale in [0, 1] from which the robot can stop, by bisection."""
    if can_stop(1.0):
        return 1.0
    low = 0.0
    high = 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        if can_stop(middle):
            low = middle
        else:
            high = middle
    return low


def _list_threats(
    config: GateConfig, shield: ShieldConfig, state: GateState, now: float
) -> tuple[Threat, Threat]:
    """Returns the threats of a calm and of a sudden stop."""
    sensor_points = [make_static(sensor.points) for sensor in state.sensors]
    obstacles = np.concatenate([state.obstacles, *sensor_points])
    # A stop is decided after `hold_s` and takes effect after a latency.
    decided_s = shield.hold_s + shield.latency_s
    # The new command takes effect after a latency; the next scan arrives after a period.
    calm_s = 1.0 / config.scan_rate + decided_s + shield.latency_s
    calm = Threat(
        make_static(obstacles[:, :2]),
        list_stops(shield, calm_s, CALM_BRAKING, latencies=2.0),
    )
    data_age_s = _measure_data_age(state, now)
    # Commands in effect since the oldest data, or within a reaction time before.
    since_s = now - data_age_s - _get_longest_reaction(shield)
    unshown = [command for _, command in _select_in_force(state.recent, since_s, now)]
    sudden = Threat(
        obstacles,
        list_stops(shield, data_age_s + decided_s, 1.0, latencies=1.0),
        (*unshown, state.value),
        np.zeros(3) if state.odometry is None else state.odometry.twist,
    )
    return calm, sudden


def _measure_data_age(state: GateState, now: float) -> float:
    """Returns the age of the oldest newest data of lidar and sensors [s]."""
    arrivals = [state.scans, *(sensor.arrivals for sensor in state.sensors)]
    return max(0.0, *(compute_age(topic, now) for topic in arrivals))


def _is_free(
    config: GateConfig, shield: ShieldConfig, threat: Threat, value: Array
) -> bool:
    """True if no obstacle of a threat comes too near in any stop from a new command (C,)."""
    commands = np.array([*threat.commands, value])
    twists = _span_twists(config, shield, commands, threat.odometry)
    return all(
        shield_kernels.is_free(threat.obstacles, twists, stop, STEP)
        for stop in threat.stops
    )


def append_command(
    config: GateConfig, state: GateState, command: Array, now: float
) -> tuple[TimedCommand, ...]:
    """Returns a new command (C,) after those that the shield may still need."""
    shield = config.shield
    if shield is None:
        return ()
    # No data are older than this when a motion is decided.
    oldest_s = now - config.scan_age_s - _get_longest_reaction(shield)
    return _select_in_force((*state.recent, (now, command)), oldest_s, now)


def _get_longest_reaction(shield: ShieldConfig) -> float:
    """Returns the longest time after which the robot still follows an earlier command [s]."""
    if shield.turn is None:
        return shield.latency_s
    return max(shield.latency_s, shield.turn.reaction_s)


def _select_in_force(
    commands: tuple[TimedCommand, ...], since_s: float, now: float
) -> tuple[TimedCommand, ...]:
    """Returns the commands, oldest first, that were in effect at `since_s` or later.

    A command is in effect until the next one.
    """
    ends_s = [*(time for time, _ in commands[1:]), now]
    return tuple(
        command
        for command, end_s in zip(commands, ends_s, strict=False)
        if end_s >= since_s
    )


def list_stops(
    shield: ShieldConfig, reaction_s: float, braking: float, latencies: float
) -> list[Stop]:
    """Returns the stops to sweep. If the turn brakes independently, either may end early.

    Args:
        shield: the stopping behaviour.
        reaction_s: time until the speed is braked [s], which includes the latencies.
        braking: fraction of the decelerations with which the robot brakes.
        latencies: number of latencies in the reaction time.
    """
    body = get_body(shield)
    deceleration = braking * shield.deceleration
    turn = shield.turn
    if turn is None:
        return [Stop(body, 0.0, 0.0, reaction_s, deceleration)]
    # Fractions of the bounds on path and turn by which the robot moves.
    fractions = [(1.0, 1.0)]
    if turn.least_turn < SHORT_STOP:
        fractions.append((1.0, turn.least_turn))
    if turn.least_path < SHORT_STOP:
        fractions.append((turn.least_path, 1.0))
    stops = []
    # A stop that ends early, at a fraction of its path v t + v^2 / (2 a), may have had less
    # latency and braked harder: by up to the missing latency, and with a / fraction.
    for path_fraction, turn_fraction in fractions:
        path_reaction_s = reaction_s - (1.0 - path_fraction) * shield.latency_s
        turn_latencies = latencies - (1.0 - turn_fraction)
        turn_reaction_s = (
            reaction_s - latencies * shield.latency_s + turn_latencies * turn.reaction_s
        )
        stops.append(
            Stop(
                body,
                turn_reaction_s - path_reaction_s,
                braking * turn.deceleration / turn_fraction,
                path_reaction_s,
                deceleration / path_fraction,
            )
        )
    return stops


def _span_twists(
    config: GateConfig, shield: ShieldConfig, commands: Array, odometry: Array | None
) -> Array:
    """Returns body twists (K, 3) between those of commands (n, C) and of odometry (3,), if any."""
    twists = np.zeros((len(commands), 3))
    twists[:, list(config.fields)] = commands
    if shield.wheelbase > 0.0:
        return _span_car_twists(shield.wheelbase, twists, odometry)
    if odometry is not None:
        twists = np.concatenate([twists, odometry[None]])
    twists = _add_drift(shield, twists)
    low = twists.min(axis=0)
    high = twists.max(axis=0)
    counts = np.where(high > low, (SPEED_COUNT, SPEED_COUNT, TURN_RATE_COUNT), 1)
    return np.asarray(shield_kernels.fill_grid(low, high, counts))


def _add_drift(shield: ShieldConfig, twists: Array) -> Array:
    """Returns twists (n, 3), and twists that bound the drift off its arc while it brakes."""
    drift = shield.drift
    if drift.is_none:
        return twists
    scale = np.array([1.0, 1.0, shield.footprint_radius])
    speeds = np.abs(twists * scale)
    maximum = speeds.max(axis=1, keepdims=True)
    is_lesser = speeds < maximum
    bound = drift.share * maximum / scale
    rows = [twists]
    for factor in (drift.least, drift.greatest):
        changed = np.clip(factor * twists, -bound, bound)
        rows.append(np.where(is_lesser, changed, twists))
    return np.concatenate(rows)


def _span_car_twists(
    wheelbase: float, commands: Array, odometry: Array | None
) -> Array:
    """Returns a car's twists: curvature does not depend on speed; braking steers it straight."""
    curvatures = [0.0, *np.tan(commands[:, 2]) / wheelbase]
    speeds = list(commands[:, 0])
    if odometry is not None:
        speeds.append(odometry[0])
        if abs(odometry[0]) > CURVATURE_SPEED:
            curvatures.append(odometry[2] / odometry[0])
    # none twice if the car drives straight
    spanned = np.unique(np.linspace(min(curvatures), max(curvatures), CURVATURE_COUNT))
    extremes = [speed for speed in sorted({max(speeds), min(speeds)}) if speed != 0.0]
    speed, curvature = np.meshgrid(extremes, spanned)
    twists = np.stack([speed, np.zeros_like(speed), speed * curvature], axis=-1)
    return twists.reshape(-1, 3)


def warm_up() -> None:
    """Compiles the shield's kernels, which takes seconds that a moving robot does not have."""
    shield_kernels.fill_grid(np.zeros(3), np.zeros(3), np.ones(3, np.int64))
    body = get_body(
        ShieldConfig(0.0, 1.0, 0.0, 0.0, footprint_radius=1.0, obstacle_speed=0.0)
    )
    stop = Stop(body, 0.0, 0.0, 0.0, 1.0)
    shield_kernels.is_free(np.zeros((1, 3)), np.zeros((1, 3)), stop, STEP)
    lidar = MountedBeams(0.0, 0.1, 0.0, 0.0, 0.0)
    ranges = np.ones(1, np.float32)
    tolerance = Tolerance(0.0, 0.0)
    entered = np.zeros(1, np.bool_)
    agreeing = np.zeros((1, 1), np.bool_)
    still = np.zeros(3)
    evidence_kernels.mark_agreeing(
        agreeing, ranges, ranges, lidar, still[None], tolerance, 1
    )
    evidence_kernels.mark_entered(entered, ranges, ranges, lidar, still, 1.0, tolerance)
    view = View(0, np.zeros(3), ranges)
    before: Ground | None = None
    for _ in range(2):
        before = ground.observe_ground(before, view, lidar, body, 1.0)
