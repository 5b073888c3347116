"""Drives of textbook robots, disturbed in known ways."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from nics_drl_bridge import geometry
from nics_drl_bridge.identify import identify as stages
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import collect_calibration_notes
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.recording.recording import Recording, Stream, check
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot.spec import RobotSpec, build_robot
from nics_drl_bridge.robot.taylor import TaylorModel

TICKS_PER_METRE = 70.0
TRACK = 0.16
SERVOED_LATENCY_S = 0.1
PUSHED = {"throttle": (-0.3, 0.6), "steering": (-1.0, 1.0)}
STEERED = {"speed_command": (-0.5, 1.2), "steering_command": (-1.1, 1.1)}
# transfer functions
MOTOR = ([1.0], [0.15, 1.0])
SERVO = ([180.0], [1.0, 22.0, 180.0])
FINE_S = 0.002
COMMAND_S = 0.02
POSE_S = 0.01
BASE = 0.9
NOISE = 5e-4, 1e-3
"""Of motion capture [m, rad]."""


def drive(
    spec: RobotSpec,
    seed: int = 0,
    duration: float = 40.0,
    latency: float = 0.0,
    pose_clock_ahead: float = 0.0,
    rotation: float = 0.0,
    lever: tuple[float, float] = (0.0, 0.0),
    noise: tuple[float, float] = (0.0, 0.0),
    burst: float = 0.0,
    measured_state: bool = True,
) -> Recording:
    """A random drive.

    Args:
        spec: the robot.
        seed: of commands and noise.
        duration: [s].
        latency: from a command's stamp to its effect [s].
        pose_clock_ahead: what the pose's clock shows more than the commands' [s].
        rotation: heading of base_link less that of the tracked body [rad].
        lever: the tracked point seen from base_link [m].
        noise: of position [m] and heading [rad].
        burst: period of the bursts in which poses arrive [s]; 0 for none.
        measured_state: whether the state is in the recording.
    """
    rng = np.random.default_rng(seed)
    clean = record(spec, rng, duration)
    tracked = geometry.compose(clean.pose.values, np.array([*lever, -rotation]))
    tracked = tracked + rng.normal(0.0, 1.0, tracked.shape) * np.array(
        [*noise[:1], *noise]
    )
    t = clean.pose.t
    arrival = t if burst == 0.0 else in_bursts(t, burst)
    clock = "mocap" if pose_clock_ahead != 0.0 else "robot"
    return Recording(
        command=replace(clean.command, t=t - latency),
        pose=Stream(arrival + pose_clock_ahead, tracked, clock),
        state=clean.state if measured_state else None,
        source="disturbed drive",
    )


def tricycle() -> RobotSpec:
    """A forklift whose front wheel turns by 63 degrees."""
    given = {
        "kind": "tricycle",
        "footprint_radius": 0.6,
        "parameters": {"wheelbase": BASE},
    }
    return build_robot(given | {"angular_is": "steering"}, STEERED)


def servoed(
    seed: int = 0,
    duration: float = 60.0,
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0),
    steering: float = 1.1,
    steering_servo=SERVO,
    dead: float = 0.0,
    later: float = 0.0,
    slew: float = np.inf,
) -> Recording:
    """A drive of a tricycle with a motor and a servo, of which commands and poses were recorded.

    Args:
        seed: of commands and noise.
        duration: [s].
        mounting: pose of the tracked body on the robot.
        steering: greatest angle [rad].
        steering_servo: transfer function.
        dead: speed that is told and does not come [m/s].
        later: by which the steering acts after the speed [s].
        slew: greatest acceleration that the robot's driver asks of its motor [m/s^2].
    """
    rng = np.random.default_rng(seed)
    count = round(duration / FINE_S)
    per_hold = round(0.5 / FINE_S)
    ranges = np.array([STEERED["speed_command"], (-steering, steering)]).T
    command = np.repeat(rng.uniform(*ranges, (count // per_hold, 2)), per_hold, axis=0)
    acting = delay(command, SERVOED_LATENCY_S)
    acting[:, 1] = delay(acting[:, 1], later)
    asked = np.sign(acting[:, 0]) * np.maximum(np.abs(acting[:, 0]) - dead, 0.0)
    if np.isfinite(slew):
        for k in range(1, count):
            change = max(-slew * FINE_S, min(asked[k] - asked[k - 1], slew * FINE_S))
            asked[k] = asked[k - 1] + change
    speed = respond(asked, MOTOR)
    angle = respond(acting[:, 1], steering_servo)
    ahead = speed * np.cos(angle)
    twist = np.stack([ahead, 0.0 * speed, speed * np.sin(angle) / BASE], axis=1)
    poses = follow_twists(twist, FINE_S)[:: round(POSE_S / FINE_S)]
    poses = geometry.compose(poses, np.array(mounting))
    poses = poses + 5e-4 * rng.normal(size=poses.shape) * [1.0, 1.0, 2.0]
    t = FINE_S * np.arange(count)
    rows = slice(None, None, round(COMMAND_S / FINE_S))
    pose = Stream(POSE_S * np.arange(len(poses)), poses)
    return Recording(Stream(t[rows], command[rows]), pose)


def delay(values: np.ndarray, seconds: float) -> np.ndarray:
    """Returns values that come later, after zeros."""
    late = round(seconds / FINE_S)
    return np.concatenate([0.0 * values[:late], values[: len(values) - late]])


def respond(values: np.ndarray, system) -> np.ndarray:
    """Returns the response of a transfer function to values."""
    b, a, _ = cont2discrete(system, FINE_S)
    return lfilter(b.ravel(), a, values)


def follow_twists(twist: np.ndarray, dt: float) -> np.ndarray:
    """Returns the poses of a robot, from the origin on, before each of some body twists."""
    moved = geometry.exp(twist * dt)
    heading = np.cumsum(moved[:, 2]) - moved[:, 2]
    step = geometry.rotate(moved[:, :2], heading)
    return np.concatenate([np.cumsum(step, axis=0) - step, heading[:, None]], axis=1)


def in_bursts(t: np.ndarray, period: float) -> np.ndarray:
    """Arrival stamps of samples that are handed over every `period`, 0.1 ms apart or less."""
    polled = np.ceil(t / period - 1e-6) * period
    return polled + 1e-3 * (t - (polled - period))


def add_wheels(recording: Recording, ahead: float, swapped: bool = False) -> Recording:
    """Adds wheel encoders by the motion of a pose at the centre, whose clock is then ahead [s]."""
    pose = recording.pose
    moved = geometry.log(geometry.between(pose.values[:-4], pose.values[4:]))
    twist = moved / (pose.t[4:] - pose.t[:-4])[:, None]
    both = twist[:, :1] + twist[:, 2:] * [-TRACK / 2.0, TRACK / 2.0]
    both = np.round(
        TICKS_PER_METRE * both[:, ::-1] if swapped else TICKS_PER_METRE * both
    )
    wheels = Stream(pose.t[2:-2:2], both[::2], "robot")
    tracked = replace(pose, t=pose.t + ahead, clock="mocap")
    return replace(recording, wheels=wheels, pose=tracked)


def with_values(recording: Recording, **values: np.ndarray) -> Recording:
    """A recording with other values of the streams that are named."""
    streams = {
        name: replace(recording.streams[name], values=each)
        for name, each in values.items()
    }
    return replace(recording, **streams)


def scale(recording: Recording, **factors: Any) -> Recording:
    """Multiplies the columns of streams that are named."""
    streams = recording.streams
    scaled = {name: streams[name].values * each for name, each in factors.items()}
    return with_values(recording, **scaled)


def without(recording: Recording, start: float, end: float) -> Recording:
    """Loses the poses between two times."""
    pose = recording.pose
    keep = (pose.t < start) | (pose.t > end)
    return replace(
        recording, pose=replace(pose, t=pose.t[keep], values=pose.values[keep])
    )


def calibrate(recording: Recording, spec: RobotSpec) -> Calibration:
    """A recording's corrections, and the sentences on them, by the stages before a fit."""
    row = (
        stages.estimate_timing,
        stages.find_mounting,
        stages.find_responses,
        stages.measure_noise,
    )
    found = stages.run(row, Drive(check(recording, spec), spec))
    return replace(found.calibration, notes=collect_calibration_notes(found))


