"""Topics of one simulated robot: its data, its commands, its transforms, and their latencies."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState, LaserScan

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.spec import to_device
from nics_drl_bridge.nodes import conversions, qos, wire
from nics_drl_bridge.nodes.device_parameters import DeviceTiming, Frames
from nics_drl_bridge.nodes.qos import owner
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.device import LEAST_VARIANCE, Sensed, variances

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
SWITCH = {STAMPED: "enable_stamped_cmd_vel:=false", TWIST: "enable_stamped_cmd_vel:=true"}
"""By the expected type: the setting that selects the other type."""
QUIET_S = 5.0


class RobotPort:
    """Publishes `scan`, `odom`, `joint_states` and `ground_truth` of one robot.

    The last two cost nothing without subscribers. The namespace is empty or ends with a slash.
    """

    def __init__(
        self, node: Node, namespace: str, model: SimulatorModel, frames: Frames, time: DeviceTiming
    ) -> None:
        self._model, self._time, self.frames = model, time, frames
        quality = qos.SENSOR_RELIABLE
        self._scans = node.create_publisher(LaserScan, f"{namespace}scan", quality)
        self._odoms = node.create_publisher(Odometry, f"{namespace}odom", quality)
        self._truths = node.create_publisher(Odometry, f"{namespace}ground_truth", quality)
        self._joints = node.create_publisher(JointState, f"{namespace}joint_states", quality)
        free = np.full(model.lidar.beams, np.inf, np.float32)
        scan = conversions.scan_to_ros(model.lidar, free, 0, frames.laser)
        scan.scan_time = time.scan_ns / NS_PER_S
        # Beam 0 of a device that turns counter-clockwise was measured first.
        sweep_s = max(0.0, scan.time_increment) * (model.lidar.beams - 1)
        self._sweep_ns = 0 if time.lockstep else round(sweep_s * NS_PER_S)
        self._scan = wire.ScanWriter(scan)
        linear, _, turn = variances(model.noise.odometry)
        self._odom, self._truth = (
            wire.OdometryWriter(
                conversions.odometry_to_ros(
                    np.zeros(3), np.zeros(3), 0, (parent, frames.base), variance
                )
            )
            for parent, variance in (
                (frames.odom, (LEAST_VARIANCE, LEAST_VARIANCE, linear, turn)),
                (frames.map, (LEAST_VARIANCE,) * 4),
            )
        )
        self._locates = bool(node.get_parameter("publish_map_to_odom").value)

    def mount(self) -> TransformStamped:
        """Returns the transform base_link -> laser."""
        frames = self.frames
        return transform_to_ros(frames.base, frames.laser, self._model.lidar.mount, Time())

    def moving(self, now: Time, sensed: Sensed) -> list[TransformStamped]:
        """Returns the transforms odom -> base_link, and map -> odom if requested."""
        frames = self.frames
        moving = [transform_to_ros(frames.odom, frames.base, sensed.odom, now)]
        if self._locates:
            home = geometry.compose(sensed.pose, geometry.between(sensed.odom, np.zeros(3)))
            moving.append(transform_to_ros(frames.map, frames.odom, home, now))
        return moving

    def publish_odometry(self, sensed: Sensed, outbox: Outbox, now_ns: int) -> None:
        """Publishes odometry, and joints and true pose if they have subscribers."""
        late_ns = self._time.odom_late_ns
        odometry = self._odom.write(now_ns, sensed.odom, sensed.twist, sensed.covariance)
        outbox.send(self._odoms, odometry, now_ns, late_ns)
        if self._joints.get_subscription_count():
            joints = conversions.joints_to_ros(self._model.robot, sensed.state, now_ns)
            outbox.send(self._joints, joints, now_ns, late_ns)
        if self._truths.get_subscription_count():
            self._truths.publish(self._truth.write(now_ns, sensed.pose, sensed.true_twist))

    def publish_scan(self, sensed: Sensed, outbox: Outbox, now_ns: int) -> None:
        """Publishes the robot's scan, stamped with the time of beam 0."""
        ranges = to_device(sensed.ranges, self._model.lidar)
        message = self._scan.write(now_ns - self._sweep_ns, ranges)
        outbox.send(self._scans, message, now_ns, self._time.scan_late_ns)


