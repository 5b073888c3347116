"""Reads a drive from a rosbag2 recording, SQLite or MCAP, without ROS."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording import messages as msgs
from nics_drl_bridge.recording import topic_roles as roles
from nics_drl_bridge.recording.bag_file import BagFile, Message, open_bag, read_times
from nics_drl_bridge.recording.imu_axis import AXES, UpAxis, find_up_axis, to_array
from nics_drl_bridge.recording.pose_source import guess_pose_source
from nics_drl_bridge.recording.recording import W_FIRST, Recording, check, is_w_first
from nics_drl_bridge.recording.stamping import (
    SAME_CLOCK_S,
    Nanoseconds,
    TopicData,
    stamp_streams,
)
from nics_drl_bridge.recording.topic_roles import JointSource, TopicRoles
from nics_drl_bridge.robot.noise import Delay, Latency
from nics_drl_bridge.robot.spec import RobotSpec, StateVariable

QUATERNION_TOLERANCE = 0.05
SCAN = "sensor_msgs/msg/LaserScan"
LEAST_MESSAGES = 20
PERCENTILES = (5.0, 50.0, 95.0)
SPANNED = 0.9  # share of a uniform distribution between the first and last of these percentiles


def load_bag(
    path: str | Path, spec: RobotSpec | None, mapping: TopicRoles
) -> Recording:
    """Reads a robot's drive from a bag, guessing missing roles of topics; RecordingError if bad."""
    if spec is None:
        raise RecordingError(f"{path}: is a bag; say of which robot, with a RobotSpec.")
    with open_bag(path) as bag:
        topics = roles.assign(mapping, bag.types, bag.empty, bag.place)
        data = {
            "command": _read_command(bag, topics["cmd_vel"], spec),
            "pose": _read_pose(bag, topics.get("pose") or topics["odom"], mapping),
        }
        if "pose" in topics and "odom" in topics:
            data["odometry"] = _read_rows(bag, topics["odom"], msgs.read_twist)
        if topic := topics.get("joint_states"):
            data |= read_joint_streams(
                topic, bag.read_messages(topic), spec, mapping, bag.place
            )
        repairs: tuple[str, ...] = ()
        if "imu" in topics:
            data["imu"], axis = _read_imu(bag, topics["imu"])
            if not axis.is_usual:
                told = f"imu: by gravity its axis {axis.name} points up, so that is its yaw axis."
                repairs = (told,)
        latency = measure_latency(bag, topics.get("odom"))
        pose = topics.get("pose") or topics["odom"]
        measured_by = guess_pose_source(pose, bag.types[pose])
    made: Any = stamp_streams(data, mapping.stamps, str(path))
    recording = Recording(
        **made,
        source=str(path),
        variables=spec.variable_names,
        latency=latency,
        measured_by=measured_by,
        repairs=repairs,
    )
    return check(recording, spec)


def _read_rows(
    bag: BagFile,
    topic: str,
    row: Callable[[Any], msgs.Row],
    some: Sequence[Message] | None = None,
) -> TopicData:
    messages = bag.read_messages(topic) if some is None else some
    receive, header = read_times(messages)
    values = np.array([row(m.content) for m in messages], dtype=np.float64)
    for k in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
        fault = f"topic {topic!r}: message {k} holds NaN or inf"
        advice = "find out why it was sent, cut the bag there, or choose another topic"
        raise RecordingError(f"{bag.place}: {fault}; {advice}.")
    return TopicData(topic, receive, header, values)


def _read_imu(bag: BagFile, topic: str) -> tuple[TopicData, UpAxis]:
    """Reads accelerations and yaw rates about the axis that points up."""
    messages = bag.read_messages(topic)
    accelerations = np.array(
        [to_array(m.content.linear_acceleration) for m in messages]
    )
    axis = find_up_axis(np.median(accelerations, axis=0))
    data = _read_rows(bag, topic, msgs.read_imu, messages)
    if axis.is_usual:
        return data, axis
    rates = [getattr(m.content.angular_velocity, AXES[axis.place]) for m in messages]
    values = data.values.copy()
    values[:, 2] = axis.sign * np.array(rates)
    return replace(data, values=values), axis


def _read_command(bag: BagFile, topic: str, spec: RobotSpec) -> TopicData:
    steered = bag.types[topic] in (roles.ACKERMANN, roles.ACKERMANN_STAMPED)
    for variable in spec.command:
        if steered and variable.turns and not variable.steers:
            fault = f"{bag.place}: topic {topic!r} holds steering angles [rad]"
            other = f"{variable.name!r} of robot {spec.name!r} is in {variable.unit}"
            advice = "choose the robot that drove, or another topic"
            raise RecordingError(f"{fault}, but {other}; {advice}.")
    data = _read_rows(bag, topic, msgs.read_command)
    if steered:
        commands = spec.from_fields(data.values)
    else:
        commands = spec.from_cmd_vel(data.values)
    return replace(data, values=commands)


