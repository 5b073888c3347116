"""Drives of robots in simulators of their own.

Their equations of motion share nothing with the package's kinematics: forces between wheels and
ground, servos of second order, motors with a torque curve. No physics engine has such motors,
servos and encoders; a robot of DART drives in `test/campaigns/unknown_robot.py`.

What a recorder sees: commands at 20 Hz that act after a latency, poses of a motion capture whose
tracked body sits somewhere on the robot, or encoders that overflow. Everything follows from a seed.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.recording.recording import Stream

STEP_S = 0.001
COMMAND_S = 0.05
POSE_NOISE = np.array([0.0005, 0.0005, 0.001])  # standard deviations [m, m, rad]
SEGMENT_S = (0.4, 2.5)
LEVELS = 7  # commands that are held take one of so many levels of their range
# shares of segments at zero, and of ramps
REST = 0.1
RAMP = 0.3
COUNTER = 2**16  # where the encoders' counters overflow
SKID_STEER, THROTTLE_CAR, TRICYCLE, OMNI, TICKS = range(5)
GRAVITY = 9.81
STATES = 8  # the first are x, y [m] and heading [rad] of the reference point
Twist = tuple[float, float, float]


@kernel
def _grip(
    slip_x: float, slip_y: float, friction: float, load: float, softness: float
) -> tuple[float, float]:
    """Friction of a wheel, opposite to its slip [m/s], that saturates at friction * load [N]."""
    share = friction * load / math.sqrt(slip_x**2 + slip_y**2 + softness**2)
    return -share * slip_x, -share * slip_y


@kernel
def _drive_skid_steer(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Four wheels that skid: forces of friction on a body with mass."""
    mass, inertia, front, rear, half_track, friction, softness, lag = p[:8]
    vx = s[3]
    vy = s[4]
    turn = s[5]
    force_x = 0.0
    force_y = 0.0
    torque = 0.0
    for side in range(2):
        y = half_track if side == 0 else -half_track
        for x in (front, -rear):
            load = mass * GRAVITY * 0.5 * (rear if x > 0.0 else front) / (front + rear)
            fx, fy = _grip(
                vx - turn * y - s[6 + side], vy + turn * x, friction, load, softness
            )
            force_x = force_x + fx
            force_y = force_y + fy
            torque += x * fy - y * fx
    out[3] = force_x / mass + turn * vy
    out[4] = force_y / mass - turn * vx
    out[5] = torque / inertia
    out[6] = (u[0] - u[1] * half_track - s[6]) / lag
    out[7] = (u[0] + u[1] * half_track - s[7]) / lag
    return vx, vy, turn


