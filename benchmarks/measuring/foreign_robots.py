"""Drives of robots in simulators of their own, with all that is true of them.

What a recorder sees: commands at 20 Hz that act after a latency, poses of a motion capture whose
tracked body sits somewhere on the robot, or encoders that overflow. Everything follows from a seed.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from measuring import foreign_physics as physics
from measuring.truths import Truth
from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Recording, Stream

STEP_S = 0.001
COMMAND_S = 0.05
POSE_NOISE = np.array([0.0005, 0.0005, 0.001])  # standard deviations [m, m, rad]
SEGMENT_S = (0.4, 2.5)
LEVELS = 7  # commands that are held take one of so many levels of their range
# shares of segments at zero, and of ramps
REST = 0.1
RAMP = 0.3
COUNTER = 2**16  # where the encoders' counters overflow


@dataclass(frozen=True)
class ForeignRobot:
    """A robot of a simulator of its own."""

    physics: int  # its equations of motion, see `foreign_physics`
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
    # the tracked point's x is defined, as no other point moves alike
    arm_known: bool = True
    dead_zone: float | None = None  # greatest throttle at which it stands
    wheels: dict[str, float] = field(default_factory=dict)  # radii and base [m]
    ticks_per_turn: int = 0  # of encoders that are recorded in place of commands

    @property
    def truth(self) -> Truth:
        """All that a model may be compared with."""
        x, y, heading = self.mounting
        mounting = {"rotation_rad": -heading, "lever_arm_y_m": y}
        return Truth(
            None if self.ticks_per_turn or self.slew else self.latency_s,
            mounting | ({"lever_arm_x_m": x} if self.arm_known else {}),
            self.dead_zone,
            {name: (size, size) for name, size in self.wheels.items()},
        )


def throttle_car() -> ForeignRobot:
    """A car of 1:10 by throttle: dead zone, motor curve, drag, understeer, slip."""
    dead = 0.1
    pull = 8.0
    rolling = 0.25
    values = (dead, pull, 7.0, rolling, 0.12, 0.26, 0.4, 0.06, 0.035, 0.015, 0.03)
    return ForeignRobot(
        physics.THROTTLE_CAR,
        values,
        {"throttle": (-0.2, 0.5), "steering": (-1.0, 1.0)},
        {
            "kind": "ackermann_throttle",
            "footprint_radius": 0.25,
            "parameters": {"wheelbase": 0.26},
        },
        latency_s=0.04,
        mounting=(0.08, 0.0, 0.1),
        dead_zone=dead + (1.0 - dead) * rolling / pull,
    )


ROBOTS: dict[str, ForeignRobot] = {
    "skid_steer": ForeignRobot(
        physics.SKID_STEER,
        (30.0, 2.2, 0.25, 0.18, 0.24, 0.6, 0.15, 0.08),
        {"forward_command": (-1.0, 1.0), "turn_command": (-1.5, 1.5)},
        {"kind": "skid_steer", "footprint_radius": 0.4, "parameters": {"track": 0.48}},
        mounting=(0.15, 0.0, 0.3),
        arm_known=False,
    ),
    "throttle_car": throttle_car(),
    "tricycle": ForeignRobot(
        physics.TRICYCLE,
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
        physics.OMNI,
        (0.2, 0.07, 0.08, 0.09, 1.0, 0.99, 1.015),
        {"vx": (-0.8, 0.8), "vy": (-0.8, 0.8), "wz": (-2.0, 2.0)},
        {"kind": "omnidirectional", "footprint_radius": 0.25},
        mounting=(0.05, -0.03, -0.2),
        latency_s=0.05,
        delays_s=(0.0, 0.0, 0.1),
        pose_s=0.02,
    ),
    "ticks": ForeignRobot(
        physics.TICKS,
        (0.0975, 0.0985, 0.34, 0.1),
        {"left_wheel": (-4.0, 8.0), "right_wheel": (-4.0, 8.0)},
        {"kind": "differential_wheels", "footprint_radius": 0.25},
        latency_s=0.0,
        mounting=(-0.1, 0.0, 0.0),
        pose_s=0.02,
        ticks_per_turn=2048,
        wheels={"left_m": 0.0975, "right_m": 0.0985, "base_m": 0.34},
    ),
}
ROBOTS["slewed_tricycle"] = replace(ROBOTS["tricycle"], slew=(0.6, 1.0), delays_s=())


@dataclass(frozen=True)
class ForeignDrive:
    """A drive as it was recorded."""

    robot: ForeignRobot
    pose: Stream  # (T, 3) of the tracked body
    command: Stream  # (T, C), or counters of encoders before they overflow

    def recording(self) -> Recording:
        """Returns the streams; counters as the wheel speeds [rad/s] up to the next stamp."""
        command = self.command
        turn = self.robot.ticks_per_turn
        if turn:
            speed = np.diff(command.values, axis=0) / np.diff(command.t)[:, None]
            command = Stream(command.t[:-1], speed * 2.0 * np.pi / turn)
        return Recording(command, self.pose, source=self.robot.robot["kind"])

    def write(self, folder: Path) -> Path:
        """Writes CSV with headers into a folder and returns the mapping to read it by."""
        folder.mkdir(parents=True, exist_ok=True)
        values = self.command.values
        counts = self.robot.ticks_per_turn
        _write_csv(
            folder / "poses.csv", ("x", "y", "yaw"), self.pose.t, self.pose.values
        )
        _write_csv(
            folder / "commands.csv",
            tuple(self.robot.commands),
            self.command.t,
            np.mod(values, COUNTER).astype(int) if counts else values,
        )
        extra = (
            {"unit": "ticks", "ticks_per_turn": counts, "wrap": COUNTER}
            if counts
            else {}
        )
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
    states = np.zeros((fine + 1, physics.STATES))
    command = np.where(
        acting < 0, 0.0, np.take_along_axis(values, np.maximum(acting, 0), axis=0)
    )
    if robot.slew:
        command = _slewed(command, np.array(robot.slew) * STEP_S)
    parameters = np.append(robot.values, np.zeros(12 - len(robot.values)))
    physics.integrate(states, command, robot.physics, parameters, STEP_S)
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
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("stamp", *names))
        rows.writerows(
            (f"{a:.4f}", *row) for a, row in zip(t, values.tolist(), strict=True)
        )