def _read_pose(bag: BagFile, topic: str, mapping: TopicRoles) -> TopicData:
    messages = bag.read_messages(topic)
    if bag.types[topic] in (roles.TRANSFORM, roles.TRANSFORMS):
        messages = select_transforms(
            bag, topic, messages, mapping.frame, mapping.child_frame
        )
    quaternions = np.array([msgs.read_quaternion(m.content) for m in messages])
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(~(np.abs(length - 1.0) < QUATERNION_TOLERANCE))[:1]:
        fault = f"message {k}: the quaternion has the length {length[k]:.3f} and not 1"
        advice = "check its publisher, or choose another topic"
        raise RecordingError(f"{bag.place}: topic {topic!r}: {fault}; {advice}.")
    if is_w_first(quaternions):
        raise RecordingError(f"{bag.place}: topic {topic!r}: {W_FIRST}.")
    return _read_rows(bag, topic, msgs.read_pose, messages)


def select_transforms(
    bag: BagFile,
    topic: str,
    messages: Sequence[Message],
    frame: str | None,
    child: str | None,
) -> list[Message]:
    """Returns the transforms between two frames, or the only two frames; else RecordingError."""
    single = [
        (msgs.get_frames(transform), Message(message.receive_ns, transform))
        for message in messages
        for transform in getattr(message.content, "transforms", (message.content,))
    ]
    wanted = (frame, child)
    there = {pair for pair, _ in single}
    pairs = {
        pair
        for pair in there
        if all(
            w is None or w.strip("/") == f for w, f in zip(wanted, pair, strict=True)
        )
    }
    if len(pairs) == 1:
        return [message for pair, message in single if pair in pairs]
    problem = "several transforms" if pairs else "no transform"
    named = " with the given names" if any(wanted) else ""
    listed = ", ".join(sorted(f"{a} -> {b}" for a, b in there)) or "none"
    fault = f"{bag.place}: topic {topic!r} holds {problem}{named}"
    example = "as in `frame: world` and `child_frame: base_link`"
    advice = f"write those of the robot into the topics file or the map, {example}"
    raise RecordingError(f"{fault}; {advice}; it holds {listed}.")


def read_joint_streams(
    topic: str,
    messages: Sequence[Message],
    spec: RobotSpec,
    mapping: TopicRoles,
    place: str,
) -> dict[str, TopicData]:
    """Returns state and wheels, each if the joints show it; for errors see `extract_state`."""
    joints = gather_joints(topic, messages)
    state = extract_state(joints, spec, mapping, place)
    wheels = extract_wheels(joints, mapping, place)
    found = {"state": state, "wheels": wheels}
    return {name: data for name, data in found.items() if data is not None}


class Joints(NamedTuple):
    """Messages about J joints, in one table; NaN if missing in a message."""

    topic: str
    receive_ns: Nanoseconds  # (T,)
    header_ns: Nanoseconds | None  # (T,)
    names: tuple[str, ...]
    position: Array  # (T, J) [rad or m]
    velocity: Array  # (T, J) [rad/s or m/s]


def gather_joints(topic: str, messages: Sequence[Message]) -> Joints:
    """Collects messages, which may contain different joints, in one table."""
    names = tuple(
        dict.fromkeys(name for message in messages for name in message.content.name)
    )
    position, velocity = np.full((2, len(messages), len(names)), np.nan)
    for row, message in enumerate(messages):
        told = message.content
        columns = [names.index(name) for name in told.name]
        for table, values in ((position, told.position), (velocity, told.velocity)):
            if len(values) == len(columns):
                table[row, columns] = values
    return Joints(topic, *read_times(messages), names, position, velocity)


def extract_state(
    joints: Joints, spec: RobotSpec, mapping: TopicRoles, place: str
) -> TopicData | None:
    """Returns the measured state (T, S), or None without joints; RecordingError if it is needed."""
    known = [v.name for v in spec.state]
    for name in sorted(mapping.state.keys() - set(known)):
        fault = f"robot {spec.name!r} has no state {name!r}"
        raise RecordingError(f"{place}: topics: {fault}; {suggest(name, known)}")
    sources = {v.name: _find_joint(joints, v, mapping, place) for v in spec.state}
    found = [source for source in sources.values() if source is not None]
    if spec.state and len(found) == len(sources):
        columns = []
        for variable, source in zip(spec.state, found, strict=True):
            usual = "position" if variable.unit in msgs.POSITION_UNITS else "velocity"
            if (source.field or usual) == "position":
                table = joints.position
            else:
                table = joints.velocity
            columns.append(source.scale * table[:, joints.names.index(source.joint)])
        return _select_complete(
            joints, np.stack(columns, axis=1), [s.joint for s in found], place
        )
    if mapping.state or any(v.must_be_measured for v in spec.state):
        missing = next(name for name, source in sources.items() if source is None)
        fault = f"no joint is known for the state {missing!r}"
        listed = (
            f"the joints of {joints.topic!r} are {', '.join(joints.names) or 'none'}"
        )
        advice = f"name it in the topics file, as in state: {{{missing}: JOINT}}"
        raise RecordingError(f"{place}: {fault}; {listed}: {advice}.")
    return None


