"""What every listening node shares: a robot's topics, fed into the middleware."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.view import Middleware
from nics_drl_bridge.nodes import conversions, qos


class RobotTopics:
    """Subscribes to `scan`, `odom` and `cmd_vel` and keeps the middleware up to date.

    Data are used at their own stamps; a command, which has none, at the stamp of the newest
    datum before it. The first odometry fixes where `map` is.

    Args:
        node: whose topics they are.
        model: of the robot.
        on_odometry: called with the stamp [ns] after each odometry that was used.
        on_scan: called with the stamp [ns] after each scan that was used.
    """

    def __init__(
        self,
        node: Node,
        model: SimulatorModel,
        on_odometry: Callable[[int], None] | None = None,
        on_scan: Callable[[int], None] | None = None,
    ) -> None:
        self._node, self._robot, self._lidar = node, model.robot, model.lidar
        self.middleware = Middleware(model)
        self.newest_ns = 0
        self._started = False
        self._on_odometry, self._on_scan = on_odometry, on_scan
        node.create_subscription(LaserScan, "scan", self._take_scan, qos.SENSOR)
        node.create_subscription(Odometry, "odom", self._take_odometry, qos.SENSOR)
        node.create_subscription(Twist, "cmd_vel", self._take_command, qos.COMMAND)

    def restart(self) -> None:
        """Forgets everything; the next odometry fixes `map` anew."""
        self._started = False
        self.newest_ns = 0

    def view(self) -> RobotView:
        """What is known at the stamp of the newest datum."""
        return self.middleware.view(self.newest_ns)

    def _arrival_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _take_scan(self, message: LaserScan) -> None:
        stamp = conversions.stamp_from_ros(message.header.stamp)
        ranges = conversions.scan_from_ros(self._lidar, message)
        if self.middleware.scan(stamp, self._arrival_ns(), ranges):
            self.newest_ns = max(self.newest_ns, stamp)
            if self._on_scan is not None:
                self._on_scan(stamp)

    def _take_odometry(self, message: Odometry) -> None:
        stamp = conversions.stamp_from_ros(message.header.stamp)
        pose, twist = conversions.odometry_from_ros(message)
        if not self._started and np.isfinite(pose).all():
            self.middleware.reset(stamp, pose)
            self._started = True
        if self.middleware.odometry(stamp, self._arrival_ns(), pose, twist):
            self.newest_ns = max(self.newest_ns, stamp)
            if self._on_odometry is not None:
                self._on_odometry(stamp)

    def _take_command(self, message: Twist) -> None:
        command = self._robot.from_cmd_vel(conversions.twist_from_ros(message))
        if not np.isfinite(command).all():
            # One NaN would make the estimate NaN for ever.
            self.middleware.cache.reject("cmd_vel: NaN or inf")
            return
        self.middleware.command(self.newest_ns, command)
