"""Reads a drive from a rosbag2 recording, SQLite or MCAP, without ROS.

Latency in a bag: the delay from a message's stamp to its receipt.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording import topic_roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, opened
from nics_drl_bridge.recording.joints import JointMessage, gather, state_of, wheels_of
from nics_drl_bridge.recording.messages import (
    Row,
    command_row,
    frames,
    imu_row,
    pose_row,
    quaternion,
    stamp,
    twist_row,
)
from nics_drl_bridge.recording.recording import Recording, check
from nics_drl_bridge.recording.stamping import SAME_CLOCK_S, TopicData, streams
from nics_drl_bridge.recording.topic_roles import ODOMETRY, TopicRoles, assign
from nics_drl_bridge.robot.noise import Delay, Latency
from nics_drl_bridge.robot.spec import RobotSpec

QUATERNION_TOLERANCE = 0.05


def load_bag(path: str | Path, mapping: TopicRoles, spec: RobotSpec) -> Recording:
    """Reads a drive of a robot from a bag.

    Args:
        path: the bag's folder, or its only file.
        mapping: roles of the topics; missing roles are guessed.
        spec: the robot.

    Returns:
        The recording; for its clocks see `stamping.streams`.

    Raises:
        RecordingError: the bag is damaged or incomplete, a topic is missing or ambiguous, or
            the data can't be used for this robot; one sentence with place and fix.
    """
    with opened(path) as bag:
        topics = assign(mapping, bag.types, bag.empty, bag.place)
        data = {
            "command": _command(bag, topics["cmd_vel"], spec),
            "pose": _pose(bag, topics.get("pose") or topics["odom"], mapping),
        }
        if "pose" in topics and "odom" in topics:
            odometry = bag.messages(topics["odom"])
            data["odometry"] = _table(bag, topics["odom"], odometry, twist_row)
        if "joint_states" in topics:
            data |= _joints(bag, topics["joint_states"], spec, mapping)
        if "imu" in topics:
            data["imu"] = _table(bag, topics["imu"], bag.messages(topics["imu"]), imu_row)
        latency = latency_of(bag, topics.get("odom"))
    made = streams(data, mapping.stamps, str(path))
    recording = Recording(**made, source=str(path), variables=spec.variable_names, latency=latency)
    return check(recording, spec)


def _table(
    bag: BagFile, topic: str, messages: Sequence[Message], row: Callable[[Any], Row]
) -> TopicData:
    """Converts a topic's messages to rows."""
    receive = np.array([m.receive_ns for m in messages], dtype=np.int64)
    header = None
    if hasattr(messages[0].content, "header"):
        header = np.array([stamp(m.content) for m in messages], dtype=np.int64)
    values = np.array([row(m.content) for m in messages], dtype=np.float64)
    for k in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
        raise RecordingError(
            f"{bag.place}: topic {topic!r}: message {k} holds NaN or inf; find out why it was "
            "sent, cut the bag there, or choose another topic."
        )
    return TopicData(topic, receive, header, values)


def _command(bag: BagFile, topic: str, spec: RobotSpec) -> TopicData:
    """Reads the commands (T, C) of the robot."""
    if bag.types[topic] in (topic_roles.ACKERMANN, topic_roles.ACKERMANN_STAMPED):
        for variable in spec.command:
            if variable.turns and not variable.steers:
                raise RecordingError(
                    f"{bag.place}: topic {topic!r} holds steering angles [rad], but "
                    f"{variable.name!r} of robot {spec.name!r} is in {variable.unit}; choose the "
                    "robot that drove, or another topic."
                )
    data = _table(bag, topic, bag.messages(topic), command_row)
    return replace(data, values=spec.from_cmd_vel(data.values))


def _pose(bag: BagFile, topic: str, mapping: TopicRoles) -> TopicData:
    """Reads the poses (T, 3) of the tracked body."""
    messages = bag.messages(topic)
    if bag.types[topic] in (topic_roles.TRANSFORM, topic_roles.TRANSFORMS):
        messages = _of_one_body(bag, topic, _transforms(messages), mapping)
    quaternions = np.array([quaternion(m.content) for m in messages])
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(~(np.abs(length - 1.0) < QUATERNION_TOLERANCE))[:1]:
        raise RecordingError(
            f"{bag.place}: topic {topic!r}: message {k}: the quaternion has the length "
            f"{length[k]:.3f} and not 1; check its publisher, or choose another topic."
        )
    return _table(bag, topic, messages, pose_row)


