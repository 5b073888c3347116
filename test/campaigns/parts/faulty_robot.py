"""A robot's topics around a gate, whole or broken, published over DDS."""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from parts.spun_node import SpunNode
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos

ROBOT = "ackermann"
PERIOD_S = 0.1  # between scans, commands and heartbeats of the emergency stop
SPEED = 0.5
PATIENCE_S = 60.0
MOTION_S = 10.0
RECENT_S = 0.15
"""The newest command must be younger, for the robot to be told to move now [s]."""
ALL = frozenset({"scan", "odom", "odometry/filtered", "cmd_vel_raw", "e_stop"})


class NoMotionError(RuntimeError):
    """The gate was armed, but no command that moves the robot came."""


def driver_context(domain_id: int | None) -> Context:
    """A context as a driver of somebody else's has it: as ROS 2 makes it, with shared memory."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    context.init(None, domain_id=domain_id)
    return context


def hear(domain_id: int | None, out: Connection) -> None:
    """The base's end of `cmd_vel`: tells when each command came [s] and which; never ends."""
    context = driver_context(domain_id)
    node = Node("base", context=context, start_parameter_services=False)

    def tell(message: Twist) -> None:
        out.send((time.monotonic(), conversions.twist_from_ros(message)))

    node.create_subscription(Twist, "cmd_vel", tell, qos.COMMAND)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    while True:
        executor.spin_once()


