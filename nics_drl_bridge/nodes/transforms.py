"""Transforms of a device: `/tf` and `/tf_static`, where the message package is there."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import ArrayLike
from rclpy.node import Node

from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.outbox import Outbox

MISSING = (
    "the message package tf2_msgs is not installed, so that neither /tf nor /tf_static is "
    "published; install it with your ROS 2 distribution."
)


def transform_message(parent: str, child: str) -> TransformStamped:
    """A transform between two frames that is still to be filled in."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    return message


def fill(message: TransformStamped, pose: ArrayLike, stamp: Any) -> TransformStamped:
    """Writes a pose (3,) of the child in the parent into a transform."""
    x, y, heading = np.asarray(pose, np.float64).tolist()
    message.header.stamp = stamp
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation = conversions.heading_to_ros(heading)
    return message


class Transforms:
    """Publishes transforms; says once, in the log, why it does not.

    Args:
        node: that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._moving: Any = None
        try:
            self._kind = import_module("tf2_msgs.msg").TFMessage
        except ModuleNotFoundError:
            node.get_logger().warning(MISSING)
            return
        self._message = self._kind()
        self._moving = node.create_publisher(self._kind, "/tf", qos.TRANSFORMS)
        self._fixed = node.create_publisher(self._kind, "/tf_static", qos.FIXED_TRANSFORMS)

    @property
    def published(self) -> bool:
        """Whether there is anybody to publish."""
        return self._moving is not None

    def tell_fixed(self, transforms: list[TransformStamped]) -> None:
        """Publishes, once, what never changes; who comes later gets it too."""
        if self.published:
            self._fixed.publish(self._kind(transforms=transforms))

    def tell(
        self,
        transforms: list[TransformStamped],
        outbox: Outbox,
        now_ns: int,
        late_ns: tuple[int, int],
    ) -> None:
        """Publishes what changes, as late as the odometry that it comes from."""
        if self.published:
            self._message.transforms = transforms
            outbox.send(self._moving, self._message, now_ns, late_ns)