def throttle_car() -> RobotSpec:
    """A car by throttle, whose state is its twist."""
    given = {"kind": "ackermann_throttle", "footprint_radius": 0.25}
    return build_robot(given | {"parameters": {"wheelbase": 0.26}}, PUSHED)


def slipping_car(
    seed: int = 0,
    duration: float = 40.0,
    dead: float = 0.1,
    friction: float = 0.3,
    drag: float = 0.15,
    throttle: float | None = None,
) -> tuple[RobotSpec, Recording]:
    """A car by throttle that slips aside and turns less at speed; only its poses were seen."""
    rng = np.random.default_rng(seed)
    count = round(duration / COMMAND_S)
    limits = np.array(list(PUSHED.values())).T
    draws = rng.uniform(*limits, (count // 40 + 1, 2))
    command = np.repeat(
        np.where(rng.random(draws.shape) < 0.15, 0.0, draws), 40, axis=0
    )[:count]
    if throttle is not None:
        command[:, 0] = throttle
    state = np.zeros(6)
    poses = []
    for u, steering in np.repeat(command, round(COMMAND_S / FINE_S), axis=0):
        poses.append(state[:3].copy())
        x, y, heading, v, angle, turn = state
        push = 9.0 * np.sign(u) * max(abs(u) - dead, 0.0) - 0.5 * v - drag * v * abs(v)
        wanted = v * np.tan(angle) / (0.26 + 0.03 * v * v)
        aside = -0.015 * v * v * turn
        c = np.cos(heading)
        s = np.sin(heading)
        v += FINE_S * push
        v = np.sign(v) * max(abs(v) - FINE_S * friction, 0.0)
        state = np.array(
            [
                x + FINE_S * (c * state[3] - s * aside),
                y + FINE_S * (s * state[3] + c * aside),
                heading + FINE_S * turn,
                v,
                angle + FINE_S * (0.4 * steering - angle) / 0.06,
                turn + FINE_S * (wanted - turn) / 0.04,
            ]
        )
    pose = geometry.compose(np.array(poses), np.array([0.08, 0.0, 0.1]))[::5]
    pose = pose + 0.0003 * rng.normal(size=pose.shape)
    t = FINE_S * 5.0 * np.arange(len(pose))
    commands = Stream(COMMAND_S * np.arange(count), command)
    return throttle_car(), Recording(commands, Stream(t, pose))


def make_model(
    spec: RobotSpec, terms: dict[str, dict[str, float]], **given: object
) -> TaylorModel:
    """A model by degree of freedom and term; a term is the names of its variables."""
    names = list(dict.fromkeys(name for row in terms.values() for name in row))
    powers = np.array(
        [[name.split("*").count(v) for v in spec.variable_names] for name in names],
        dtype=np.int64,
    )
    coefficients = np.zeros((len(spec.dof_names), len(names)))
    for dof, row in terms.items():
        for name, value in row.items():
            coefficients[spec.dof_names.index(dof), names.index(name)] = value
    reach = np.ones(len(spec.variable_names))
    usual = {"dt": 0.01, "low": -reach, "high": reach}
    return TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        powers,
        coefficients,
        **(usual | given),
    )


def follow_commands(
    commands: np.ndarray,
    target: Callable[[np.ndarray], np.ndarray],
    twist: Callable[[np.ndarray], np.ndarray],
    lag: float | np.ndarray,
    dt: float = 0.02,
    noise: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Recording:
    """A drive of a robot whose state follows `target(commands)` and that moves by `twist(state)`.

    Args:
        commands: (T, C).
        target: the state that commands lead to.
        twist: the body twist of states.
        lag: of the state [s].
        dt: between two rows [s].
        noise: of position [m] and heading [rad].
        seed: of the noise.
    """
    fine = 10
    goals = target(commands)
    kept = np.exp(-np.arange(fine)[:, None] * dt / fine / lag)
    state = np.zeros(goals.shape[1])
    states = []
    for goal in goals:
        states.append(goal + (state - goal) * kept)
        state = goal + (state - goal) * np.exp(-dt / lag)
    poses = follow_twists(twist(np.concatenate(states)), dt / fine)[::fine]
    rng = np.random.default_rng(seed)
    poses = poses + rng.normal(size=poses.shape) * [noise[0], *noise]
    t = dt * np.arange(len(commands))
    return Recording(
        Stream(t, commands), Stream(t, poses), Stream(t, np.array(states)[:, 0])
    )


def draw_commands(
    spec: RobotSpec, count: int = 1500, hold: int = 25, seed: int = 0
) -> np.ndarray:
    """Random commands (count, C) within a robot's limits, each held for some rows."""
    rng = np.random.default_rng(seed)
    held = rng.uniform(
        spec.command_low, spec.command_high, (-(-count // hold), len(spec.command))
    )
    return np.repeat(held, hold, axis=0)[:count]


def fit_trial(recording: Recording, spec: RobotSpec, **settings: Any) -> Identified:
    """A model of the first two thirds of a drive, judged on the rest; it is not refitted."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "refit_model", lambda drive, findings: findings)
        return stages.identify(recording, spec, **settings)


def fit_whole(recording: Recording, spec: RobotSpec, **settings: Any) -> Identified:
    """A model of a whole drive, which no rest is left to judge."""
    return stages.identify(recording, spec, train_until=np.inf, **settings)