class Robot(SpunNode):
    """A robot's topics, whole or broken. It does what `cmd_vel` says, unless it is stuck.

    Commands are heard in a process of their own, as by a base: who publishes to a process that was
    killed may be held up for a second by the middleware, and would hear the stop late.

    Args:
        domain_id: of ROS; None for that of the environment.
        policy: whether a policy of its own commands; this robot's own is silent then.
        speed: that its own policy commands [m/s].
        relayed: whether commands go past the gate.
        odom_hz: how often odometry and estimate come, a multiple of 10.
        skip: only one in so many scans, heartbeats and commands is sent.
        sensors: quality of service of scan and odometry.

    Attributes:
        silent: topics that say nothing.
        change: alters messages by topic before they are sent.
        stuck: odometry shows no motion.
        heard: times [s] and twists (3,) of `cmd_vel`.
        last: the message that each topic sent last; of `cmd_vel_raw`, also what the policy sent.
        republished: whether the last command of the policy is sent again and again, as it was.
        sent_s: when each topic sent a good one last [s].
        sent: how many messages each topic has sent.
    """

    def __init__(
        self,
        domain_id: int | None,
        policy: bool = False,
        speed: float = SPEED,
        relayed: bool = False,
        odom_hz: int = 10,
        skip: int = 1,
        sensors: QoSProfile = qos.COMMAND,
    ) -> None:
        self._lidar = builtin_model(ROBOT).lidar
        super().__init__("robot", context=driver_context(domain_id))
        kinds = {
            "odom": (Odometry, sensors),
            "scan": (LaserScan, sensors),
            "e_stop": (Bool, qos.COMMAND),
            "cmd_vel_raw": (TwistStamped, qos.COMMAND),
            "odometry/filtered": (Odometry, qos.COMMAND),
        }
        self._topics = {
            name: self.node.create_publisher(kind, name, profile)
            for name, (kind, profile) in kinds.items()
        }
        self.heard: list[tuple[float, np.ndarray]] = []
        self._policy = policy
        self._speed = speed
        self._relayed = relayed
        if relayed:
            self._past = self.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        spawning = multiprocessing.get_context("spawn")
        self._ear, out = spawning.Pipe(duplex=False)
        self._base = spawning.Process(target=hear, args=(domain_id, out), daemon=True)
        self._base.start()
        self.node.create_subscription(
            TwistStamped, "cmd_vel_raw", self._hear_policy, qos.COMMAND
        )
        self._every = skip * round(odom_hz * PERIOD_S)
        self._ticks = 0
        self.node.create_timer(1.0 / odom_hz, self._send)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._now_ns = 0
        self._x = 0.0
        self.sent_s = dict.fromkeys(ALL, 0.0)
        self.sent = dict.fromkeys(ALL, 0)
        self.last: dict[str, Any] = {}
        self.mend()

    def mend(self) -> None:
        """Everything is well again."""
        self.silent: set[str] = set()
        self.change: dict[str, Callable[[Any], Any]] = {}
        self.stuck = False
        self.republished = False
        self.jump_ns = 0

    def _hear_policy(self, message: TwistStamped) -> None:
        if self._policy and not self.republished:
            self.last["cmd_vel_raw"] = message

    def _send(self) -> None:
        speed = self.heard[-1][1][0] if self.heard and not self.stuck else 0.0
        before = self._now_ns
        self._now_ns = time.monotonic_ns() + self._offset_ns
        self._x += speed * min(self._now_ns - before, NS_PER_S) / NS_PER_S
        stamp = self._now_ns + self.jump_ns
        odometry = conversions.odometry_to_ros(
            [self._x, 0.0, 0.0],
            [speed, 0.0, 0.0],
            stamp,
            ("odom", "base_link"),
            (1e-4,) * 4,
        )
        self._say("odom", odometry)
        self._say("odometry/filtered", odometry)
        self._ticks += 1
        if self._ticks % self._every:
            return
        ranges = np.full(
            self._lidar.beams, 2.0 + 0.1 * np.sin(self._now_ns * 1e-9), np.float32
        )
        self._say("scan", conversions.scan_to_ros(self._lidar, ranges, stamp, "laser"))
        self._say("e_stop", Bool(data=False))
        if self._policy:
            if self.republished:
                self._topics["cmd_vel_raw"].publish(self.last["cmd_vel_raw"])
            return
        turn = 0.1 if self._speed else 0.0
        command = TwistStamped(twist=conversions.twist_to_ros([self._speed, 0.0, turn]))
        if "scan" in self.last:  # what a policy acts on is the scan that it got
            command.header.stamp = self.last["scan"].header.stamp
        self._say("cmd_vel_raw", command)
        if self._relayed and "cmd_vel_raw" in self.last:
            self._past.publish(self.last["cmd_vel_raw"].twist)

    def _say(self, name: str, message: Any) -> None:
        if name in self.silent or name not in self._topics:
            return
        if name in self.change:
            message = self.change[name](message)
        elif not self.jump_ns:
            self.sent_s[name] = time.monotonic()
        self._topics[name].publish(message)
        self.sent[name] += 1
        self.last[name] = message

    def press(self) -> None:
        """Presses the emergency stop, by its topic."""
        self._topics["e_stop"].publish(Bool(data=True))

    def until(self, done: Callable[[], object], seconds: float) -> bool:
        """Lives on until something is the case, or the time is over; whether it came to be."""

        def holds() -> object:
            while self._ear.poll():
                self.heard.append(self._ear.recv())
            return done()

        return super().until(holds, seconds)

    def call(self, service: str) -> Trigger.Response:
        """Asks the gate for something."""
        return self.call_service(Trigger, f"command_gate/{service}", PATIENCE_S)

    def listeners(self) -> int:
        """Of its scans."""
        return self._topics["scan"].get_subscription_count()

    @property
    def moves(self) -> bool:
        """Whether the newest command moves it."""
        return bool(self.heard) and bool(self.heard[-1][1].any())

    def drive(self, patience_s: float = PATIENCE_S) -> None:
        """Arms the gate and drives, so that a fault finds the robot in motion, at any phase.

        A busy machine may hold up this process itself, which the gate takes for a fault.

        Raises:
            NoMotionError: the robot is not told to move, or not any more.
        """
        self.mend()
        self.until(lambda: False, 3 * PERIOD_S)  # of good data
        end = time.monotonic() + patience_s
        while not self.moves:
            if time.monotonic() > end:
                raise NoMotionError(f"not within {patience_s} s: motion")
            if not self._relayed:
                self._arm()
            self.until(lambda: self.moves, min(MOTION_S, patience_s))
        self.until(lambda: False, 0.5 + random.uniform(0.0, PERIOD_S))
        if not self.moves or time.monotonic() - self.heard[-1][0] > RECENT_S:
            raise NoMotionError(
                "the robot was not being told to move when it was to be broken"
            )

    def _arm(self) -> None:
        self.call("reset")

        def is_armed() -> bool:
            self.until(lambda: False, PERIOD_S)
            return bool(self.call("arm").success)

        if not self.until(is_armed, PATIENCE_S):
            raise NoMotionError(
                f"not within {PATIENCE_S} s: {self.call('arm').message}"
            )

    def close(self) -> None:
        """Leaves the graph."""
        super().close()
        self._base.terminate()
        self._base.join()
