"""TopicRoles: which topic of a robot is its command, its pose, its state, its IMU."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from pydantic import Field

from nics_drl_bridge.config import Schema, load_yaml, validate
from nics_drl_bridge.errors import ConfigError, RecordingError, nearest

Stamps = Literal["auto", "header", "receive"]
NONE = "none"
ROLES = ("cmd_vel", "pose", "odom", "joint_states", "imu")
REQUIRED = "cmd_vel"
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ACKERMANN = "ackermann_msgs/msg/AckermannDrive"
ACKERMANN_STAMPED = f"{ACKERMANN}Stamped"
POSE, POSE_COVARIANCE = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
TRANSFORM, ODOMETRY = "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry"
JOINTS, IMU = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
TYPES = {
    "cmd_vel": (TWIST, TWIST_STAMPED, ACKERMANN_STAMPED, ACKERMANN),
    "pose": (POSE, POSE_COVARIANCE, TRANSFORM, ODOMETRY),
    "odom": (ODOMETRY,),
    "joint_states": (JOINTS,),
    "imu": (IMU,),
}
"""The message types that can play each role."""

USUAL = {
    "cmd_vel": (r"/cmd_vel$", r"/cmd_vel_stamped$", r"/(ackermann_cmd|drive)$"),
    "pose": (r"(vrpn|mocap|optitrack|vicon|qualisys)", r"/pose$", r"/amcl_pose$"),
    "odom": (r"/odom$", r"/(odom|odometry)[^/]*$", r"odom"),
    "joint_states": (r"/joint_states$", r"/joint_state[^/]*$"),
    "imu": (r"/imu(/data)?$", r"/imu[^/]*$", r"imu"),
}
"""Usual names, the surest first; a guess takes the topics of the first that any has."""


class JointSource(Schema):
    """Where a joint's message holds a state variable.

    Attributes:
        joint: name of the joint.
        field: `velocity`, or `position`; by the variable's unit when left out.
        scale: factor from the message's unit to the variable's.
    """

    joint: str
    field: Literal["velocity", "position"] | None = None
    scale: float = 1.0


class TopicRoles(Schema):
    """Which topic plays which role. A role left out is guessed by type and usual names.

    Attributes:
        cmd_vel: the commands: Twist, TwistStamped, AckermannDrive or AckermannDriveStamped.
        pose: of motion capture or localisation: PoseStamped, PoseWithCovarianceStamped,
            TransformStamped; or Odometry when named here. Goes before `odom`.
        odom: Odometry; its pose is taken when there is no `pose`.
        joint_states: JointState, for measured state and wheel speeds.
        imu: Imu. `none` leaves a role out.
        child_frame: of a `pose` topic that holds the transforms of several bodies.
        state: joint of each state variable; guessed by the joints' names when left out.
        wheels: left and right joint whose velocities are the wheel speeds; likewise.
        stamps: `header` takes all times from the messages' headers, `receive` from when the
            bag received them, `auto` from the header where there is one.
    """

    cmd_vel: str | None = None
    pose: str | None = None
    odom: str | None = None
    joint_states: str | None = None
    imu: str | None = None
    child_frame: str | None = None
    state: dict[str, JointSource | str] = Field(default_factory=dict)
    wheels: tuple[str, str] | None = None
    stamps: Stamps = "auto"


def topic_roles(
    file: Path | None = None, options: Iterable[str] = (), stamps: str | None = None
) -> TopicRoles:
    """The roles that a YAML file and the options `ROLE=TOPIC` of a command line give.

    Raises:
        ConfigError: the file, a role or a value is wrong.
    """
    roles = load_yaml(file, TopicRoles) if file else TopicRoles()
    given: dict[str, str] = {} if stamps is None else {"stamps": stamps}
    for option in options:
        role, equals, topic = option.partition("=")
        if not equals or not topic:
            raise ConfigError(f"--topic {option!r}: must be ROLE=TOPIC, as in cmd_vel=/cmd_vel.")
        if role not in ROLES:
            raise ConfigError(f"--topic {option!r}: unknown role {role!r}; {nearest(role, ROLES)}")
        given[role] = topic
    return validate({**roles.model_dump(exclude_none=True), **given}, TopicRoles, "topics")


def assign(roles: TopicRoles, types: Mapping[str, str], place: str) -> dict[str, str]:
    """The topic of each role that is played.

    Args:
        roles: what the user said.
        types: message type of each topic that holds messages.
        place: the recording's name, for errors.

    Returns:
        role -> topic. There is a `cmd_vel`, and one of `pose` and `odom` at least.

    Raises:
        RecordingError: a topic is missing, of a wrong type, or several could play a role.
    """
    chosen = {role: _topic(role, getattr(roles, role), types, place) for role in ROLES}
    found = {role: topic for role, topic in chosen.items() if topic is not None}
    there = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())) or "none"
    if REQUIRED not in found:
        raise RecordingError(
            f"{place}: no topic is known to hold the commands; say which with --topic "
            f"cmd_vel=TOPIC, or record one; topics with messages: {there}."
        )
    if "pose" not in found and "odom" not in found:
        raise RecordingError(
            f"{place}: no topic is known to hold poses; say which with --topic pose=TOPIC or "
            f"--topic odom=TOPIC, or record one; topics with messages: {there}."
        )
    return found


def _topic(role: str, wanted: str | None, types: Mapping[str, str], place: str) -> str | None:
    if wanted == NONE:
        return None
    if wanted is None:
        return _guess(role, types, place)
    topic = wanted if wanted.startswith("/") else f"/{wanted}"
    if topic not in types:
        raise RecordingError(
            f"{place}: holds no messages of the topic {topic!r} ({role}); {nearest(topic, types)}"
        )
    if types[topic] not in TYPES[role]:
        raise RecordingError(
            f"{place}: the topic {topic!r} is of type {types[topic]}; {role} must be one of "
            f"{', '.join(TYPES[role])}."
        )
    return topic


def _guess(role: str, types: Mapping[str, str], place: str) -> str | None:
    """The one topic with the surest usual name; None when no name is usual."""
    allowed = set(TYPES[role]) - ({ODOMETRY} if role == "pose" else set())
    for pattern in USUAL[role]:
        found = sorted(t for t, kind in types.items() if kind in allowed and re.search(pattern, t))
        if len(found) > 1:
            raise RecordingError(
                f"{place}: {' and '.join(found)} could each be {role}; say which with --topic "
                f"{role}={found[0]}" + ("." if role == REQUIRED else f", or {role}={NONE}.")
            )
        if found:
            return found[0]
    return None
