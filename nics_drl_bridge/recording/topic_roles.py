"""TopicRoles: assignment of a robot's topics to command, pose, state and IMU."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Literal

from pydantic import Field

from nics_drl_bridge.config import Schema, load_yaml, validate
from nics_drl_bridge.errors import ConfigError, RecordingError, suggest
from nics_drl_bridge.recording.recording import MeasuredBy

Stamps = Literal["auto", "header", "receive"]
NONE = "none"
ROLES = ("cmd_vel", "pose", "odom", "joint_states", "imu")
IMU_NAMES = ("imu", "imu/data")  # usual topics of a gyro, in a robot's namespace
MOST_LISTED = 20  # maximum number of topics listed in an error
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACKERMANN = "ackermann_msgs/msg/AckermannDrive"
ACKERMANN_STAMPED = f"{ACKERMANN}Stamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
JOINTS = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"
TYPES = {
    "cmd_vel": (TWIST, TWIST_STAMPED, ACKERMANN_STAMPED, ACKERMANN),
    "pose": (POSE, POSE_COVARIANCE, TRANSFORM, TRANSFORMS, ODOMETRY),
    "odom": (ODOMETRY,),
    "joint_states": (JOINTS,),
    "imu": (IMU,),
}
"""Allowed message types of each role."""
NEVER_GUESSED = {"pose": (ODOMETRY, TRANSFORMS)}  # only if the user assigns the role
GROUND_TRUTH = r"ground_?truth"
USUAL = {
    "cmd_vel": (r"/cmd_vel$", r"/cmd_vel_stamped$", r"/(ackermann_cmd|drive)$"),
    "pose": (r"(vrpn|mocap|optitrack|vicon|qualisys)", GROUND_TRUTH, r"/pose$"),
    "odom": (r"/odom$", r"/(odom|odometry)[^/]*$", r"odom"),
    "joint_states": (r"/joint_states$", r"/joint_state[^/]*$"),
    "imu": (r"/imu(/data)?$", r"/imu[^/]*$", r"imu", r""),  # no other role has its type
}
"""Patterns of usual names, the most reliable first; the first that matches a topic decides."""


TRACKED = re.compile(
    r"vrpn|mocap|motion_?capture|optitrack|vicon|qualisys|phasespace|motive|ground_?truth|truth"
    r"|(^|[^a-z])gt([^a-z]|$)|slam|amcl|locali[sz]|(^|[^a-z])(pf|map|gps|rtk|gnss|utm|uwb)([^a-z]|$)"
    r"|aruco|april_?tag|tracker|tracked|(^|/)pf|particle_?filter",
    re.IGNORECASE,
)
ODOMETER = re.compile(r"odom|wheel|encoder|dead_?reckon", re.IGNORECASE)


def guess_source_by_names(names: Iterable[str], kind: str) -> MeasuredBy:
    """Guesses what measured poses by all names that belong to them; empty if it is unclear."""
    names = [*names]
    if any(TRACKED.search(name) for name in names):
        return "tracker"
    if kind == ODOMETRY or any(ODOMETER.search(name) for name in names):
        return "odometry"
    # Odometry does not use these types, unless its name says so.
    if kind in (POSE, POSE_COVARIANCE, TRANSFORM):
        return "tracker"
    return ""


class JointSource(Schema):
    """Source of a state variable in joint messages."""

    joint: str  # name of the joint
    # `velocity` or `position`; by default chosen by the variable's unit
    field: Literal["velocity", "position"] | None = None
    scale: float = 1.0  # factor from the message's unit to the variable's


class TopicRoles(Schema):
    """Roles of topics. Missing roles are guessed by type and usual names; `none` disables one."""

    # the commands: Twist, TwistStamped, AckermannDrive or AckermannDriveStamped
    cmd_vel: str | None = None
    # pose by motion capture or localisation: PoseStamped, PoseWithCovarianceStamped or
    # TransformStamped, or if named here TFMessage or Odometry; has priority over `odom`
    pose: str | None = None
    # Odometry; its pose is used if there is no `pose`. If named in addition to a `pose`, its twist
    # shows the noise of the odometry.
    odom: str | None = None
    joint_states: str | None = None  # JointState, for measured state and wheel speeds
    imu: str | None = None  # Imu
    # parent of the transforms to use, for a `pose` topic with several
    frame: str | None = None
    child_frame: str | None = None  # their child, the robot
    # joint of each state variable; by default guessed by the joints' names
    state: dict[str, JointSource | str] = Field(default_factory=dict)
    # left and right joint of wheel speeds; None: guessed
    wheels: tuple[str, str] | None = None
    # `header` takes all times from the messages' headers, `receive` from their receipt by the bag,
    # `auto` from the header if there is one
    stamps: Stamps = "auto"


def list_imu_topics(wanted: str, by_default: bool) -> tuple[str, ...]:
    """Returns the topics of a gyro: the wanted one, or the usual ones for `auto`.

    `none` gives no topics, and `auto` gives them only `by_default`, as for a model that was made
    with a gyro.
    """
    if wanted in (NONE, "") or (wanted == "auto" and not by_default):
        return ()
    if wanted == "auto":
        return IMU_NAMES
    return (wanted,)


def load_topic_roles(
    file: str | Path | None = None, options: Iterable[str] = ()
) -> TopicRoles:
    """Reads roles from a YAML file and options `ROLE=TOPIC`, which override it (ConfigError)."""
    roles = TopicRoles()
    if file:
        roles = load_yaml(file, TopicRoles)
    topics = parse_topics(options, ROLES)
    return validate(
        {**roles.model_dump(exclude_none=True), **topics}, TopicRoles, "topics"
    )


def parse_topics(options: Iterable[str], roles: Iterable[str]) -> dict[str, str]:
    """Parses options `ROLE=TOPIC`; returns role -> topic. Raises ConfigError."""
    topics: dict[str, str] = {}
    for option in options:
        role, _, topic = (part.strip() for part in option.partition("="))
        fault = ""
        if role not in roles:
            fault = f"unknown role {role!r}; {suggest(role, roles)}"
        elif not topic:
            fault = f"must be ROLE=TOPIC, as {role}=/my_{role}."
        elif role in topics:
            fault = f"{role} was given before; give it once."
        if fault:
            raise ConfigError(f"--topic {option!r}: {fault}")
        topics[role] = topic
    return topics


def assign(
    roles: TopicRoles, types: Mapping[str, str], empty: Collection[str], place: str
) -> dict[str, str]:
    """Assigns topics, named or guessed, to roles. Raises RecordingError if that is unclear."""
    table = _Topics(types, empty, place)
    assigned: dict[str, str] = {}
    for role in ROLES:
        topic = None
        if role != "odom" or "pose" not in assigned or roles.odom is not None:
            topic = table.choose(role, getattr(roles, role))
        if topic is not None:
            assigned[role] = topic
    for needed, words in ((("cmd_vel",), "commands"), (("pose", "odom"), "poses")):
        if assigned.keys().isdisjoint(needed):
            raise RecordingError(f"{place}: {table.describe_missing(needed, words)}")
    return assigned


@dataclass(frozen=True)
class _Topics:
    types: Mapping[str, str]  # by name
    empty: Collection[str]
    place: str  # name of the bag, for errors

    def choose(self, role: str, wanted: str | None) -> str | None:
        """Returns the topic of a role: the wanted one, or the only one with the usual name."""
        if wanted == NONE:
            return None
        if wanted is None:
            return self._guess(role)
        topic = f"/{wanted.removeprefix('/')}"
        if topic in self.empty or topic not in self.types:
            fault = "holds no messages of the" if topic in self.empty else "has no"
            topics = self._list_topics((role,))
            raise RecordingError(
                f"{self.place}: {fault} topic {topic!r} ({role}); {topics}"
            )
        if self.types[topic] not in TYPES[role]:
            raise RecordingError(
                f"{self.place}: the topic {topic!r} is of type {self.types[topic]}; "
                f"{role} must be one of {', '.join(TYPES[role])}."
            )
        return topic

    def _guess(self, role: str) -> str | None:
        """Returns the only topic with the most reliable usual name; None if no name matches."""
        fitting = self._find_fitting(role)
        for pattern in USUAL[role]:
            # A simulator publishes the true pose as odometry; other odometry is not guessed.
            is_truth = pattern == GROUND_TRUTH
            never = (TRANSFORMS,) if is_truth else NEVER_GUESSED.get(role, ())
            topics = [
                topic
                for topic in fitting
                if self.types[topic] not in never and re.search(pattern, topic)
            ]
            if len(topics) > 1:
                several = ", ".join(f"{name} ({self.types[name]})" for name in topics)
                fault = f"several topics could be {role}: {several}"
                advice = f"choose one with --topic {role}={topics[0]}"
                if role != "cmd_vel":
                    advice += f", or {role}={NONE} for none"
                raise RecordingError(f"{self.place}: {fault}; {advice}.")
            if topics:
                return topics[0]
        return None

    def describe_missing(self, roles: Sequence[str], words: str) -> str:
        """Returns a sentence that no topic has any of the roles, with the fix."""
        kinds = dict.fromkeys(chain.from_iterable(TYPES[role] for role in roles))
        advice = f"record one of type {', '.join(kinds)}"
        if roles == ("cmd_vel",):
            advice += " with the pose, since a model learns from the robot's commands"
        advice += ", or, if another topic holds them, name it with --map, which "
        advice += "`nics inspect BAG --map my.yaml` drafts"
        for role in roles:
            fitting = self._find_fitting(role)
            if fitting:
                advice = f"name one, for example with --topic {role}={fitting[0]}"
                break
        return f"no topic is known to hold the {words}; {advice}; {self._list_topics(roles)}"

    def _find_fitting(self, *roles: str) -> list[str]:
        kinds = set(chain.from_iterable(TYPES[role] for role in roles))
        return sorted(
            t for t, kind in self.types.items() if kind in kinds and t not in self.empty
        )

    def _list_topics(self, roles: Sequence[str]) -> str:
        fitting = self._find_fitting(*roles)
        topics = sorted(self.types, key=lambda topic: (topic not in fitting, topic))
        text = ", ".join(
            f"{topic} ({self.types[topic]}{', empty' * (topic in self.empty)})"
            for topic in topics[:MOST_LISTED]
        )
        if len(topics) > MOST_LISTED:
            text += f" and {len(topics) - MOST_LISTED} more"
        return f"its topics are {text}."
