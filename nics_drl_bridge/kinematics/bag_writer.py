"""Writes a recording as a rosbag2 recording, without ROS, for the tools of others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.kinematics import topic_roles
from nics_drl_bridge.kinematics.bag_sink import Storage, bag_sink
from nics_drl_bridge.kinematics.joints import POSITION_UNITS, WHEELS
from nics_drl_bridge.kinematics.recording import Recording, Stream
from nics_drl_bridge.kinematics.spec import RobotSpec

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Array = NDArray[np.float64]
Make = Callable[[Any, Array], Any]

START_NS = 1_700_000_000 * NS_PER_S
"""What second 0 of the commands' clock becomes."""
FRAMES = ("odom", "base_link")


def write_bag(
    recording: Recording,
    path: str | Path,
    spec: RobotSpec,
    storage: Storage = "mcap",
) -> None:
    """Writes a recording as a bag that `load_bag` reads back.

    Commands become `/cmd_vel`, the pose `/odom`; or `/pose` when it has a clock of its own or
    odometry beside it, whose twist is then `/odom`. State and wheels become `/joint_states`,
    the IMU `/imu`. Headers hold the streams' stamps.

    Args:
        recording: of the robot.
        path: folder to make.
        spec: the robot.
        storage: format of the file in the folder.

    Raises:
        RecordingError: the folder is there already, or rosbags is not installed.
    """
    with bag_sink(path, storage) as sink:
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        for topic, kind, stream, make in _topics(recording, spec, messages := _Messages(store)):
            sink.add_topic(topic, kind)
            stamps = np.round(stream.t * NS_PER_S).astype(np.int64) + START_NS
            receive = stamps + _to_commands_clock(recording, stream)
            for k, values in enumerate(stream.values):
                message = make(messages.header(int(stamps[k])), values)
                sink.write(topic, int(receive[k]), bytes(store.serialize_cdr(message, kind)))


def _topics(
    recording: Recording, spec: RobotSpec, messages: _Messages
) -> list[tuple[str, str, Stream, Make]]:
    """Topic, type, stream and what makes a message of a row."""
    beside = recording.odometry is not None or recording.pose.clock != recording.command.clock
    topics: list[tuple[str, str, Stream, Make]] = [
        (
            "/cmd_vel", topic_roles.TWIST, recording.command,
            lambda _, row: messages.twist(spec.to_cmd_vel(row)),
        ),
        ("/pose", topic_roles.POSE, recording.pose, messages.pose_stamped)
        if beside
        else ("/odom", topic_roles.ODOMETRY, recording.pose, messages.odometry),
    ]  # fmt: skip
    if recording.odometry is not None:
        topics.append(("/odom", topic_roles.ODOMETRY, recording.odometry, messages.speeds))
    if recording.state is not None:
        names = [v.name for v in spec.state]
        still = np.array([v.unit in POSITION_UNITS for v in spec.state])
        topics.append((
            "/joint_states", topic_roles.JOINTS, recording.state,
            lambda header, row: messages.joints(header, names, row * still, row * ~still),
        ))  # fmt: skip
    elif recording.wheels is not None:
        topics.append((
            "/joint_states", topic_roles.JOINTS, recording.wheels,
            lambda header, row: messages.joints(header, list(WHEELS), 0.0 * row, row),
        ))  # fmt: skip
    if recording.imu is not None:
        topics.append(("/imu", topic_roles.IMU, recording.imu, messages.imu))
    return topics


def _to_commands_clock(recording: Recording, stream: Stream) -> int:
    """What makes a time of receipt of a stamp [ns]: streams of another clock start together."""
    if stream.clock == recording.command.clock:
        return 0
    return round(float(recording.command.t[0] - stream.t[0]) * NS_PER_S)


class _Messages:
    """Makes messages of rows."""

    def __init__(self, store: Typestore) -> None:
        self._types = store.types

    def _new(self, kind: str, *values: Any) -> Any:
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](*values)

    def header(self, stamp_ns: int) -> Any:
        stamp = self._new("builtin_interfaces/Time", stamp_ns // NS_PER_S, stamp_ns % NS_PER_S)
        return self._new("std_msgs/Header", stamp, FRAMES[0])

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._new("geometry_msgs/Vector3", x, y, z)

    def twist(self, row: Array) -> Any:
        x, y, w = (float(value) for value in row)
        return self._new("geometry_msgs/Twist", self._vector(x, y, 0.0), self._vector(0.0, 0.0, w))

    def _pose(self, row: Array) -> Any:
        x, y, heading = (float(value) for value in row)
        position = self._new("geometry_msgs/Point", x, y, 0.0)
        half = heading / 2.0
        turned = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
        return self._new(
            "geometry_msgs/Pose", position, self._new("geometry_msgs/Quaternion", *turned)
        )

    def pose_stamped(self, header: Any, row: Array) -> Any:
        return self._new("geometry_msgs/PoseStamped", header, self._pose(row))

    def odometry(self, header: Any, row: Array) -> Any:
        return self._odometry(header, row, np.zeros(3), np.zeros(36))

    def speeds(self, header: Any, row: Array) -> Any:
        """An odometry of which the twist alone was recorded."""
        unknown = np.zeros(36)
        unknown[0] = -1.0
        return self._odometry(header, np.zeros(3), row, unknown)

    def _odometry(self, header: Any, pose: Array, twist: Array, pose_covariance: Array) -> Any:
        where = self._new("geometry_msgs/PoseWithCovariance", self._pose(pose), pose_covariance)
        speed = self._new("geometry_msgs/TwistWithCovariance", self.twist(twist), np.zeros(36))
        return self._new("nav_msgs/Odometry", header, FRAMES[1], where, speed)

    def joints(self, header: Any, names: list[str], position: Array, velocity: Array) -> Any:
        return self._new("sensor_msgs/JointState", header, names, position, velocity, np.zeros(0))

    def imu(self, header: Any, row: Array) -> Any:
        ax, ay, w = (float(value) for value in row)
        unknown = np.full(9, -1.0)
        return self._new(
            "sensor_msgs/Imu", header,
            self._new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0), unknown,
            self._vector(0.0, 0.0, w), np.zeros(9), self._vector(ax, ay, 0.0), np.zeros(9),
        )  # fmt: skip
