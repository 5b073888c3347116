"""Goals in other frames than the map's, by the estimate, the newest odometry and `/tf_static`."""

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.middleware.measurement import ODOM
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.robot_topics import RobotTopics


class GoalFrames:
    """Knows where the frames of a robot are: map, odometry, the robot, and what is mounted on it.

    The frames of odometry and robot are those of its `odom`; `base_frame` is another name of the
    latter. What moves on the robot, so is told on `/tf` alone, is not followed.
    """

    def __init__(self, node: Node, topics: RobotTopics) -> None:
        self._node, self._topics = node, topics
        self._mounted: dict[str, tuple[str, Array]] = {}  # frame: its parent, and its pose there
        self._transforms = conversions.message_type("tf2_msgs/msg/TFMessage")
        self._heard = None
        if self._transforms is not None:
            given = self._transforms, "/tf_static", self._take, qos.FIXED_TRANSFORMS
            self._heard = node.create_subscription(*given)

    def close(self) -> None:
        """Ends the subscription."""
        if self._heard is not None:
            self._node.destroy_subscription(self._heard)

    def _take(self, message: Any) -> None:
        for each in message.transforms:
            place, turn = each.transform.translation, each.transform.rotation
            heading = conversions.heading_of(turn.x, turn.y, turn.z, turn.w)
            parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            self._mounted[child] = parent, np.array([place.x, place.y, heading])

    def in_map(self, goal: PoseStamped) -> Array:
        """Returns x, y (2,) of a goal in the map, as the robot stands now. Raises ConfigError."""
        place = np.array([goal.pose.position.x, goal.pose.position.y, 0.0])
        frame = asked = goal.header.frame_id.strip("/")
        known = [str(self._node.get_parameter(f"{name}_frame").value) for name in ("map", "base")]
        odom, robot = (each.strip("/") for each in self._topics.frames)
        bases = {known[1], robot} - {""}
        for _ in range(len(self._mounted) + 1):
            if frame in ("", known[0]):
                return place[:2]
            if frame in bases or (frame == odom and odom):
                return self._from_robot(place, asked, frame == odom)
            if frame not in self._mounted:
                break
            frame, mount = self._mounted[frame]
            place = geometry.compose(mount, place)
        names = ", ".join(repr(each) for each in sorted({known[0], odom, *bases} - {""}))
        heard = "one that /tf_static joins to them"
        if self._transforms is None:
            heard = "install tf2_msgs for those that /tf_static joins to them"
        why = f"a goal in the frame {asked!r} is refused, which is not known here"
        raise ConfigError(f"goal_pose: {why}; give it in {names}, or {heard}.")

    def _from_robot(self, place: Array, frame: str, of_odometry: bool) -> Array:
        newest = self._topics.middleware.cache.newest.get(ODOM)
        if newest is None or not self._topics.located:
            why = f"a goal in the frame {frame!r} is refused, as the robot's place is not known yet"
            raise ConfigError(f"goal_pose: {why}; give it again when odometry and pose have come.")
        pose, now_ns = self._topics.view().pose, self._topics.newest_ns
        if of_odometry:  # the robot has gone on since the newest odometry
            reported, twist = newest.value
            since_s = (now_ns - newest.stamp_ns) * S_PER_NS
            place = geometry.between(
                geometry.compose(reported, geometry.exp(twist * since_s)), place
            )
        there: Array = geometry.compose(pose, place)[:2]
        return there
