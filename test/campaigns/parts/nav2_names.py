"""Names that a parameter file of Nav2 expects of a robot: topics, frames, actions, with types."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    qos_check_compatible,
)

# What nodes of Nav2 say to each other, and the frame of a lidar that its own simulator plays.
OWN = {
    "",
    "cmd_vel_smoothed",
    "cmd_vel_raw",
    "cmd_vel_nav",
    "cmd_vel_teleop",
    "collision_monitor_state",
    "base_scan",
    "speed_filter_mask",
    "keepout_filter_mask",
}
OWN_ENDS = (
    "costmap_raw",
    "published_footprint",
    "filter_info",
    "/voxel_grid",
    "costmap_updates",
)
FRAME_KEYS = ("frame", "frame_id")
TYPES = {
    "scan": "sensor_msgs/msg/LaserScan",
    "odom": "nav_msgs/msg/Odometry",
    "odometry/filtered": "nav_msgs/msg/Odometry",
    "map": "nav_msgs/msg/OccupancyGrid",
    "cmd_vel": "geometry_msgs/msg/Twist",
    "clock": "rosgraph_msgs/msg/Clock",
    "tf": "tf2_msgs/msg/TFMessage",
    "tf_static": "tf2_msgs/msg/TFMessage",
    "initialpose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "goal_pose": "geometry_msgs/msg/PoseStamped",
    "speed_limit": "nav2_msgs/msg/SpeedLimit",
}
# What its nodes use without naming it, as their defaults.
ALWAYS = {"map", "cmd_vel", "clock", "tf", "tf_static", "initialpose", "goal_pose"}


def walk_texts(given: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yields all texts in a tree, each with the key that it stands under."""
    if isinstance(given, Mapping):
        for name, each in given.items():
            yield from walk_texts(each, str(name))
    elif isinstance(given, str):
        yield key, given


def read_wanted(file: Path) -> tuple[set[str], set[str]]:
    """Returns topics and frames that a parameter file names and that Nav2 does not make itself."""
    topics = set(ALWAYS)
    frames = set[str]()
    for key, value in walk_texts(yaml.safe_load(file.read_text(encoding="utf-8"))):
        name = value.strip("/")
        if name in OWN or name.endswith(OWN_ENDS) or key == "polygon_pub_topic":
            continue
        if key.endswith(FRAME_KEYS):
            frames.add(name)
        elif key == "topic" or key.endswith("_topic"):
            topics.add(name)
    return topics, frames


# the others are published
HEARD = ("cmd_vel", "initialpose", "goal_pose", "speed_limit")
# The other end, as Nav2 opens it: reliable, and for some with what was sent before.
ENDLESS = {"depth": 1, "deadline": Infinite, "liveliness_lease_duration": Infinite}
USUAL = QoSProfile(**ENDLESS)
KEPT = QoSProfile(durability=DurabilityPolicy.TRANSIENT_LOCAL, **ENDLESS)
LATCHED = {"map": KEPT, "tf_static": KEPT}
ACTIONS = {
    "follow_path": "nav2_msgs/action/FollowPath",
    "navigate_to_pose": "nav2_msgs/action/NavigateToPose",
}


def find_unserved_topics(node: Node, topics: set[str]) -> list[str]:
    """Returns a line for each topic that nobody serves, with its type and quality of service."""
    return [fault for topic in sorted(topics) if (fault := _find_fault(node, topic))]


def _find_fault(node: Node, topic: str) -> str:
    kind = TYPES.get(topic)
    name = f"/{topic}"
    if kind is None:
        return f"{topic}: nothing of that name is known"
    look = "subscriptions" if topic in HEARD else "publishers"
    ends = getattr(node, f"get_{look}_info_by_topic")(name)
    ends = [end for end in ends if end.node_name != node.get_name()]
    kinds = {end.topic_type for end in ends}
    if not kinds & {kind, kind.replace("Twist", "TwistStamped")}:
        return f"{topic}: no {look} of {kind}, but {sorted(kinds) or 'none'}"
    asked = LATCHED.get(topic, USUAL)
    for end in ends:
        pair = (asked, end.qos_profile) if topic in HEARD else (end.qos_profile, asked)
        fit, reason = qos_check_compatible(*pair)
        if fit == QoSCompatibility.ERROR:
            return f"{topic}: {reason.strip().rstrip(';')}"
    return ""


def find_unserved_actions(node: Node) -> list[str]:
    """Returns a line for each action that nobody serves."""
    served = dict(node.get_service_names_and_types())
    return [
        f"{name}: nobody serves the action"
        for name, kind in ACTIONS.items()
        if f"{kind}_SendGoal" not in served.get(f"/{name}/_action/send_goal", ())
    ]


def list_frames(messages: list[Any]) -> set[str]:
    """Returns all frames that messages of `/tf` and `/tf_static` have told of."""
    transforms = [each for message in messages for each in message.transforms]
    parents = {transform.header.frame_id for transform in transforms}
    return parents | {transform.child_frame_id for transform in transforms}
