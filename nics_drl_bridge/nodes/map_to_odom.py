"""The transform map -> odom on `/tf` from the estimate, unless another node publishes it."""

import math
import time
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import ArrayLike
from rclpy.node import Node

from nics_drl_bridge import geometry
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.message_packages import how_to_install
from nics_drl_bridge.recording import messages

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


def odom_in_map(in_map: ArrayLike, in_odom: ArrayLike) -> Array:
    """Return the pose (3,) of `odom` in `map`, from a robot's poses (3,) in both."""
    return geometry.compose(in_map, geometry.between(in_odom, np.zeros(3)))


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
        self._kind: Any = conversions.transforms_type()
        if self._kind is None:
            reason = (
                "the package tf2_msgs is not installed, so map -> odom is not published"
            )
            node.get_logger().warning(f"{reason}; {how_to_install('tf2_msgs')}.")
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
