"""A robot's topics, fed into the middleware; used by all listening nodes."""

import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    Twist,
    TwistStamped,
)
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import Imu, LaserScan

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import S_PER_NS, Array, RobotView
from nics_drl_bridge.lidar.sectors import Reader, match_reader
from nics_drl_bridge.lidar.spec import LidarSpec, ScanHeader
from nics_drl_bridge.middleware import measurement
from nics_drl_bridge.middleware.ekf import START_STD
from nics_drl_bridge.middleware.intake import Intake
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.command_types import KINDS, TypeWatch, name_of
from nics_drl_bridge.nodes.conversions import INITIAL_POSE, read_initial_pose
from nics_drl_bridge.nodes.parameters import (
    IMU,
    NO_POSE,
    STAMPED,
)
from nics_drl_bridge.nodes.runner import get_choice, get_flag, get_text
from nics_drl_bridge.recording import messages
from nics_drl_bridge.recording.topic_roles import list_imu_topics

SILENCE_S = 5.0  # diagnostics call a topic stale that has been silent for this long [s]
KINDS_OF_POSE = {
    kind.__name__: kind for kind in (PoseStamped, PoseWithCovarianceStamped)
}


class RobotTopics(Intake):
    """Subscribes to a robot's topics and keeps the middleware up to date.

    The first odometry defines `map`, or with a pose sensor the first pose. Readers in other threads
    must hold `lock`. `on_odometry` and `on_scan` get the stamp [ns] of used data. `on_lidar` gets
    the lidar of a header that differs from the model's; if it raises ConfigError, such scans are
    rejected. Raises ConfigError if `pose_type` is unknown.
    """

    def __init__(
        self,
        node: Node,
        model: SimulatorModel,
        on_odometry: Callable[[int], None] | None = None,
        on_scan: Callable[[int], None] | None = None,
        on_lidar: Callable[[LidarSpec], None] | None = None,
        now_ns: Callable[[], int] | None = None,
    ) -> None:
        self._node = node
        pose_type = get_choice(node, "pose_type", (NO_POSE, *KINDS_OF_POSE))
        self._posed = pose_type != NO_POSE
        model.robot.require_cmd_vel()
        self.now_ns = now_ns or (lambda: int(node.get_clock().now().nanoseconds))
        self.lock = threading.RLock()
        super().__init__(model, self._posed)
        self._calls = {measurement.ODOM: on_odometry, measurement.SCAN: on_scan}
        self._on_lidar = on_lidar
        self._lidar = model.lidar
        self._reader: Reader | None = Reader(model.lidar, backwards=False)
        self._header = b""
        self._told = ""
        self._subscriptions: list[Any] = []
        kind = name_of(get_flag(node, STAMPED))
        self._types = TypeWatch(node, measurement.CMD_VEL, kind)
        self._subscribe(
            measurement.CMD_VEL, KINDS[kind], self._take_command, qos.COMMAND
        )
        kinds: dict[str, Any] = {
            measurement.SCAN: LaserScan,
            measurement.ODOM: Odometry,
        }
        if self._posed:
            kinds[measurement.POSE] = KINDS_OF_POSE[pose_type]
        for sensor in model.sensors:
            kinds[sensor.name] = conversions.find_sensor_type(sensor)
        for topic, type_ in kinds.items():
            self._subscribe(topic, type_, partial(self._take, topic), qos.SENSOR)
        self.expected = tuple(kinds)
        self.expected_topics = self.expected
        self._subscribe_imu()

    def _subscribe(
        self, topic: str, kind: Any, take: Callable[[Any], None], quality: Any
    ) -> None:
        def locked(message: Any) -> None:
            with self.lock:
                take(message)

        made = self._node.create_subscription(kind, topic, locked, quality)
        self._subscriptions.append(made)

    def _subscribe_imu(self) -> None:
        """Subscribe to the gyro if one is named or the model was made with one."""
        wanted = get_text(self._node, IMU)
        topics = list_imu_topics(wanted, self._model.gyro)
        self._imu_topic = ""  # the first topic that is heard
        for topic in topics:
            self._subscribe(topic, Imu, partial(self._take_imu_of, topic), qos.SENSOR)
        if topics and wanted != defaults.IMU_TOPIC:  # those are used if they arrive
            self.expected = (*self.expected, measurement.IMU)
            self.expected_topics = (*self.expected_topics, wanted)

    def close(self) -> None:
        """End the subscriptions."""
        self._types.close()
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())

    def restart(self) -> None:
        """Clear all state; the next odometry starts again."""
        super().restart()
        self.frames = ("", "")  # of the newest odometry: its own, and the robot's

    def subscribe_initial_pose(self) -> None:
        """Subscribe to `initialpose`, the robot's pose in the map."""
        kind = PoseWithCovarianceStamped
        self._subscribe(INITIAL_POSE, kind, self._take_initial_pose, qos.COMMAND)

    def _take_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        logger = self._node.get_logger()
        try:
            pose = read_initial_pose(message, get_text(self._node, "map_frame"))
            covariance = START_STD**2 * np.eye(3)
            if self._posed:  # otherwise nothing corrects this pose: it defines the map
                reported = messages.read_pose_covariance(message)
                checked = measurement.check_covariance(reported, 3, START_STD)
                covariance = covariance if checked is None else checked
        except (ValueError, ConfigError) as error:
            reason = str(error).rstrip(".")
            logger.error(f"{INITIAL_POSE}: {reason}. The estimate stays as it is.")
            return
        self.place(pose, covariance)
        logger.info(
            f"the robot is at ({pose[0]:.2f}, {pose[1]:.2f}) m, {pose[2]:.2f} rad"
        )

    def locate_in_odom(self) -> Array | None:
        """Return the robot's odometry pose (3,) at the newest datum; None before any."""
        newest = self.middleware.cache.newest.get(measurement.ODOM)
        if newest is None:
            return None
        pose, twist = newest.value  # the robot has moved since
        since_s = (self.newest_ns - newest.stamp_ns) * S_PER_NS
        return geometry.compose(pose, geometry.exp(twist * since_s))

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest datum [ns]; 0 if there is none."""
        return self.middleware.newest_ns or 0

    @property
    def located(self) -> bool:
        """True if the robot's position in the map is known."""
        is_placed = self._placed is not None or not self._posed
        return is_placed or measurement.POSE in self.middleware.cache.newest

    def list_silent(self, topics: Iterable[str], longest_s: float) -> list[str]:
        """Return those of some topics without a usable datum for so long [s]."""
        cache = self.middleware.cache
        now_ns = self.now_ns()
        return [topic for topic in topics if cache.silence_s(topic, now_ns) > longest_s]

    def view(self) -> RobotView:
        """Return the view at the stamp of the newest datum."""
        return self.middleware.view(self.newest_ns)

    def _take(self, role: str, message: Any) -> None:
        if role == measurement.ODOM:
            self.frames = message.header.frame_id, message.child_frame_id
        used = self.take(role, self.now_ns(), message)
        call = self._calls.get(role)
        if used and call is not None:
            call(messages.get_stamp(message))

    def _take_imu_of(self, topic: str, message: Imu) -> None:
        self._imu_topic = self._imu_topic or topic
        if topic == self._imu_topic:
            self._take(measurement.IMU, message)

    def find_reader(self, scan: LaserScan) -> Reader | None:
        """Return the reader for a scan's header; None if it can't be used."""
        # bytes, because NaN does not equal itself
        header = np.array(
            [
                scan.angle_min,
                scan.angle_increment,
                scan.range_min,
                scan.range_max,
                len(scan.ranges),
            ]
        ).tobytes()
        if header == self._header or self._on_lidar is None:
            return self._reader
        self._header = header
        self._reader = None
        upside_down = get_flag(self._node, "lidar_upside_down")
        try:
            values = (float(getattr(scan, name)) for name in ScanHeader._fields)
            reader = match_reader(
                ScanHeader(*values),
                len(scan.ranges),
                self._model.lidar,
                upside_down,
            )
            if reader.lidar != self._lidar:
                self._on_lidar(reader.lidar)
                self.middleware.expect_beams(reader.lidar.beams)
                self._lidar = reader.lidar
            self._reader = reader
        except BridgeError as error:
            if str(error) != self._told:
                self._node.get_logger().error(
                    f"{measurement.SCAN} is not used: {error}"
                )
            self._told = str(error)
        return self._reader

    def _take_command(self, message: Twist | TwistStamped) -> None:
        self.middleware.command(
            None, self._model.robot.from_cmd_vel(conversions.twist_from_ros(message))
        )
