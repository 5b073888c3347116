"""Converts the roles of a bag's topics to a mapping."""

import re
from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from nics_drl_bridge.errors import RecordingError, suggest
from nics_drl_bridge.recording.bag_file import Message, read_times
from nics_drl_bridge.recording.bag_table import Bag, make_message_table
from nics_drl_bridge.recording.imu_axis import AXES, find_table_axis
from nics_drl_bridge.recording.mapping import ARRIVAL, HEADER, UNITS, DriveMapping
from nics_drl_bridge.recording.messages import POSITION_UNITS, WHEELS
from nics_drl_bridge.recording.stamping import TopicData
from nics_drl_bridge.recording.table import Table, read_numbers
from nics_drl_bridge.recording.topic_roles import JointSource, TopicRoles, assign
from nics_drl_bridge.robot.spec import RobotSpec

TIMES = {"auto": None, "header": HEADER, "receive": ARRIVAL}
JOINT_FIELD = re.compile(r"(position|velocity)\[(.+)\]")
TWIST = {
    "vx": "twist.twist.linear.x",
    "vy": "twist.twist.linear.y",
    "wz": "twist.twist.angular.z",
}
Streams = dict[str, dict[str, dict[str, Any]]]  # values as a mapping writes them


def write_mapping(roles: TopicRoles, bag: Bag, spec: RobotSpec) -> DriveMapping:
    """Returns the mapping of a bag by the roles of its topics, and guesses missing roles.

    Raises RecordingError if a role is unclear, or does not fit the robot.
    """
    topics = assign(roles, bag.file.types, bag.file.empty, bag.place)
    mapping: dict[str, Any] = {
        "time": TIMES[roles.stamps],
        "pose": {
            "in": topics.get("pose") or topics["odom"],
            "frame": roles.frame,
            "child_frame": roles.child_frame,
            "covariance": "",
        },
        "command": topics["cmd_vel"],
    }
    if "pose" in topics and "odom" in topics:
        mapping["odometry"] = {"in": topics["odom"], **TWIST}
    if "imu" in topics:
        mapping["imu"] = {"in": topics["imu"], **_map_imu(bag, topics["imu"])}
    if "joint_states" in topics:
        topic = topics["joint_states"]
        streams = map_joints(bag.get_table(topic), spec, roles)
        mapping["state"] = {
            name: {**value, "from": f"{topic}:{value['from']}"}
            for name, value in streams.get("state", {}).items()
        }
        if "wheels" in streams:
            mapping["wheels"] = {"in": topic, **streams["wheels"]}
    return DriveMapping.model_validate(mapping)


def _map_imu(bag: Bag, topic: str) -> dict[str, Any]:
    """Returns the values of an IMU in any mounting."""
    table = bag.get_table(topic)
    axis = find_table_axis(lambda name: read_numbers(table, name))
    if not axis.is_usual:
        note = (
            f"imu: according to gravity its axis {axis.name} points up, so that is its "
            "yaw axis."
        )
        bag.add_note(topic, note)
    rate = {"from": f"angular_velocity.{AXES[axis.place]}", "scale": axis.sign}
    return {
        "ax": "linear_acceleration.x",
        "ay": "linear_acceleration.y",
        "yaw_rate": rate,
    }


def map_joints(table: Table, spec: RobotSpec, roles: TopicRoles) -> Streams:
    """Returns the values of `state` and `wheels`, each if the joints show it.

    Raises RecordingError if a joint is missing that is needed, or a state is unknown.
    """
    streams = {
        "state": _map_state(table, spec, roles),
        "wheels": _map_wheels(table, roles),
    }
    return {name: values for name, values in streams.items() if values}


def _map_state(
    table: Table, spec: RobotSpec, roles: TopicRoles
) -> dict[str, dict[str, Any]]:
    names = [variable.name for variable in spec.state]
    for name in sorted(roles.state.keys() - set(names)):
        raise RecordingError(
            f"{table.place}: robot {spec.name!r} has no state {name!r}; "
            f"{suggest(name, names)}"
        )
    is_needed = bool(roles.state) or any(v.must_be_measured for v in spec.state)
    joints = _list_joints(table)
    values = {}
    for variable in spec.state:
        source = roles.state.get(variable.name) or _match_joint(joints, variable.name)
        if isinstance(source, str):
            source = JointSource(joint=source)
        if source is not None:
            _check_joint(table, source.joint)
            usual = "position" if variable.unit in POSITION_UNITS else "velocity"
            values[variable.name] = {
                "from": f"{source.field or usual}[{source.joint}]",
                "scale": source.scale,
                "unit": variable.unit if variable.unit in UNITS else None,
            }
        elif is_needed:
            others = ", ".join(joints) or "none"
            raise RecordingError(
                f"{table.place}: no joint is known for the state {variable.name!r}; "
                f"its joints are {others}: name it in the topics file, as in state: "
                f"{{{variable.name}: JOINT}}."
            )
    return values if len(values) == len(names) else {}


def _map_wheels(table: Table, roles: TopicRoles) -> dict[str, dict[str, Any]]:
    chosen: tuple[str, ...] = roles.wheels or ()
    for name in chosen:
        _check_joint(table, name)
    if not chosen:
        joints = [
            name[len("velocity[") : -1]
            for name in table.names
            if name.startswith("velocity[")
            and np.isfinite(read_numbers(table, name)).any()
        ]
        chosen = tuple(filter(None, (_match_joint(joints, wheel) for wheel in WHEELS)))
    if len(chosen) < len(WHEELS):
        return {}
    left, right = ({"from": f"velocity[{name}]"} for name in chosen)
    return {"left": left, "right": right}


def _list_joints(table: Table) -> list[str]:
    """Returns the names of the joints in messages about them."""
    found = (JOINT_FIELD.fullmatch(name) for name in table.names)
    return list(dict.fromkeys(match[2] for match in found if match))


def _check_joint(table: Table, name: str) -> None:
    joints = _list_joints(table)
    if name not in joints:
        raise RecordingError(
            f"{table.place}: has no joint {name!r}; {suggest(name, joints)}"
        )


def _match_joint(names: Iterable[str], wanted: str) -> str | None:
    """Returns the only joint whose name has all words of the wanted name, in any order."""
    words = set(wanted.split("_"))
    fitting = [
        name for name in names if words <= set(re.split(r"[^a-z]+", name.lower()))
    ]
    if wanted in fitting:
        return wanted
    return fitting[0] if len(fitting) == 1 else None


def read_joint_streams(
    topic: str,
    messages: Sequence[Message],
    spec: RobotSpec,
    roles: TopicRoles,
    place: str,
) -> dict[str, TopicData]:
    """Reads `state` and `wheels` from messages in memory. Raises RecordingError if one fails."""
    plain = []
    for message in messages:
        joints = message.content  # of rclpy or rosbags
        copy = SimpleNamespace(
            name=list(joints.name),
            position=np.array(joints.position),
            velocity=np.array(joints.velocity),
        )
        plain.append(Message(message.receive_ns, copy))
    table = make_message_table(f"{place}: topic {topic!r}", plain)
    streams = {}
    for name, values in map_joints(table, spec, roles).items():
        columns = [
            value.get("scale", 1.0) * read_numbers(table, value["from"])
            for value in values.values()
        ]
        rows = np.stack(columns, axis=1)
        is_whole = np.asarray(np.isfinite(rows).all(axis=1))
        if not is_whole.any():
            raise RecordingError(
                f"{table.place}: no message contains all of {', '.join(values)}; check "
                "what the joints' driver publishes."
            )
        streams[name] = TopicData(topic, *read_times(messages), rows).rows(is_whole)
    return streams
