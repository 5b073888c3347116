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
from nics_drl_bridge.recording.pose_source import guess_source_by_names
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
FEWEST_MESSAGES = 20
PERCENTILES = (5.0, 50.0, 95.0)
SPANNED = 0.9  # fraction of a uniform distribution between the outer percentiles


def load_bag(
    path: str | Path, spec: RobotSpec | None, mapping: TopicRoles
) -> Recording:
    """Reads a robot's drive from a bag, and guesses missing roles of topics.

    Raises RecordingError if the bag is damaged or does not fit the robot.
    """
    if spec is None:
        raise RecordingError(f"{path}: is a bag; say of which robot, with a RobotSpec.")
    with open_bag(path) as bag:
        topics = roles.assign(mapping, bag.types, bag.empty, bag.place)
        pose = topics.get("pose") or topics["odom"]
        data = {
            "command": _read_command(bag, topics["cmd_vel"], spec),
            "pose": _read_pose(bag, pose, mapping),
        }
        if "pose" in topics and "odom" in topics:
            data["odometry"] = _read_rows(bag, topics["odom"], msgs.read_twist)
        topic = topics.get("joint_states")
        if topic:
            data |= read_joint_streams(
                topic, bag.read_messages(topic), spec, mapping, bag.place
            )
        repairs: tuple[str, ...] = ()
        if "imu" in topics:
            data["imu"], axis = _read_imu(bag, topics["imu"])
            if not axis.is_usual:
                note = f"imu: by gravity its axis {axis.name} points up, so that is its yaw axis."
                repairs = (note,)
        latency = measure_latency(bag, topics.get("odom"))
        measured_by = guess_source_by_names((pose,), bag.types[pose])
    recorded: Any = stamp_streams(data, mapping.stamps, str(path))
    recording = Recording(
        **recorded,
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
    messages: Sequence[Message] | None = None,
) -> TopicData:
    if messages is None:
        messages = bag.read_messages(topic)
    receive_ns, header_ns = read_times(messages)
    values = np.array([row(m.content) for m in messages], dtype=np.float64)
    for k in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
        raise RecordingError(
            f"{bag.place}: topic {topic!r}: message {k} holds NaN or inf; find out why "
            "it was sent, cut the bag there, or choose another topic."
        )
    return TopicData(topic, receive_ns, header_ns, values)


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
            raise RecordingError(
                f"{bag.place}: topic {topic!r} holds steering angles [rad], but "
                f"{variable.name!r} of robot {spec.name!r} is in {variable.unit}; "
                "choose the robot that drove, or another topic."
            )
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
        raise RecordingError(
            f"{bag.place}: topic {topic!r}: message {k}: the quaternion has the length "
            f"{length[k]:.3f} and not 1; check its publisher, or choose another topic."
        )
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
    """Returns the transforms between two frames, by default between the only two.

    Raises RecordingError if no pair of frames fits, or several do.
    """
    transforms: dict[tuple[str, str], list[Message]] = {}
    for message in messages:
        for transform in getattr(message.content, "transforms", (message.content,)):
            pair = msgs.get_frames(transform)
            part = Message(message.receive_ns, transform)
            transforms.setdefault(pair, []).append(part)
    pairs = [
        (parent, child_frame)
        for parent, child_frame in transforms
        if frame is None or frame.strip("/") == parent
        if child is None or child.strip("/") == child_frame
    ]
    if len(pairs) == 1:
        return transforms[pairs[0]]
    problem = "no transform"
    if pairs:
        problem = "several transforms"
    if frame or child:
        problem += " with the given names"
    frames = ", ".join(sorted(" -> ".join(pair) for pair in transforms)) or "none"
    raise RecordingError(
        f"{bag.place}: topic {topic!r} holds {problem}; write those of the robot into "
        "the topics file or the map, as in `frame: world` and `child_frame: "
        f"base_link`; it holds {frames}."
    )


def read_joint_streams(
    topic: str,
    messages: Sequence[Message],
    spec: RobotSpec,
    mapping: TopicRoles,
    place: str,
) -> dict[str, TopicData]:
    """Returns `state` and `wheels`, each if the joints show it. Raises like `extract_state`."""
    joints = gather_joints(topic, messages)
    streams = {
        "state": extract_state(joints, spec, mapping, place),
        "wheels": extract_wheels(joints, mapping, place),
    }
    return {name: data for name, data in streams.items() if data is not None}


class Joints(NamedTuple):
    """Messages about J joints as one table, with NaN where a message lacks a joint."""

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
        joints = message.content
        columns = [names.index(name) for name in joints.name]
        if len(joints.position) == len(columns):
            position[row, columns] = joints.position
        if len(joints.velocity) == len(columns):
            velocity[row, columns] = joints.velocity
    return Joints(topic, *read_times(messages), names, position, velocity)


