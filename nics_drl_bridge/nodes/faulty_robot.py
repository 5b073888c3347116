"""A robot's topics around a gate, intact or with faults, published over DDS."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.recording.messages import read_command

PERIOD_S = 0.1  # about the time between two scans
PATIENCE_S = 60.0
MOTION_S = 10.0  # for the robot to move once it is armed
RECENT_S = 0.15  # greatest age of the command that moves the robot when it is broken
ALL = frozenset({"scan", "odom", "odometry/filtered", "cmd_vel_raw", "e_stop"})


class NoMotionError(BackendError):
    """The gate did not arm, or no command that moves the robot came."""


class Robot(SpunNode):
    """A robot's topics, intact or with faults. It follows `cmd_vel` unless it is stuck."""

    quality = qos.COMMAND  # of what its sensors publish

    def __init__(
        self,
        domain_id: int | None,
        model: SimulatorModel,
        twist: Array,
        policy: bool = False,
        relayed: bool = False,
        odom_hz: float = 0.0,
    ) -> None:
        """Publish the robot's topics.

        Args:
            domain_id: of ROS; by default the environment's.
            model: of the robot.
            twist: (3,) that its own policy commands.
            policy: True if the policy of another node commands instead.
            relayed: True if commands bypass the gate.
            odom_hz: rate of odometry and estimate, a multiple of the lidar's; 0: the model's.
        """
        super().__init__("robot", domain_id)
        kinds: dict[str, Any] = {
            "odom": Odometry,
            "scan": LaserScan,
            "e_stop": Bool,
            "cmd_vel_raw": TwistStamped,
            "odometry/filtered": Odometry,
        }
        qualities = {"odom": self.quality, "scan": self.quality}
        for sensor in model.sensors:
            kinds[sensor.name] = conversions.find_sensor_type(sensor)
            qualities[sensor.name] = self.quality
        self._topics = {
            name: self.node.create_publisher(
                kind, name, qualities.get(name, qos.COMMAND)
            )
            for name, kind in kinds.items()
        }
        self._lidar = model.lidar
        self._sensors = model.sensors
        self._twist = twist
        self._policy = policy
        self._relayed = relayed
        if relayed:
            self._past = self.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
        self.node.create_subscription(Twist, "cmd_vel", self._hear, qos.EVERY_COMMAND)
        self.node.create_subscription(
            TwistStamped, "cmd_vel_raw", self._hear_policy, qos.EVERY_COMMAND
        )
        scan_hz = model.lidar.rate
        if odom_hz == 0.0:
            needed = 1.0 / (model.control_period * scan_hz)
            odom_hz = scan_hz * max(1, math.ceil(needed - 1e-9))
        self.odom_per_scan = round(odom_hz / scan_hz)
        self._ticks = 0
        self._timer = self.node.create_timer(1.0 / odom_hz, self._send)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._now_ns = 0
        self._position = np.zeros(2)
        self.heard: list[tuple[float, Array]] = []  # times [s] and twists of `cmd_vel`
        # When each topic last sent a good message [s], and its last message. That of `cmd_vel_raw`
        # may come from the policy of another node.
        self.sent_s = dict.fromkeys(ALL, 0.0)
        self.last: dict[str, Any] = {}
        self.sent = dict.fromkeys(kinds, 0)  # number of messages
        self.scans_ns: list[int] = []  # stamps
        # stamp of a scan -> when a command that was computed from it arrived [ns], both on
        # the system clock
        self.answers_ns: dict[int, int] = {}
        self.repair()

    def set_rate(self, rate: float) -> None:
        """Publish scans at another rate [Hz], and all other topics in proportion."""
        self._timer.timer_period_ns = round(NS_PER_S / rate / self.odom_per_scan)

    def to_system_ns(self, time_s: float) -> int:
        """Return a time of the steady clock [s] on the clock of the stamps [ns]."""
        return round(time_s * NS_PER_S) + self._offset_ns

    def repair(self) -> None:
        """Remove all faults."""
        self.silent: set[str] = set()  # topics
        # alters messages by topic before they are sent
        self.change: dict[str, Callable[[Any], Any]] = {}
        self.stuck = False  # odometry shows no motion
        self.republished = False  # the policy's last command is repeated
        self.jump_ns = 0  # of all stamps
        # commands that were written before are ignored, on the system clock
        self.since_ns = 0

    def _hear(self, message: Twist, info: Mapping[str, Any]) -> None:
        if info["source_timestamp"] < self.since_ns:
            return
        arrival_s = time.monotonic()
        if "received_timestamp" in info:  # the message then waited for this call
            arrival_s -= (time.time_ns() - info["received_timestamp"]) / NS_PER_S
        self.heard.append((arrival_s, np.array(read_command(message))))

    def _hear_policy(self, message: TwistStamped, info: Mapping[str, Any]) -> None:
        if self._policy and not self.republished:
            self.last["cmd_vel_raw"] = message
            stamp_ns = conversions.stamp_from_ros(message.header.stamp)
            arrival_ns = info.get("received_timestamp") or time.time_ns()
            self.answers_ns.setdefault(stamp_ns, int(arrival_ns))

    def _send(self) -> None:
        velocity = np.zeros(2)
        if self.heard and not self.stuck:
            velocity = self.heard[-1][1][:2]
        before = self._now_ns
        self._now_ns = time.monotonic_ns() + self._offset_ns
        passed_s = min(self._now_ns - before, NS_PER_S) / NS_PER_S
        self._position = self._position + velocity * passed_s
        stamp = self._now_ns + self.jump_ns
        odometry = conversions.odometry_to_ros(
            [*self._position, 0.0],
            [*velocity, 0.0],
            stamp,
            ("odom", "base_link"),
            (1e-4,) * 4,
        )
        self._publish("odom", odometry)
        self._publish("odometry/filtered", odometry)
        self._ticks += 1
        if self._ticks % self.odom_per_scan:
            return
        ranges = np.full(
            self._lidar.beams, 2.0 + 0.1 * np.sin(self._now_ns * 1e-9), np.float32
        )
        self._publish(
            "scan", conversions.scan_to_ros(self._lidar, ranges, stamp, "laser")
        )
        self.scans_ns.append(stamp)
        for sensor in self._sensors:
            reading = np.zeros(sensor.size, np.float32)
            message = conversions.sensor_to_ros(sensor, reading, stamp, sensor.frame)
            self._publish(sensor.name, message)
        self._publish("e_stop", Bool(data=False))
        if self._policy:
            if self.republished:
                self._topics["cmd_vel_raw"].publish(self.last["cmd_vel_raw"])
        else:
            command = TwistStamped(twist=conversions.twist_to_ros(self._twist))
            if "scan" in self.last:  # a policy acts on the scan that it received
                command.header.stamp = self.last["scan"].header.stamp
            self._publish("cmd_vel_raw", command)
        if self._relayed and "cmd_vel_raw" in self.last:
            self._past.publish(self.last["cmd_vel_raw"].twist)

    def _publish(self, name: str, message: Any) -> None:
        if name in self.silent:
            return
        if name in self.change:
            message = self.change[name](message)
        elif not self.jump_ns:
            self.sent_s[name] = time.monotonic()
        self._topics[name].publish(message)
        self.sent[name] += 1
        self.last[name] = message

    def press(self) -> None:
        """Press the emergency stop, by its topic."""
        self._topics["e_stop"].publish(Bool(data=True))

    def call(self, service: str, patience_s: float = PATIENCE_S) -> Trigger.Response:
        """Call a service of the gate. Raises TimeoutError without an answer in time."""
        return self.call_service(Trigger, f"command_gate/{service}", patience_s)

    @property
    def moves(self) -> bool:
        """True if the newest command moves it."""
        return bool(self.heard) and bool(self.heard[-1][1].any())

    def drive(self, patience_s: float = PATIENCE_S, phase_s: float = 0.0) -> None:
        """Arm the gate and drive, so that a fault is injected into a moving robot.

        On a busy machine this process itself may stall, which the gate takes for a fault. Raises
        NoMotionError if the robot is not commanded to move.
        """
        self.repair()
        self.until(lambda: False, 3 * PERIOD_S)  # of good data
        end = time.monotonic() + patience_s
        while not self.moves:
            if time.monotonic() > end:
                raise NoMotionError(f"the robot did not move within {patience_s:g} s")
            if not self._relayed:
                self.arm(PATIENCE_S)
            self.until(lambda: self.moves, min(MOTION_S, patience_s))
        self.until(lambda: False, 0.5 + phase_s)
        if not self.moves or time.monotonic() - self.heard[-1][0] > RECENT_S:
            raise NoMotionError(
                "the robot stood still when the fault was to be injected"
            )

    def arm(self, patience_s: float) -> None:
        """Reset the gate, and ask it to arm until it does. Raises NoMotionError."""
        deadline_s = time.monotonic() + patience_s
        told = "it does not answer"
        try:
            self.call("reset", patience_s)
            while time.monotonic() < deadline_s:
                answer = self.call("arm", deadline_s - time.monotonic())
                if answer.success:
                    return
                told = answer.message
                self.until(lambda: False, PERIOD_S)
        except TimeoutError:
            pass
        raise NoMotionError(f"the gate did not arm within {patience_s:g} s: {told}")
