"""Frames: goals in other ones than the map, and the transform map -> odom on `/tf`."""

import math
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy.typing import ArrayLike
from rclpy.node import Node

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.message_packages import explain_install
from nics_drl_bridge.nodes.runner import get_text
from nics_drl_bridge.recording import messages
from nics_drl_bridge.recording.topic_roles import TRANSFORMS

if TYPE_CHECKING:
    from nics_drl_bridge.nodes.robot_topics import RobotTopics

QUIET_S = 2.0  # silence of other publishers after which ours resumes [s]
KEPT = 100  # recent own transforms, to recognise them on `/tf`


def transform_to_ros(
    parent: str, child: str, pose: ArrayLike, time_ns: int
) -> TransformStamped:
    """Return the pose (3,) of a child frame in its parent as a transform."""
    x, y, heading = np.asarray(pose, np.float64).tolist()
    header = conversions.header_to_ros(time_ns, parent)
    message = TransformStamped(header=header, child_frame_id=child)
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation = conversions.heading_to_ros(heading)
    return message


def transform_from_ros(message: TransformStamped) -> tuple[str, str, Array]:
    """Return a transform's parent and child, without slashes, and the child's pose (3,) there."""
    return *messages.get_frames(message), np.array(messages.read_pose(message))


def compute_odom_in_map(in_map: ArrayLike, in_odom: ArrayLike) -> Array:
    """Return the pose (3,) of `odom` in `map`, from a robot's poses (3,) in both."""
    return geometry.compose(in_map, geometry.between(in_odom, np.zeros(3)))


def find_transforms(node: Node, lacking: str) -> Any | None:
    """Return the class of the messages on `/tf`; None, with a warning of what is lacking then."""
    kind = conversions.find_message_type(TRANSFORMS)
    if kind is None:
        node.get_logger().warning(
            f"the package tf2_msgs is not installed, so {lacking} not published; "
            f"{explain_install('tf2_msgs')}."
        )
    return kind


class MapToOdom:
    """Publishes map -> odom, stamped ahead by a tolerance [s] like AMCL's, so that it stays valid.

    It is silent without tf2_msgs, and while another node, such as a localiser, publishes it.
    """

    def __init__(self, node: Node, tolerance_s: float) -> None:
        self._node = node
        self._ahead_ns = round(tolerance_s * NS_PER_S)
        self._own: deque[Any] = deque(maxlen=KEPT)  # transforms
        self._frames = ("", "")
        self._heard_s = -math.inf
        self._kind: Any = find_transforms(node, "map -> odom is")
        if self._kind is None:
            return
        self._publisher = node.create_publisher(self._kind, "/tf", qos.TRANSFORMS)
        self._subscription = node.create_subscription(
            self._kind, "/tf", self._take, qos.TRANSFORMS
        )

    def close(self) -> None:
        """End its topics."""
        if self._kind is not None:
            self._node.destroy_subscription(self._subscription)
            self._node.destroy_publisher(self._publisher)

    def publish(self, odom: Array, stamp_ns: int, frames: tuple[str, str]) -> None:
        """Publish the pose (3,) of odom in map at a time [ns], with the frames of both."""
        self._frames = frames
        if (
            self._kind is None
            or time.monotonic() - self._heard_s < QUIET_S
            or not all(frames)
        ):
            return
        transform = transform_to_ros(*frames, odom, stamp_ns + self._ahead_ns)
        self._own.append(transform)
        self._publisher.publish(self._kind(transforms=[transform]))

    def _take(self, message: Any) -> None:
        for transform in message.transforms:
            if messages.get_frames(transform) != self._frames or transform in self._own:
                continue
            if time.monotonic() - self._heard_s > QUIET_S:
                reason = f"another node publishes {' -> '.join(self._frames)}, so this one does not"
                self._node.get_logger().info(reason)
            self._heard_s = time.monotonic()


