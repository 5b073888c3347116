"""Frames of a bag for learning: at a fixed rate, each of the newest data received by its time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S, S_PER_NS
from nics_drl_bridge.lidar.sectors import reader_beside, reader_of
from nics_drl_bridge.lidar.spec import LidarSpec, ScanHeader, from_device
from nics_drl_bridge.middleware.measurement import CMD_VEL, ODOM, POSE, SCAN
from nics_drl_bridge.middleware.playback import played
from nics_drl_bridge.recording import messages as msgs
from nics_drl_bridge.recording.bag_file import Message

STATE = "observation.state"
RANGES = "observation.scan"
ACTION = "action"
STATE_NAMES = ("x", "y", "heading", "vx", "vy", "wz")
TWIST_NAMES = ("linear.x", "linear.y", "angular.z")
DRIVE_NAMES = ("speed", "steering_angle")  # of an AckermannDrive
LEAST_FRAMES = 2  # of an episode: one frame alone leads nowhere
MOST_FRAMES = 50_000_000
# A pose that is farther from the one before than this many times the way that the speed explains,
# and a margin [m, rad], was set anew; so was a clock that runs back by more than data come late.
EXPLAINED = 3.0
MARGIN_M = 0.2
MARGIN_RAD = 0.5
BACK_NS = NS_PER_S
ANY_LIDAR = LidarSpec(
    beams=2, angle_min=0.0, angle_max=1.0, range_min=0.0, range_max=1.0, rate=1.0
)

Nanoseconds = NDArray[np.int64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Feature:
    """A feature of T frames."""

    values: NDArray[np.float32]  # (T, D)
    names: tuple[str, ...] | None = None  # of its D elements
    info: Mapping[str, float] | None = None  # of the lidar: angles [rad] and ranges [m]


@dataclass(frozen=True)
class BagFrames:
    """T frames of E episodes, one after the other."""

    features: Mapping[str, Feature]
    lengths: NDArray[np.int64]  # (E,) frames of each episode
    fps: int  # frames per second
    received_ns: Nanoseconds  # (T,) time of each frame, on the recorder's clock
    dropped: int  # episodes left out, as they had less than `LEAST_FRAMES`


def frames_of(
    path: str | Path,
    topics: Mapping[str, str],
    model: SimulatorModel | None = None,
    fps: int | None = None,
    gap_s: float = 0.5,
) -> BagFrames:
    """Reads a bag as frames at `fps`, by default the rate of its commands in whole hertz.

    A frame has the newest datum of each topic that was received by its time, none older than
    `gap_s`. An episode ends where one is, or where the robot is placed anew. With a model, actions
    are the robot's commands, else the fields of the message; and its lidar tells what no return is.
    `topics` are by role, see `playback.chosen`. Raises RecordingError, ConfigError.
    """
    if not gap_s > 0.0:
        raise ConfigError(f"--gap {gap_s:g}: must be greater than 0 [s].")
    messages = played(path, topics)
    if CMD_VEL not in messages:
        fix = "say which topic it is, as in --topic cmd_vel=/car/drive"
        raise RecordingError(f"{path}: has no commands, so no actions; {fix}.")
    for some in messages.values():
        some.sort(key=lambda message: message.receive_ns)
    received = {role: _received(some) for role, some in messages.items()}
    if fps is None:
        apart = np.diff(received[CMD_VEL])
        if not (apart > 0).any():
            raise RecordingError(
                f"{path}: its commands have no rate; say one with --fps."
            )
        fps = max(1, round(NS_PER_S / float(np.median(apart[apart > 0]))))
    ticks = _ticks(str(path), received, fps)
    rows = {
        role: np.searchsorted(ns, ticks, side="right") - 1
        for role, ns in received.items()
    }
    episode = _episodes(ticks, rows, received, resets(messages[ODOM]), gap_s)
    numbers, lengths = np.unique(episode[episode >= 0], return_counts=True)
    long_enough = lengths >= LEAST_FRAMES
    if not long_enough.any():
        reason = f"at no time were {', '.join(sorted(rows))} all newer than {gap_s:g} s"
        raise RecordingError(
            f"{path}: {reason}; give a longer --gap, or leave a topic out."
        )
    kept = np.isin(episode, numbers[long_enough])
    made = _features(
        str(path), messages, {role: row[kept] for role, row in rows.items()}, model
    )
    left_out = int((~long_enough).sum())
    return BagFrames(
        made, lengths[long_enough].astype(np.int64), fps, ticks[kept], left_out
    )


def _received(messages: Sequence[Message]) -> Nanoseconds:
    return np.array([message.receive_ns for message in messages], dtype=np.int64)


def _ticks(place: str, received: Mapping[str, Nanoseconds], fps: int) -> Nanoseconds:
    first = max(int(ns[0]) for ns in received.values())
    count = (max(int(ns[-1]) for ns in received.values()) - first) * fps // NS_PER_S + 1
    if count > MOST_FRAMES:
        most = f"may have {MOST_FRAMES} frames and would have {count}"
        raise RecordingError(
            f"{place}: {most}; give a smaller --fps, or a part of the bag."
        )
    # In whole numbers, as a period need not be one of nanoseconds.
    return first + np.arange(max(count, 0), dtype=np.int64) * NS_PER_S // fps


def resets(odometry: Sequence[Message]) -> Indices:
    """Returns the odometry (R,) that is the first after the robot or its clock was set anew."""
    pose = np.array([msgs.pose_row(m.content) for m in odometry])
    twist = np.array([msgs.twist_row(m.content) for m in odometry])
    seconds = np.diff(_received(odometry)) * S_PER_NS
    back = np.diff(np.array([msgs.stamp(m.content) for m in odometry])) < -BACK_NS
    speed = np.hypot(twist[:, 0], twist[:, 1])
    turn = np.abs(twist[:, 2])
    way = EXPLAINED * np.maximum(speed[1:], speed[:-1]) * seconds + MARGIN_M
    turned = EXPLAINED * np.maximum(turn[1:], turn[:-1]) * seconds + MARGIN_RAD
    far = np.hypot(*np.diff(pose[:, :2], axis=0).T) > way
    round_ = np.abs(geometry.wrap_angle(np.diff(pose[:, 2]))) > turned
    return np.flatnonzero(far | round_ | back) + 1


def _episodes(
    ticks: Nanoseconds,
    rows: Mapping[str, Indices],
    received: Mapping[str, Nanoseconds],
    set_anew: Indices,
    gap_s: float,
) -> NDArray[np.int64]:
    """Returns the episode (T,) of each tick; -1 where a datum is old, or of before a reset."""
    reset_ns = np.append(np.int64(np.iinfo(np.int64).min), received[ODOM][set_anew])
    after = np.searchsorted(set_anew, rows[ODOM], side="right")
    whole = np.ones(len(ticks), dtype=bool)
    for role, row in rows.items():
        newest = received[role][row]
        whole &= (ticks - newest <= gap_s * NS_PER_S) & (newest >= reset_ns[after])
    before = np.append(False, whole[:-1])
    begins = whole & (~before | (after != np.append(-1, after[:-1])))
    return np.where(whole, np.cumsum(begins) - 1, -1)


def _features(
    place: str,
    messages: Mapping[str, list[Message]],
    rows: Mapping[str, Indices],
    model: SimulatorModel | None,
) -> dict[str, Feature]:
    where = POSE if POSE in messages else ODOM
    pose = _table(place, where, [msgs.pose_row(m.content) for m in messages[where]])
    twist = _table(place, ODOM, [msgs.twist_row(m.content) for m in messages[ODOM]])
    state = np.concatenate([pose[rows[where]], twist[rows[ODOM]]], axis=1)
    made = {STATE: Feature(state.astype(np.float32), STATE_NAMES)}
    if SCAN in messages:
        made[RANGES] = _scans(place, messages[SCAN], rows[SCAN], model)
    names, action = _actions(messages[CMD_VEL], model)
    values = _table(place, CMD_VEL, action)[rows[CMD_VEL]]
    return made | {ACTION: Feature(values.astype(np.float32), names)}


def _table(place: str, role: str, values: Sequence[Any]) -> Array:
    table = np.array(values, dtype=np.float64)
    for k in np.flatnonzero(~np.isfinite(table).all(axis=1))[:1]:
        fix = "cut the bag there, or choose another topic"
        raise RecordingError(f"{place}: {role}: message {k} holds NaN or inf; {fix}.")
    return table


def _actions(
    commands: Sequence[Message], model: SimulatorModel | None
) -> tuple[tuple[str, ...], list[Any]]:
    if model is not None:
        names = tuple(variable.name for variable in model.robot.command)
        return names, [msgs.commanded(m.content, model.robot) for m in commands]
    values = [msgs.command_row(m.content) for m in commands]
    first = commands[0].content
    if hasattr(getattr(first, "drive", first), "steering_angle"):
        return DRIVE_NAMES, [(speed, angle) for speed, _, angle in values]
    return TWIST_NAMES, values


def _scans(
    place: str, scans: Sequence[Message], rows: Indices, model: SimulatorModel | None
) -> Feature:
    """Ranges, counter-clockwise; no return and the unknown count as range_max: all are finite."""
    first = scans[0].content
    header = ScanHeader(*(float(getattr(first, name)) for name in ScanHeader._fields))
    beams = len(first.ranges)
    for k, message in enumerate(scans):
        if len(message.content.ranges) != beams:
            found = f"scan {k} has {len(message.content.ranges)} beams and the first {beams}"
            raise RecordingError(f"{place}: {found}; choose the topic of one lidar.")
    like = ANY_LIDAR if model is None else model.lidar
    reader = (reader_of if model is None else reader_beside)(header, beams, like)
    table = np.array([np.asarray(m.content.ranges, np.float32) for m in scans])
    ranges = from_device(reader.ordered(table), reader.lidar)
    low = np.float32(reader.lidar.range_min)
    high = np.float32(reader.lidar.range_max)
    ranges = np.where(
        np.isneginf(ranges), low, np.where(np.isfinite(ranges), ranges, high)
    )
    angles = reader.lidar.angles
    info = {
        "angle_min": float(angles[0]),
        "angle_max": float(angles[-1]),
        "angle_increment": float(reader.lidar.angle_increment),
        "range_min": float(reader.lidar.range_min),
        "range_max": float(reader.lidar.range_max),
    }
    return Feature(ranges[rows], None, info)