class CommandInlet:
    """Listens to `cmd_vel`, and to `ackermann_cmd` if the robot steers and the message exists.

    The node's parameter `enable_stamped_cmd_vel` selects the type. A stamped command is treated as
    by ros2_control's drive controllers: a stamp of zero counts as now, and one older than the
    command timeout is ignored. `take` gets each command (C,) whose stamp [ns] is not `too_old`.
    """

    def __init__(
        self, node: Node, namespace: str, robot: RobotSpec, quality: QoSProfile,
        take: Callable[[Array], None], too_old: Callable[[int], bool],
    ) -> None:  # fmt: skip
        self._node, self._robot, self._take, self._too_old = node, robot, take, too_old
        stamped = bool(node.get_parameter("enable_stamped_cmd_vel").value)
        self._kind = STAMPED if stamped else TWIST
        kind, hear = (TwistStamped, self._on_stamped) if stamped else (Twist, self._on_bytes)
        self._topic: str = node.create_subscription(
            kind, f"{namespace}cmd_vel", hear, quality, raw=not stamped
        ).topic_name
        self._warned: set[str] = set()
        kind = conversions.message_type("ackermann_msgs/msg/AckermannDriveStamped")
        if robot.steers and kind is not None:  # its package is optional
            topic = f"{namespace}ackermann_cmd"
            node.create_subscription(kind, topic, self._on_ackermann, quality)

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
        if self._is_fresh(message.header.stamp):
            self._obey((message.drive.speed, 0.0, message.drive.steering_angle))

    def _is_fresh(self, stamp: Any) -> bool:
        stamp_ns = conversions.stamp_from_ros(stamp)
        if not stamp_ns or not self._too_old(stamp_ns):
            return True
        self._complain(
            "a command is ignored, because its stamp is older than command_timeout; do both ends "
            "take their time from the same clock (use_sim_time)?"
        )
        return False

    def _complain(self, what: str) -> None:
        self._node.get_logger().warning(f"{self._topic}: {what}", throttle_duration_sec=QUIET_S)

    def watch(self) -> None:
        """Warns once of each node that publishes the other type, which is never received."""
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


class Outbox:
    """Publishes messages after a latency and a jitter, each topic in order, or at once."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._waiting: list[tuple[int, int, Publisher, bytes]] = []
        self._latest: dict[Publisher, int] = {}
        self._numbers = itertools.count()

    def send(
        self, publisher: Publisher, message: Any, now_ns: int, late_ns: tuple[int, int]
    ) -> None:
        """Publishes a message, or its bytes, now, or schedules it.

        `late_ns` is the least delay, and the greatest additional one, drawn uniformly for each.
        """
        delay, jitter = late_ns
        if jitter:
            delay += int(self._random.integers(jitter + 1))
        if not delay:
            publisher.publish(message)
            return
        due = max(now_ns + delay, self._latest.get(publisher, 0))
        self._latest[publisher] = due
        content = message if isinstance(message, bytes) else serialize_message(message)
        heapq.heappush(self._waiting, (due, next(self._numbers), publisher, content))

    def flush(self, now_ns: int) -> None:
        """Publishes what is due."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, publisher, content = heapq.heappop(self._waiting)
            publisher.publish(content)

    def clear(self) -> None:
        """Drops the waiting messages: they are from an episode that is over."""
        self._waiting.clear()
        self._latest.clear()


def transform_to_ros(parent: str, child: str, pose: ArrayLike, stamp: Time) -> TransformStamped:
    """Returns a pose (3,) of a child frame in its parent as a transform."""
    x, y, heading = np.asarray(pose, np.float64).tolist()
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, stamp
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation = conversions.heading_to_ros(heading)
    return message


class Transforms:
    """Publishes transforms; if tf2_msgs is not installed, it logs that once."""

    def __init__(self, node: Node) -> None:
        kind = conversions.message_type("tf2_msgs/msg/TFMessage")
        self.published = kind is not None
        if kind is None:
            node.get_logger().warning(
                "the message package tf2_msgs is not installed, so that neither /tf nor /tf_static "
                "is published; install it with your ROS 2 distribution."
            )
            return
        self._kind = kind
        self._moving = node.create_publisher(kind, "/tf", qos.TRANSFORMS)
        self._fixed = node.create_publisher(kind, "/tf_static", qos.FIXED_TRANSFORMS)

    def publish_fixed(self, transforms: list[TransformStamped]) -> None:
        """Publishes once what never changes; late joiners get it, too."""
        if self.published:
            self._fixed.publish(self._kind(transforms=transforms))

    def publish(
        self, moving: list[TransformStamped], outbox: Outbox, now_ns: int, late_ns: tuple[int, int]
    ) -> None:
        """Publishes what changes, with the delay of the odometry that it comes from."""
        outbox.send(self._moving, self._kind(transforms=moving), now_ns, late_ns)
