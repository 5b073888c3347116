"""Synthetic drives of a car, each with exactly one planted defect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from identify.drives import follow_twists, scale, with_values
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import RobotSpec, build_robot

STEP_S = 0.005
COMMAND_S = 0.05
POSE_S = 0.02
LATENCY_S = 0.06
POSITION_NOISE_M = 0.001
HEADING_NOISE_RAD = 0.002

Defect = Callable[[Recording], Recording]


def held_values(
    rng: np.random.Generator, low: float, high: float, count: int, every: int
) -> np.ndarray:
    """Returns random values (count,) that are held for `every` rows."""
    levels = rng.uniform(low, high, count // every + 1)
    return np.repeat(levels, every)[:count]


def with_pose(
    recording: Recording, values: np.ndarray, t: np.ndarray | None = None
) -> Recording:
    """Returns a recording with other poses."""
    stamps = recording.pose.t if t is None else t
    return replace(recording, pose=Stream(stamps, values, "robot"))


def scaled(**factors: Sequence[float]) -> Defect:
    """Multiplies the columns of streams."""
    return lambda drive: scale(drive, **factors)


def swapped_axes(drive: Recording) -> Recording:
    """Exchanges x and y."""
    return with_pose(drive, drive.pose.values[:, [1, 0, 2]])


def swapped_commands(drive: Recording) -> Recording:
    """Exchanges the columns of the command."""
    return with_values(drive, command=drive.command.values[:, ::-1])


def stamped(ahead_s: float, rate: float = 1.0) -> Defect:
    """Stamps the poses by a clock that is ahead, or runs faster."""
    return lambda drive: with_pose(
        drive, drive.pose.values, drive.pose.t * rate + ahead_s
    )


def frozen_pose(drive: Recording) -> Recording:
    """Repeats the first pose."""
    return with_pose(drive, np.tile(drive.pose.values[:1], (len(drive.pose.t), 1)))


def jump(at: float, by: float) -> Defect:
    """Moves all poses from a time [s] on [m]."""

    def jumped(drive: Recording) -> Recording:
        values = drive.pose.values.copy()
        values[drive.pose.t >= at, 1] += by
        return with_pose(drive, values)

    return jumped


def gap(start: float, end: float) -> Defect:
    """Loses the poses between two times [s]."""

    def lost(drive: Recording) -> Recording:
        keep = (drive.pose.t <= start) | (drive.pose.t >= end)
        return with_pose(drive, drive.pose.values[keep], drive.pose.t[keep])

    return lost


TRACK_M = 0.3
WHEEL_RADIUS_M = 0.05
WHEEL_LAG_S = 0.15


def wheeled() -> RobotSpec:
    """A robot of two driven wheels, of which the wheels' speeds are recorded too."""
    given = {
        "name": "two_wheels",
        "textbook": "differential",
        "footprint_radius": 0.25,
        "parameters": {
            "wheel_radius": WHEEL_RADIUS_M,
            "track": TRACK_M,
            "wheel_lag": WHEEL_LAG_S,
        },
        "state": [
            {"name": f"{side}_wheel", "unit": "rad/s", "min": -40.0, "max": 40.0}
            for side in ("left", "right")
        ],
        "command": [
            {
                "name": "forward_command",
                "unit": "m/s",
                "min": -1.0,
                "max": 1.5,
                "cmd_vel": "linear.x",
            },
            {
                "name": "turn_command",
                "unit": "rad/s",
                "min": -2.0,
                "max": 2.0,
                "cmd_vel": "angular.z",
            },
        ],
    }
    return build_robot(given, {})


def wheeled_drive(duration: float = 60.0, two_values: bool = False) -> Recording:
    """A drive of the robot with two wheels, without a defect; its commands may take two values."""
    rng = np.random.default_rng(0)
    count = round(duration / STEP_S)
    speed = held_values(rng, -0.5, 1.0, count, round(0.9 / STEP_S))
    turn = held_values(rng, -1.5, 1.5, count, round(0.7 / STEP_S))
    command = np.stack([speed, turn], axis=1)
    if two_values:
        command = np.where(command > [0.25, 0.0], [1.0, 1.5], [-0.5, -1.5])
    else:
        command[: round(1.0 / STEP_S)] = 0.0
    told = round(COMMAND_S / STEP_S)
    command = np.repeat(command[::told], told, axis=0)[:count]
    late = round(LATENCY_S / STEP_S)
    forward, around = np.vstack([np.zeros((late, 2)), command[: count - late]]).T
    apart = around * TRACK_M / 2.0
    asked = np.stack([forward - apart, forward + apart], axis=1) / WHEEL_RADIUS_M
    share = STEP_S / WHEEL_LAG_S
    wheels = lfilter([0.0, share], [1.0, share - 1.0], asked, axis=0)
    left, right = WHEEL_RADIUS_M * wheels.T
    twist = [(left + right) / 2.0, 0.0 * left, (right - left) / TRACK_M]
    poses = follow_twists(np.stack(twist, axis=1), STEP_S)
    rows = round(POSE_S / STEP_S)
    noise = np.array([POSITION_NOISE_M, POSITION_NOISE_M, HEADING_NOISE_RAD])
    poses = poses[::rows] + noise * rng.normal(size=(len(poses[::rows]), 3))
    t = STEP_S * np.arange(count)
    return Recording(
        Stream(t[::told], command[::told]),
        Stream(t[::rows], poses),
        state=Stream(t[::rows], wheels[::rows]),
        source="planted drive",
    )
