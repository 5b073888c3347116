"""Synthetic drives of a car, each with exactly one planted defect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from identify.drives import with_values
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
    recording: Recording,
    values: np.ndarray,
    t: np.ndarray | None = None,
    clock: str = "robot",
) -> Recording:
    """Returns a recording with other poses."""
    stamps = recording.pose.t if t is None else t
    return replace(recording, pose=Stream(stamps, values, clock))


def scaled_pose(x: float = 1.0, y: float = 1.0, heading: float = 1.0) -> Defect:
    """Multiplies the columns of the pose."""
    return lambda drive: with_pose(drive, drive.pose.values * np.array([x, y, heading]))


def scaled_command(speed: float = 1.0, steering: float = 1.0) -> Defect:
    """Multiplies the columns of the command."""
    return lambda drive: with_values(
        drive, command=drive.command.values * np.array([speed, steering])
    )


def swapped_axes(drive: Recording) -> Recording:
    """Exchanges x and y."""
    return with_pose(drive, drive.pose.values[:, [1, 0, 2]])


def swapped_commands(drive: Recording) -> Recording:
    """Exchanges the columns of the command."""
    return with_values(drive, command=drive.command.values[:, ::-1])


def ahead(seconds: float, clock: str = "robot") -> Defect:
    """Stamps the poses by a clock that is ahead; that it is another one is told if it is named."""
    return lambda drive: with_pose(
        drive, drive.pose.values, drive.pose.t + seconds, clock
    )


def drifting(share: float) -> Defect:
    """Stamps the poses by a clock that runs faster by a share."""
    return lambda drive: with_pose(
        drive, drive.pose.values, drive.pose.t * (1.0 + share)
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


def duplicated_rows(drive: Recording) -> Recording:
    """Writes every row of the poses twice."""
    return with_pose(
        drive, np.repeat(drive.pose.values, 2, axis=0), np.repeat(drive.pose.t, 2)
    )


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


def rounded(values: np.ndarray, low: float, high: float, levels: int) -> np.ndarray:
    """Rounds values to so many levels from the least to the greatest."""
    step = (high - low) / (levels - 1)
    return low + step * np.round((values - low) / step)


def wheeled_drive(seed: int = 0, duration: float = 60.0, levels: int = 0) -> Recording:
    """A drive of the robot with two wheels, without a defect.

    Its commands take so many `levels`, or any value if that is 0.
    """
    rng = np.random.default_rng(seed)
    count = round(duration / STEP_S)
    speed = held_values(rng, -0.5, 1.0, count, round(0.9 / STEP_S))
    turn = held_values(rng, -1.5, 1.5, count, round(0.7 / STEP_S))
    if levels:
        speed = rounded(speed, -0.5, 1.0, levels)
        turn = rounded(turn, -1.5, 1.5, levels)
    command = np.stack([speed, turn], axis=1)
    if not levels:
        command[: round(1.0 / STEP_S)] = 0.0
    told = round(COMMAND_S / STEP_S)
    command = np.repeat(command[::told], told, axis=0)[:count]
    late = round(LATENCY_S / STEP_S)
    acting = np.concatenate([np.zeros((late, 2)), command[: count - late]])
    wheels = np.zeros((count, 2))
    poses = np.zeros((count, 3))
    x = y = heading = left = right = 0.0
    for k, (forward, around) in enumerate(acting):
        poses[k] = x, y, heading
        wheels[k] = left, right
        rolling = WHEEL_RADIUS_M * (left + right) / 2.0
        x += STEP_S * rolling * np.cos(heading)
        y += STEP_S * rolling * np.sin(heading)
        heading += STEP_S * WHEEL_RADIUS_M * (right - left) / TRACK_M
        left += (
            STEP_S
            * ((forward - around * TRACK_M / 2.0) / WHEEL_RADIUS_M - left)
            / WHEEL_LAG_S
        )
        right += (
            STEP_S
            * ((forward + around * TRACK_M / 2.0) / WHEEL_RADIUS_M - right)
            / WHEEL_LAG_S
        )
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


def scaled_wheels(left: float = 1.0, right: float = 1.0) -> Defect:
    """Multiplies the speeds of the wheels, as of encoders that count backwards."""

    def scaled(drive: Recording) -> Recording:
        assert drive.state is not None
        values = drive.state.values * np.array([left, right])
        return with_values(drive, state=values)

    return scaled