def extract_wheels(joints: Joints, mapping: TopicRoles, place: str) -> TopicData | None:
    """Returns the speeds (T, 2) of the left and right wheel; None without such joints."""
    guesses = (_match_joint(joints.names, wheel) for wheel in msgs.WHEELS)
    chosen = list(mapping.wheels or (name for name in guesses if name is not None))
    if len(chosen) < len(msgs.WHEELS):
        return None
    values = joints.velocity[
        :, [_get_joint_index(joints, name, place) for name in chosen]
    ]
    if mapping.wheels is None and not np.isfinite(values).all(axis=1).any():
        return None
    return _select_complete(joints, values, chosen, place)


def _find_joint(
    joints: Joints, variable: StateVariable, mapping: TopicRoles, place: str
) -> JointSource | None:
    named = mapping.state.get(variable.name)
    if named is None:
        guess = _match_joint(joints.names, variable.name)
        return None if guess is None else JointSource(joint=guess)
    source = JointSource(joint=named) if isinstance(named, str) else named
    _get_joint_index(joints, source.joint, place)
    return source


def _get_joint_index(joints: Joints, name: str, place: str) -> int:
    if name not in joints.names:
        fault = f"topic {joints.topic!r} has no joint {name!r}"
        raise RecordingError(f"{place}: {fault}; {suggest(name, joints.names)}")
    return joints.names.index(name)


def _match_joint(names: Iterable[str], wanted: str) -> str | None:
    """Returns the only joint whose name has all words of the wanted name, in any order."""
    words = set(wanted.split("_"))
    found = [name for name in names if words <= set(re.split(r"[^a-z]+", name.lower()))]
    if wanted in found:
        return wanted
    if len(found) == 1:
        return found[0]
    return None


def _select_complete(
    joints: Joints, values: Array, names: Sequence[str], place: str
) -> TopicData:
    keep = np.asarray(np.isfinite(values).all(axis=1))
    if not keep.any():
        fault = f"no message tells the position or velocity that is needed of {', '.join(names)}"
        advice = "check what the joints' driver publishes"
        raise RecordingError(f"{place}: topic {joints.topic!r}: {fault}; {advice}.")
    return TopicData(joints.topic, joints.receive_ns, joints.header_ns, values).rows(
        keep
    )


def measure_latency(bag: BagFile, odom: str | None = None) -> Latency:
    """Measures delays of scan and odometry by the recorder's own clock, as far as a bag shows."""
    odom = odom or _find_topic(bag, roles.ODOMETRY, "odom")
    return Latency(
        scan=_measure_delay(bag, _find_topic(bag, SCAN, "scan")),
        odom=_measure_delay(bag, odom),
    )


def _find_topic(bag: BagFile, kind: str, name: str) -> str | None:
    """Returns the only topic of a type, or the only one of several with the usual name."""
    of_kind = [
        topic
        for topic, one in bag.types.items()
        if one == kind and topic not in bag.empty
    ]
    named = [topic for topic in of_kind if re.search(rf"(^|/){name}$", topic)]
    found = of_kind if len(of_kind) == 1 else named
    return found[0] if len(found) == 1 else None


def _measure_delay(bag: BagFile, topic: str | None) -> Delay | None:
    messages = bag.read_messages(topic) if topic else []
    receive, stamps = read_times(messages)
    if len(messages) < LEAST_MESSAGES or stamps is None or not stamps.all():
        return None
    late = (receive - stamps) * S_PER_NS
    if hasattr(
        messages[0].content, "ranges"
    ):  # a scan's stamp is that of beam 0, not of its last
        scans = [
            (max(0.0, float(m.content.time_increment)), m.content.ranges)
            for m in messages
        ]
        late -= [increment * max(len(ranges) - 1, 0) for increment, ranges in scans]
    low, middle, high = np.percentile(late, PERCENTILES)
    if not SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
        return None
    jitter = float(high - low) / SPANNED
    return Delay(least=max(0.0, float(middle) - jitter / 2.0), jitter=jitter)