class GoalFrames:
    """Tracks the poses of a robot's frames: map, odometry, the robot, and frames mounted on it.

    The topic `odom` names the frames of odometry and robot; `base_frame` is another name of the
    robot's. Of `/tf`, only a localiser's map -> odom is used, not the moving parts of the robot.
    """

    def __init__(self, node: Node, topics: "RobotTopics") -> None:
        self._node = node
        self._topics = topics
        # frame -> its parent, and its pose in the parent
        self._mounted: dict[str, tuple[str, Array]] = {}
        self._odom: Array | None = None  # pose of `odom` in `map`, by a localiser
        self._transforms = conversions.find_message_type(TRANSFORMS)
        self._heard = []
        if self._transforms is not None:
            for topic, take, quality in (
                ("/tf_static", self._take, qos.LATCHED),
                ("/tf", self._follow, qos.TRANSFORMS),
            ):
                self._heard.append(
                    node.create_subscription(self._transforms, topic, take, quality)
                )

    def close(self) -> None:
        """End the subscriptions."""
        while self._heard:
            self._node.destroy_subscription(self._heard.pop())

    def _take(self, message: Any) -> None:
        for parent, child, pose in map(transform_from_ros, message.transforms):
            self._mounted[child] = parent, pose
        self._follow(message)

    def _follow(self, message: Any) -> None:
        wanted = self._map, self._topics.frames[0].strip("/")
        for parent, child, pose in map(transform_from_ros, message.transforms):
            if (parent, child) == wanted:
                self._odom = pose

    @property
    def _map(self) -> str:
        return get_text(self._node, "map_frame")

    def locate_robot(self, frame: str) -> Array | None:
        """Return the robot's pose (3,) in the map or `odom`; None while it is unknown."""
        reported = self._topics.locate_in_odom()
        if reported is None or frame == self._topics.frames[0].strip("/"):
            return reported
        if frame not in ("", self._map):
            return None
        if self._odom is not None:
            return geometry.compose(self._odom, reported)
        return self._topics.view().pose if self._topics.located else None

    def in_map(self, goal: PoseStamped) -> Array:
        """Return x, y (2,) of a goal in the map, given the robot's pose now. Raises ConfigError."""
        place = np.array([goal.pose.position.x, goal.pose.position.y, 0.0])
        if not np.isfinite(place).all():
            raise ConfigError(
                f"goal_pose: ({place[0]:g}, {place[1]:g}): x and y must be finite numbers."
            )
        try:
            frame, place = self.fixed(goal.header.frame_id, place)
        except ConfigError as error:
            raise ConfigError(f"goal_pose: {error}") from None
        # by a localiser, if there is one; else by the estimate
        if frame == self._map:
            robot = None if self._odom is None else self.locate_robot(self._map)
            if robot is None:
                return place[:2]
        else:
            robot = self._topics.locate_in_odom()
            if robot is None:
                raise ConfigError(
                    "goal_pose: its place is unknown until odometry arrives; wait for it."
                )
        there: Array = geometry.compose(
            self._topics.view().pose, geometry.between(robot, place)
        )
        return there[:2]

    def fixed(self, frame: str, places: Array) -> tuple[str, Array]:
        """Return poses (..., 3) of a frame in the map or in `odom`, and the name of the one used.

        Poses in frames of the robot are in `odom`, given the robot's present pose. Raises
        ConfigError for an unknown frame, and while the robot's pose is unknown.
        """
        asked = frame = frame.strip("/")
        odom, robot = (frame.strip("/") for frame in self._topics.frames)
        bases = {get_text(self._node, "base_frame"), robot} - {""}
        for _ in range(len(self._mounted) + 1):
            if frame in ("", self._map):
                return self._map, places
            if frame in bases or (frame == odom and odom):
                reported = self._topics.locate_in_odom()
                if reported is None or not self._topics.located:
                    why = f"a goal in the frame {asked!r} is refused"
                    why = f"{why}, because the robot's pose is not known yet"
                    raise ConfigError(
                        f"{why}; send it again once odometry and pose have arrived."
                    )
                return odom, places if frame == odom else geometry.compose(
                    reported, places
                )
            if frame not in self._mounted:
                break
            frame, mount = self._mounted[frame]
            places = geometry.compose(mount, places)
        names = ", ".join(
            repr(frame) for frame in sorted({self._map, odom, *bases} - {""})
        )
        heard = "one that /tf_static joins to them"
        if self._transforms is None:
            heard = "one that /tf_static joins to them, which needs tf2_msgs"
            heard = f"{heard} ({explain_install('tf2_msgs')})"
        why = f"a goal in the frame {asked!r} is refused: the frame is not known here"
        raise ConfigError(f"{why}; give it in {names}, or {heard}.")