def _transforms(messages: Sequence[Message]) -> list[Message]:
    """Splits messages into one per transform."""
    return [
        Message(message.receive_ns, transform)
        for message in messages
        for transform in getattr(message.content, "transforms", (message.content,))
    ]


def _of_one_body(
    bag: BagFile, topic: str, messages: Sequence[Message], mapping: TopicRoles
) -> list[Message]:
    """Returns the transforms between the two frames of the mapping, or the only two frames."""
    wanted = (mapping.frame, mapping.child_frame)
    pairs = {
        pair
        for pair in {frames(m.content) for m in messages}
        if all(w is None or w.strip("/") == f for w, f in zip(wanted, pair, strict=True))
    }
    if len(pairs) == 1:
        return [m for m in messages if frames(m.content) in pairs]
    there = ", ".join(sorted({f"{a} -> {b}" for a, b in (frames(m.content) for m in messages)}))
    named = " with the given names" if any(wanted) else ""
    problem = "several transforms" if pairs else "no transform"
    raise RecordingError(
        f"{bag.place}: topic {topic!r} holds {problem}{named}; write those of the robot into the "
        f"topics file, as in `frame: world` and `child_frame: base_link`; it holds "
        f"{there or 'none'}."
    )


def _joints(bag: BagFile, topic: str, spec: RobotSpec, mapping: TopicRoles) -> dict[str, TopicData]:
    """Reads measured state and wheel speeds, if the joints report them."""
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
    state = state_of(joints, spec, mapping, bag.place)
    wheels = wheels_of(joints, mapping, bag.place)
    return {n: d for n, d in (("state", state), ("wheels", wheels)) if d is not None}


SCAN = "sensor_msgs/msg/LaserScan"
LEAST_MESSAGES = 20
PERCENTILES = (5.0, 50.0, 95.0)
SPANNED = 0.9
"""The share of a uniform distribution between the first and the last of these percentiles."""


def latency_of(bag: BagFile, odom: str | None = None) -> Latency:
    """Measures the delays of scan and odometry in a bag.

    Only stamps of the recorder's own clock show them. If a topic is missing, has too few messages
    or is stamped by another clock, its delay is unknown.

    Args:
        bag: an open bag.
        odom: the odometry topic; by default the one of that type or name.
    """
    scan, odom = _topic(bag, SCAN, "scan"), odom or _topic(bag, ODOMETRY, "odom")
    return Latency(
        scan=None if scan is None else _delay(bag.messages(scan)),
        odom=None if odom is None else _delay(bag.messages(odom)),
    )


def _topic(bag: BagFile, kind: str, name: str) -> str | None:
    """Returns the only topic of a type, or the only one of several with the usual name."""
    of_kind = [topic for topic, one in bag.types.items() if one == kind and topic not in bag.empty]
    named = [topic for topic in of_kind if re.search(rf"(^|/){name}$", topic)]
    found = of_kind if len(of_kind) == 1 else named
    return found[0] if len(found) == 1 else None


def _delay(messages: Sequence[Message]) -> Delay | None:
    """Fits a uniform distribution to the delays of stamped messages."""
    if len(messages) < LEAST_MESSAGES:
        return None
    stamps = np.array([stamp(m.content) for m in messages], dtype=np.int64)
    late = (np.array([m.receive_ns for m in messages], dtype=np.int64) - stamps) * S_PER_NS
    late = late - np.array([_sweep(m) for m in messages])
    low, middle, high = np.percentile(late, PERCENTILES)
    if not stamps.all() or not SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
        return None
    jitter = float(high - low) / SPANNED
    return Delay(least=max(0.0, float(middle) - jitter / 2.0), jitter=jitter)


def _sweep(message: Message) -> float:
    """Returns the time from a scan's stamp, that of beam 0, to its last beam [s]; else 0."""
    scan = message.content
    if not hasattr(scan, "ranges"):
        return 0.0
    return max(0.0, float(scan.time_increment)) * max(0, len(scan.ranges) - 1)
