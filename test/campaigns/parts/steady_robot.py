"""A robot's topics around a gate at the rates of a vehicle, written as bytes: it costs little."""

from __future__ import annotations

import time

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from parts.spun_node import SpunNode
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.wire import OdometryWriter, ScanWriter

ROBOT = "ackermann"
SPEED = 0.5
SCAN_HZ = 10
ODOM_HZ = 50
PATIENCE_S = 120.0


class SteadyRobot(SpunNode):
    """Publishes what a robot, its policy and its estimator do, and arms the gate.

    Attributes:
        heard: (time [s], moves) of each `cmd_vel`.
        mad: whether the policy sends NaN for half a second of each.
        sent: messages of the timer so far.
    """

    def __init__(self, domain_id: int) -> None:
        super().__init__("robot", domain_id)
        lidar = builtin_model(ROBOT).lidar
        self._ranges = np.full(lidar.beams, 2.0, np.float32)
        self._scans = ScanWriter(
            conversions.scan_to_ros(lidar, self._ranges, 0, "laser")
        )
        frames = ("odom", "base_link")
        variance = (1e-4,) * 4
        self._odometries = OdometryWriter(
            conversions.odometry_to_ros(np.zeros(3), np.zeros(3), 0, frames, variance)
        )
        kinds = {
            "scan": LaserScan,
            "odom": Odometry,
            "odometry/filtered": Odometry,
            "cmd_vel_raw": TwistStamped,
            "e_stop": Bool,
        }
        self._topics = {
            name: self.node.create_publisher(kind, name, qos.COMMAND)
            for name, kind in kinds.items()
        }
        self.heard: list[tuple[float, bool]] = []
        self.sent = 0
        self._x = 0.0
        self._speed = 0.0
        self._stamp_ns = 0
        self.mad = False
        self.node.create_subscription(Twist, "cmd_vel", self._hear, qos.EVERY_COMMAND)
        self.node.create_timer(1.0 / ODOM_HZ, self._send)
        self._clients = {
            name: self.node.create_client(Trigger, f"command_gate/{name}")
            for name in ("reset", "arm")
        }

    def _hear(self, message: Twist) -> None:
        self._speed = message.linear.x
        moves = bool(message.linear.x or message.angular.z)
        self.heard.append((time.monotonic(), moves))

    def _send(self) -> None:
        now = time.time_ns()
        self._x += self._speed / ODOM_HZ
        odometry = self._odometries.write(
            now, np.array([self._x, 0.0, 0.0]), np.array([self._speed, 0.0, 0.0])
        )
        self._topics["odom"].publish(odometry)
        self._topics["odometry/filtered"].publish(odometry)
        if self.sent % (ODOM_HZ // SCAN_HZ) == 0:
            self._ranges += np.float32(1e-4)
            self._topics["scan"].publish(self._scans.write(now, self._ranges))
            self._topics["e_stop"].publish(Bool(data=False))
            self._command(now)
        self.sent += 1

    def _command(self, stamp_ns: int) -> None:
        """The policy has answered the scan before this one."""
        ill = self.mad and stamp_ns // (NS_PER_S // 2) % 2
        speed = float("nan") if ill else SPEED
        command = TwistStamped(twist=conversions.twist_to_ros([speed, 0.0, 0.1]))
        command.header.stamp = conversions.stamp_to_ros(self._stamp_ns)
        self._topics["cmd_vel_raw"].publish(command)
        self._stamp_ns = stamp_ns

    @property
    def moves(self) -> bool:
        """Whether the newest command moves it."""
        return bool(self.heard) and self.heard[-1][1]

    def drive(self) -> None:
        """Arms the gate as soon as it lets itself be armed. Raises RuntimeError."""
        end = time.monotonic() + PATIENCE_S
        told = ""
        while not self.moves:
            if time.monotonic() > end:
                raise RuntimeError(f"not within {PATIENCE_S} s: motion ({told})")
            told = f"{self._call('reset')} {self._call('arm')}"
            self.until(lambda: self.moves, 1.0)

    def _call(self, name: str) -> str:
        if not self.until(self._clients[name].service_is_ready, PATIENCE_S):
            raise RuntimeError(f"not within {PATIENCE_S} s: {name}")
        future = self._clients[name].call_async(Trigger.Request())
        self.until(future.done, PATIENCE_S)
        return str(future.result().message)

    def listeners(self) -> int:
        """Of its scans."""
        return self._topics["scan"].get_subscription_count()