def extract_state(
    joints: Joints, spec: RobotSpec, mapping: TopicRoles, place: str
) -> TopicData | None:
    """Returns the measured state (T, S), or None without joints.

    Raises RecordingError if a joint is missing that is needed, or a state is unknown.
    """
    names = [variable.name for variable in spec.state]
    for name in sorted(mapping.state.keys() - set(names)):
        raise RecordingError(
            f"{place}: topics: robot {spec.name!r} has no state {name!r}; "
            f"{suggest(name, names)}"
        )
    columns = []
    sources = []
    for variable in spec.state:
        source = _find_joint(joints, variable, mapping, place)
        if source is not None:
            sources.append(source.joint)
            columns.append(_read_joint(joints, variable, source))
        elif mapping.state or any(variable.must_be_measured for variable in spec.state):
            fault = f"no joint is known for the state {variable.name!r}"
            others = ", ".join(joints.names) or "none"
            raise RecordingError(
                f"{place}: {fault}; the joints of {joints.topic!r} are {others}: name "
                f"it in the topics file, as in state: {{{variable.name}: JOINT}}."
            )
    if not names or len(columns) < len(names):
        return None
    return _select_complete(joints, np.stack(columns, axis=1), sources, place)


def _read_joint(joints: Joints, variable: StateVariable, source: JointSource) -> Array:
    """Returns the values (T,) of a state variable."""
    field = source.field
    if field is None and variable.unit in msgs.POSITION_UNITS:
        field = "position"
    table = joints.velocity
    if field == "position":
        table = joints.position
    return np.asarray(source.scale * table[:, joints.names.index(source.joint)])


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
    source = mapping.state.get(variable.name)
    if source is None:
        source = _match_joint(joints.names, variable.name)
        if source is None:
            return None
    if isinstance(source, str):
        source = JointSource(joint=source)
    _get_joint_index(joints, source.joint, place)
    return source


def _get_joint_index(joints: Joints, name: str, place: str) -> int:
    if name not in joints.names:
        raise RecordingError(
            f"{place}: topic {joints.topic!r} has no joint {name!r}; "
            f"{suggest(name, joints.names)}"
        )
    return joints.names.index(name)


def _match_joint(names: Iterable[str], wanted: str) -> str | None:
    """Returns the only joint whose name has all words of the wanted name, in any order."""
    words = set(wanted.split("_"))
    fitting = [
        name for name in names if words <= set(re.split(r"[^a-z]+", name.lower()))
    ]
    if wanted in fitting:
        return wanted
    if len(fitting) == 1:
        return fitting[0]
    return None


def _select_complete(
    joints: Joints, values: Array, names: Sequence[str], place: str
) -> TopicData:
    keep = np.asarray(np.isfinite(values).all(axis=1))
    if not keep.any():
        raise RecordingError(
            f"{place}: topic {joints.topic!r}: no message tells the position or "
            f"velocity that is needed of {', '.join(names)}; check what the joints' "
            "driver publishes."
        )
    return TopicData(joints.topic, joints.receive_ns, joints.header_ns, values).rows(
        keep
    )


def measure_latency(bag: BagFile, odom: str | None = None) -> Latency:
    """Measures the delays of scan and odometry on the recorder's own clock, if a bag shows them."""
    odom = odom or _find_topic(bag, roles.ODOMETRY, "odom")
    return Latency(
        scan=_measure_delay(bag, _find_topic(bag, SCAN, "scan")),
        odom=_measure_delay(bag, odom),
    )


def _find_topic(bag: BagFile, kind: str, name: str) -> str | None:
    """Returns the only topic of a type, or the only one of several with the usual name."""
    topics = [
        topic
        for topic, topic_kind in bag.types.items()
        if topic_kind == kind and topic not in bag.empty
    ]
    if len(topics) > 1:
        topics = [topic for topic in topics if re.search(rf"(^|/){name}$", topic)]
    if len(topics) != 1:
        return None
    return topics[0]


def _measure_delay(bag: BagFile, topic: str | None) -> Delay | None:
    if topic is None:
        return None
    messages = bag.read_messages(topic)
    receive_ns, stamps_ns = read_times(messages)
    if len(messages) < FEWEST_MESSAGES or stamps_ns is None or not stamps_ns.all():
        return None
    delay = (receive_ns - stamps_ns) * S_PER_NS
    if hasattr(messages[0].content, "ranges"):
        # A scan's stamp is the time of its first beam.
        for k, message in enumerate(messages):
            scan = message.content
            increment = max(0.0, float(scan.time_increment))
            delay[k] -= increment * max(len(scan.ranges) - 1, 0)
    low, middle, high = np.percentile(delay, PERCENTILES)
    if not SAME_CLOCK_S[0] <= middle <= SAME_CLOCK_S[1]:
        return None
    jitter = float(high - low) / SPANNED
    return Delay(least=max(0.0, float(middle) - jitter / 2.0), jitter=jitter)
