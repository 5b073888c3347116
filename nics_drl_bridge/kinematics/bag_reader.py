"""Reads a rosbag2 recording, SQLite or MCAP, without ROS."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import BridgeError, RecordingError
from nics_drl_bridge.kinematics import topic_roles
from nics_drl_bridge.kinematics.bag_messages import (
    Row,
    command_row,
    imu_row,
    pose_row,
    quaternion,
    stamp,
    typestore,
)
from nics_drl_bridge.kinematics.joints import JointMessage, gather, state_of, wheels_of
from nics_drl_bridge.kinematics.recording import Recording, check
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.stamping import TopicData, streams
from nics_drl_bridge.kinematics.topic_roles import TopicRoles, assign

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

Array = NDArray[np.float64]

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
QUATERNION_TOLERANCE = 0.05


@dataclass(frozen=True)
class _Message:
    receive_ns: int
    content: Any


def is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 recording: its folder, or one of its files."""
    if path.is_dir():
        return (path / METADATA).is_file() or any(p.suffix in SUFFIXES for p in path.iterdir())
    return path.suffix in SUFFIXES


def load_bag(path: Path, mapping: TopicRoles, spec: RobotSpec) -> Recording:
    """Reads a drive of a robot from a bag.

    Args:
        path: the bag's folder, or its one file.
        mapping: which topic plays which role; what it leaves out is guessed.
        spec: the robot.

    Returns:
        The recording; for its clocks see `stamping.streams`.

    Raises:
        RecordingError: the bag is damaged or incomplete, a topic is missing or ambiguous, or
            the data can't be used for this robot; one sentence with place and fix.
    """
    place = str(path)
    with _opened(path) as reader:
        types = {t: str(i.msgtype) for t, i in reader.topics.items() if i.msgcount > 0}
        topics = assign(mapping, types, place)
        if "pose" in topics:
            topics.pop("odom", None)
        bag = _Bag(reader, place, mapping)
        data = {
            "command": _command(bag, topics["cmd_vel"], types[topics["cmd_vel"]], spec),
            "pose": _pose(bag, topics.get("pose") or topics["odom"]),
        }
        if "joint_states" in topics:
            data |= _joints(bag, topics["joint_states"], spec)
        if "imu" in topics:
            data["imu"] = bag.data(topics["imu"], imu_row)
    made = streams(data, mapping.stamps, place)
    return check(Recording(**made, source=place, variables=spec.variable_names), spec)


@contextmanager
def _opened(path: Path) -> Iterator[Reader]:
    """Opens a bag; whatever a damaged one makes the library raise becomes one sentence."""
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise RecordingError(
            f"{path}: reading a bag needs the library rosbags; install it with "
            "pip install 'nics_drl_bridge[bags]'."
        ) from None
    try:
        with Reader(_file(path)) as reader:
            _check_metadata(path, reader)
            yield reader
    except BridgeError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged file breaks the reader in any way
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise RecordingError(
            f"{path}: can't be read as a bag ({reason:.200}); it is damaged or was not closed: "
            "try `ros2 bag reindex`, or record anew."
        ) from None


def _file(path: Path) -> Path:
    """The folder where it has metadata, else its one file."""
    if not path.exists():
        raise RecordingError(f"{path}: no such bag; check the path.")
    if not path.is_dir() or (path / METADATA).is_file():
        file = path
    else:
        files = [p for p in sorted(path.iterdir()) if p.suffix in SUFFIXES]
        if len(files) != 1:
            raise RecordingError(
                f"{path}: holds {len(files)} bag files and no {METADATA}; write it with "
                "`ros2 bag reindex`."
            )
        file = files[0]
    if file.suffix == ".db3":
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as base:
            (verdict,) = base.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise RecordingError(f"{file}: is damaged ({verdict}); record the drive anew.")
    return file


def _check_metadata(path: Path, reader: Reader) -> None:
    counted = sum(info.msgcount for info in reader.topics.values())
    if reader.message_count != counted:
        raise RecordingError(
            f"{path}: its summary speaks of {reader.message_count} messages, those of its topics "
            f"add up to {counted}; it is damaged: try `ros2 bag reindex`, or record anew."
        )
    if counted == 0:
        raise RecordingError(f"{path}: holds no messages; record a drive of 20 s or more.")