@kernel
def _drive_throttle_car(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """A motor whose pull falls with the speed, a dead zone, drag; a servo, understeer, slip."""
    (
        dead,
        pull,
        top,
        rolling,
        drag,
        wheelbase,
        greatest,
        servo,
        understeer,
        slip,
        yaw_lag,
    ) = p[:11]
    v = s[3]
    angle = s[4]
    turn = s[5]
    beyond = max(abs(u[0]) - dead, 0.0) / (1.0 - dead)
    push = math.copysign(beyond, u[0]) * pull
    out[3] = (
        push
        - pull * beyond * v / top
        - rolling * math.tanh(v / 0.002)
        - drag * v * abs(v)
    )
    out[4] = (greatest * min(max(u[1], -1.0), 1.0) - angle) / servo
    out[5] = (v * math.tan(angle) / (wheelbase + understeer * v * v) - turn) / yaw_lag
    return v, -slip * v * v * turn, turn


@kernel
def _drive_tricycle(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """A driven, steered front wheel: a motor of first order, a damped servo of second."""
    wheelbase, motor, stiffness, damping = p[:4]
    out[3] = (u[0] - s[3]) / motor
    out[4] = s[5]
    out[5] = stiffness * (u[1] - s[4]) - damping * s[5]
    return s[3] * math.cos(s[4]), 0.0, s[3] * math.sin(s[4]) / wheelbase


@kernel
def _drive_omni(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Three wheels at 120 degrees, each with a motor of its own lag, on unequal radii."""
    arm = p[0]
    vx = 0.0
    vy = 0.0
    turn = 0.0
    for i in range(3):
        at = math.pi / 3.0 + i * 2.0 * math.pi / 3.0
        along_x = -math.sin(at)
        along_y = math.cos(at)
        out[3 + i] = (along_x * u[0] + along_y * u[1] + arm * u[2] - s[3 + i]) / p[
            1 + i
        ]
        speed = p[4 + i] * s[3 + i]
        vx = vx + speed * along_x * 2.0 / 3.0
        vy = vy + speed * along_y * 2.0 / 3.0
        turn += speed / (3.0 * arm)
    return vx, vy, turn


@kernel
def _drive_ticks(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Two driven wheels whose turned angles [rad] are the last two states."""
    left, right, base, lag = p[:4]
    out[3] = (u[0] - s[3]) / lag
    out[4] = (u[1] - s[4]) / lag
    out[5] = s[3]
    out[6] = s[4]
    return 0.5 * (left * s[3] + right * s[4]), 0.0, (right * s[4] - left * s[3]) / base


@kernel
def _compute_rates(kind: int, s: Array, u: Array, p: Array, out: Array) -> None:
    if kind == SKID_STEER:
        vx, vy, turn = _drive_skid_steer(s, u, p, out)
    elif kind == THROTTLE_CAR:
        vx, vy, turn = _drive_throttle_car(s, u, p, out)
    elif kind == TRICYCLE:
        vx, vy, turn = _drive_tricycle(s, u, p, out)
    elif kind == OMNI:
        vx, vy, turn = _drive_omni(s, u, p, out)
    else:
        vx, vy, turn = _drive_ticks(s, u, p, out)
    c = math.cos(s[2])
    sn = math.sin(s[2])
    out[0] = c * vx - sn * vy
    out[1] = sn * vx + c * vy
    out[2] = turn


@kernel(allocates=True)
def integrate(states: Array, command: Array, kind: int, p: Array, dt: float) -> None:
    """Fills states (T + 1, 8) of which the first is given, under commands (T, C) of `dt` [s]."""
    k1 = np.zeros(STATES)
    k2 = np.zeros(STATES)
    k3 = np.zeros(STATES)
    k4 = np.zeros(STATES)
    for t in range(len(command)):
        s = states[t]
        u = command[t]
        _compute_rates(kind, s, u, p, k1)
        _compute_rates(kind, s + 0.5 * dt * k1, u, p, k2)
        _compute_rates(kind, s + 0.5 * dt * k2, u, p, k3)
        _compute_rates(kind, s + dt * k3, u, p, k4)
        states[t + 1] = s + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@dataclass(frozen=True)
class ForeignRobot:
    """A robot of a simulator of its own."""

    physics: int  # its equations of motion
    values: tuple[float, ...]  # their parameters
    commands: dict[
        str, tuple[float, float]
    ]  # least and greatest, by name in the mapping
    robot: dict[str, Any]  # what a user would say of it in a mapping
    latency_s: float = 0.06  # from a command's stamp to its effect
    delays_s: tuple[float, ...] = ()  # of the commands after that; none if empty
    slew: tuple[
        float, ...
    ] = ()  # greatest rates of the commands, by the robot's own driver
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)  # pose of the tracked body
    pose_s: float = 0.01  # between poses
    ticks_per_turn: int = 0  # of encoders that are recorded in place of commands


ROBOTS: dict[str, ForeignRobot] = {
    "skid_steer": ForeignRobot(
        SKID_STEER,
        (30.0, 2.2, 0.25, 0.18, 0.24, 0.6, 0.15, 0.08),
        {"forward_command": (-1.0, 1.0), "turn_command": (-1.5, 1.5)},
        {"kind": "skid_steer", "footprint_radius": 0.4, "parameters": {"track": 0.48}},
        mounting=(0.15, 0.0, 0.3),
    ),
    "throttle_car": ForeignRobot(
        THROTTLE_CAR,
        (0.1, 8.0, 7.0, 0.25, 0.12, 0.26, 0.4, 0.06, 0.035, 0.015, 0.03),
        {"throttle": (-0.2, 0.5), "steering": (-1.0, 1.0)},
        {
            "kind": "ackermann_throttle",
            "footprint_radius": 0.25,
            "parameters": {"wheelbase": 0.26},
        },
        latency_s=0.04,
        mounting=(0.08, 0.0, 0.1),
    ),
    "tricycle": ForeignRobot(
        TRICYCLE,
        (0.9, 0.15, 180.0, 22.0),
        {"speed_command": (-0.5, 1.2), "steering_command": (-1.1, 1.1)},
        {
            "kind": "tricycle",
            "footprint_radius": 0.6,
            "angular_is": "steering",
            "parameters": {"wheelbase": 0.9},
        },
        mounting=(0.25, 0.12, 0.5),
        latency_s=0.1,
        delays_s=(0.0, 0.15),
    ),
    "omni": ForeignRobot(
        OMNI,
        (0.2, 0.07, 0.08, 0.09, 1.0, 0.99, 1.015),
        {"vx": (-0.8, 0.8), "vy": (-0.8, 0.8), "wz": (-2.0, 2.0)},
        {"kind": "omnidirectional", "footprint_radius": 0.25},
        mounting=(0.05, -0.03, -0.2),
        latency_s=0.05,
        delays_s=(0.0, 0.0, 0.1),
        pose_s=0.02,
    ),
    "ticks": ForeignRobot(
        TICKS,
        (0.0975, 0.0985, 0.34, 0.1),
        {"left_wheel": (-4.0, 8.0), "right_wheel": (-4.0, 8.0)},
        {"kind": "differential_wheels", "footprint_radius": 0.25},
        latency_s=0.0,
        mounting=(-0.1, 0.0, 0.0),
        pose_s=0.02,
        ticks_per_turn=2048,
    ),
}
ROBOTS["slewed_tricycle"] = replace(ROBOTS["tricycle"], slew=(0.6, 1.0), delays_s=())


@dataclass(frozen=True)
class ForeignDrive:
    """A drive as it was recorded."""

    robot: ForeignRobot
    pose: Stream  # (T, 3) of the tracked body
    command: Stream  # (T, C), or counters of encoders before they overflow

    def write(self, folder: Path) -> Path:
        """Writes CSV with headers into a folder and returns the mapping to read it by."""
        folder.mkdir(parents=True, exist_ok=True)
        values = self.command.values
        counts = self.robot.ticks_per_turn
        poses = folder / "poses.csv"
        _write_csv(poses, ("x", "y", "yaw"), self.pose.t, self.pose.values)
        _write_csv(
            folder / "commands.csv",
            tuple(self.robot.commands),
            self.command.t,
            np.mod(values, COUNTER) if counts else values,
        )
        extra = {}
        if counts:
            extra = {"unit": "ticks", "ticks_per_turn": counts, "wrap": COUNTER}
        mapping = {
            "robot": self.robot.robot,
            "time": "stamp",
            "pose": {"in": "poses.csv", "x": "x", "y": "y", "heading": "yaw"},
            "command": {
                name: {"from": f"commands.csv:{name}", **extra}
                for name in self.robot.commands
            },
        }
        place = folder.parent / f"{folder.name}.yaml"
        place.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
        return place


def foreign_drive(
    robot: ForeignRobot, seed: int, duration_s: float = 90.0
) -> ForeignDrive:
    """Drives a robot by commands of many levels, holds, ramps and rests."""
    rng = np.random.default_rng(seed)
    fine = round(duration_s / STEP_S)
    stride = round(robot.pose_s / STEP_S)
    stamp = np.arange(0.0, duration_s, COMMAND_S)
    columns = [_varied(rng, stamp, low, high) for low, high in robot.commands.values()]
    values = np.stack(columns, axis=1)
    delays = robot.latency_s + np.array(robot.delays_s or np.zeros(len(columns)))
    sent = np.arange(fine)[:, None] * STEP_S - delays + 1e-9
    acting = np.searchsorted(stamp, sent, "right") - 1
    states = np.zeros((fine + 1, STATES))
    command = np.where(
        acting < 0, 0.0, np.take_along_axis(values, np.maximum(acting, 0), axis=0)
    )
    if robot.slew:
        command = _slewed(command, np.array(robot.slew) * STEP_S)
    parameters = np.append(robot.values, np.zeros(12 - len(robot.values)))
    integrate(states, command, robot.physics, parameters, STEP_S)
    seen = states[::stride]
    t = STEP_S * stride * np.arange(len(seen))
    pose = geometry.compose(seen[:, :3], np.array(robot.mounting))
    pose = pose + POSE_NOISE * rng.normal(size=pose.shape)
    commands = Stream(stamp, values)
    if robot.ticks_per_turn:
        counts = np.floor(seen[:, 5:7] * robot.ticks_per_turn / (2.0 * np.pi))
        commands = Stream(t, counts)
    return ForeignDrive(robot, Stream(t, pose), commands)


def _slewed(command: Array, most: Array) -> Array:
    """Returns commands (T, C) that follow others by at most so much (C,) per step."""
    slewed = np.zeros_like(command)
    for k in range(1, len(command)):
        slewed[k] = slewed[k - 1] + np.clip(command[k] - slewed[k - 1], -most, most)
    return slewed


def _varied(rng: np.random.Generator, t: Array, low: float, high: float) -> Array:
    """Returns a command at times (T,): segments that rest, hold one of some levels, or ramp."""
    values = np.zeros(len(t))
    k = round(1.0 / COMMAND_S)
    before = 0.0
    while k < len(t):
        count = round(rng.uniform(*SEGMENT_S) / COMMAND_S)
        draw = rng.random()
        level = (
            rng.choice(np.linspace(low, high, LEVELS)) if draw > REST + RAMP else 0.0
        )
        if REST < draw <= REST + RAMP:
            ramp = np.linspace(before, rng.uniform(low, high), count)
            values[k : k + count] = ramp[: len(t) - k]
        else:
            values[k : k + count] = level
        k += count
        before = float(values[min(k, len(t)) - 1])
    return values


def _write_csv(path: Path, names: tuple[str, ...], t: Array, values: Array) -> None:
    head = ",".join(("stamp", *names))
    rows = np.column_stack([t, values])
    np.savetxt(path, rows, "%.17g", ",", header=head, comments="")
