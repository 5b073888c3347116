"""CommandInlet: the commands of one robot, in whatever message they come."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.nodes import conversions, wire
from nics_drl_bridge.nodes.graph import owner

Array = NDArray[np.float64]
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
SWITCH = {STAMPED: "enable_stamped_cmd_vel:=false", TWIST: "enable_stamped_cmd_vel:=true"}
"""What to set to hear the other type than this one."""
QUIET_S = 5.0


class CommandInlet:
    """Listens to `cmd_vel`, and to `ackermann_cmd` where the robot steers and the message exists.

    A stamped command is judged as ros2_control's drive controllers do: a stamp of zero counts as
    now, and one that is older than the command timeout is ignored.

    Args:
        node: that listens; its parameter `enable_stamped_cmd_vel` says to which type.
        namespace: of the robot below the node's, empty or with a slash at its end.
        robot: what commands mean.
        quality: of the subscriptions.
        take: is given each command (C,).
        too_old: whether a stamp [ns] is too old to be obeyed.
    """

    def __init__(
        self,
        node: Node,
        namespace: str,
        robot: RobotSpec,
        quality: QoSProfile,
        take: Callable[[Array], None],
        too_old: Callable[[int], bool],
    ) -> None:
        self._node, self._robot, self._take, self._too_old = node, robot, take, too_old
        stamped = bool(node.get_parameter("enable_stamped_cmd_vel").value)
        self._kind = STAMPED if stamped else TWIST
        kind, hear = (TwistStamped, self._on_stamped) if stamped else (Twist, self._on_bytes)
        self._topic: str = node.create_subscription(
            kind, f"{namespace}cmd_vel", hear, quality, raw=not stamped
        ).topic_name
        self._warned: set[str] = set()
        self._steering = steering_of(robot)
        if self._steering is not None:
            self._listen_to_ackermann(f"{namespace}ackermann_cmd", quality)

    def _listen_to_ackermann(self, topic: str, quality: QoSProfile) -> None:
        try:
            kind = import_module("ackermann_msgs.msg").AckermannDriveStamped
        except ModuleNotFoundError:
            return  # an option of those who have it
        self._node.create_subscription(kind, topic, self._on_ackermann, quality)

    def _on_bytes(self, content: bytes) -> None:
        try:
            self._obey(wire.twist_of(content))
        except wire.UNREADABLE as error:
            self._complain(f"a message that can't be read ({error}) is ignored")

    def _obey(self, twist: tuple[float, float, float]) -> None:
        if all(map(math.isfinite, twist)):
            self._take(self._robot.from_cmd_vel(twist))
        else:
            self._complain("NaN or inf ignored")

    def _on_stamped(self, message: TwistStamped) -> None:
        if self._is_fresh(message.header.stamp):
            twist = message.twist
            self._obey((twist.linear.x, twist.linear.y, twist.angular.z))

    def _on_ackermann(self, message: Any) -> None:
        command = np.empty(2)
        command[list(self._steering or ())] = message.drive.speed, message.drive.steering_angle
        if not np.isfinite(command).all():
            self._complain("NaN or inf ignored")
        elif self._is_fresh(message.header.stamp):
            self._take(command)

    def _is_fresh(self, stamp: Any) -> bool:
        stamp_ns = conversions.stamp_from_ros(stamp)
        if stamp_ns and self._too_old(stamp_ns):
            self._complain(
                "a command is ignored, because its stamp is older than command_timeout; do both "
                "ends take their time from the same clock (use_sim_time)?"
            )
            return False
        return True

    def _complain(self, what: str) -> None:
        self._node.get_logger().warning(f"{self._topic}: {what}", throttle_duration_sec=QUIET_S)

    def watch(self) -> None:
        """Warns once of each node that publishes the other type, which is never heard."""
        for end in self._node.get_publishers_info_by_topic(self._topic):
            kind, who = end.topic_type, owner(end)
            if kind == self._kind or who is None or f"{who} {kind}" in self._warned:
                continue
            self._warned.add(f"{who} {kind}")
            switch = SWITCH[self._kind] if kind in SWITCH else "another type there"
            self._node.get_logger().warning(
                f"{self._topic}: {who} publishes {kind}, but {self._kind} is expected here, so "
                f"that its commands are not heard; let it publish that, or set {switch}."
            )


def steering_of(robot: RobotSpec) -> tuple[int, int] | None:
    """Which commands are speed [m/s] and steering angle [rad]; None where the robot has others."""
    units = [variable.unit for variable in robot.command]
    return (units.index("m/s"), units.index("rad")) if sorted(units) == ["m/s", "rad"] else None