class _Bag:
    """An open bag whose topics are read whole or not at all."""

    def __init__(self, reader: Reader, place: str, roles: TopicRoles) -> None:
        self._reader, self.place, self.roles = reader, place, roles
        self._store = typestore()

    def messages(self, topic: str) -> list[_Message]:
        """All messages of a topic, with its count and time span held against the metadata."""
        reader = self._reader
        connections = reader.topics[topic].connections
        kinds = {connection.msgtype for connection in connections}
        if len(kinds) != 1:
            raise RecordingError(
                f"{self.place}: topic {topic!r} holds messages of several types "
                f"({', '.join(sorted(kinds))}); record it from one publisher."
            )
        found = [
            _Message(receive_ns, self._store.deserialize_cdr(raw, connection.msgtype))
            for connection, receive_ns, raw in reader.messages(connections)
        ]
        promised = sum(connection.msgcount for connection in connections)
        if len(found) != promised:
            raise RecordingError(
                f"{self.place}: topic {topic!r} has {len(found)} messages where the bag's summary "
                f"promises {promised}; the bag is cut off or damaged: record the drive anew."
            )
        early = min(m.receive_ns for m in found) < reader.start_time
        if early or max(m.receive_ns for m in found) >= reader.end_time:
            raise RecordingError(
                f"{self.place}: topic {topic!r} has messages outside of the time span that the "
                "bag's summary gives; the bag is damaged: record the drive anew."
            )
        return found

    def data(self, topic: str, row: Callable[[Any], Row]) -> TopicData:
        """The rows of a topic."""
        return _table(topic, self.messages(topic), row)


def _table(topic: str, messages: list[_Message], row: Callable[[Any], Row]) -> TopicData:
    receive = np.array([m.receive_ns for m in messages], dtype=np.int64)
    header = None
    if hasattr(messages[0].content, "header"):
        header = np.array([stamp(m.content) for m in messages], dtype=np.int64)
    values = np.array([row(m.content) for m in messages], dtype=np.float64)
    return TopicData(topic, receive, header, values)


def _command(bag: _Bag, topic: str, kind: str, spec: RobotSpec) -> TopicData:
    """Commands (T, C) of the robot."""
    if kind in (topic_roles.ACKERMANN, topic_roles.ACKERMANN_STAMPED):
        for variable in spec.command:
            if variable.cmd_vel == "angular.z" and variable.unit != "rad":
                raise RecordingError(
                    f"{bag.place}: topic {topic!r} holds steering angles [rad], but "
                    f"{variable.name!r} of robot {spec.name!r} is in {variable.unit}; choose the "
                    "robot that drove, or another topic."
                )
    data = bag.data(topic, command_row)
    values = spec.from_cmd_vel(data.values)
    return TopicData(topic, data.receive_ns, data.header_ns, values)


def _pose(bag: _Bag, topic: str) -> TopicData:
    messages = _of_one_body(bag, topic, bag.messages(topic))
    quaternions = np.array([quaternion(m.content) for m in messages])
    length = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(~(np.abs(length - 1.0) < QUATERNION_TOLERANCE))[:1]:
        raise RecordingError(
            f"{bag.place}: topic {topic!r}: message {k}: the quaternion has the length "
            f"{length[k]:.3f} and not 1; check its publisher, or choose another topic."
        )
    return _table(topic, messages, pose_row)


def _of_one_body(bag: _Bag, topic: str, messages: list[_Message]) -> list[_Message]:
    """The messages about the body that `child_frame` names, or about the only one."""
    if not hasattr(messages[0].content, "transform"):
        return messages
    frames = dict.fromkeys(m.content.child_frame_id for m in messages)
    wanted = bag.roles.child_frame or (next(iter(frames)) if len(frames) == 1 else None)
    if wanted not in frames:
        raise RecordingError(
            f"{bag.place}: topic {topic!r} holds transforms of {', '.join(sorted(frames))}; name "
            "the robot's with `child_frame` in the topics file."
        )
    return [m for m in messages if m.content.child_frame_id == wanted]


def _joints(bag: _Bag, topic: str, spec: RobotSpec) -> dict[str, TopicData]:
    joints = gather(
        topic,
        [
            JointMessage(
                m.receive_ns, stamp(m.content), m.content.name, m.content.position,
                m.content.velocity,
            )
            for m in bag.messages(topic)
        ],
    )  # fmt: skip
    state = state_of(joints, spec, bag.roles, bag.place)
    wheels = wheels_of(joints, bag.roles, bag.place)
    return {n: d for n, d in (("state", state), ("wheels", wheels)) if d is not None}
