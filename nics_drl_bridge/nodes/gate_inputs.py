"""What the gate hears: messages read from their bytes, and who sent them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.node import Node

from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.state import replace
from nics_drl_bridge.lidar.sensor import Sensor
from nics_drl_bridge.lidar.spec import LidarSpec, from_device
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.conversions import sensor_from_ros
from nics_drl_bridge.recording.messages import PLANAR, is_rotation

TWIST = "Twist"
TWIST_STAMPED = "TwistStamped"
ROTATION = slice(3, 7)  # the quaternion among the numbers of an odometry
SHOWN = 4  # displayed bytes of a publisher's id


def read_scan(lidar: LidarSpec, content: bytes) -> inputs.Scan:
    """Read a serialised LaserScan. Raises `wire.UNREADABLE`, like the other readers."""
    ranges = from_device(wire.read_ranges(content), lidar)
    return inputs.Scan(wire.read_stamp(content), ranges, wire.read_angles(content))


def read_sensor(sensor: Sensor, content: bytes) -> inputs.SensorReading:
    """Read a serialised message of an additional sensor."""
    points = sensor.points(sensor_from_ros(sensor, content))
    return inputs.SensorReading(wire.read_stamp(content), sensor.name, points)


def read_odometry(content: bytes) -> inputs.Odometry:
    """Read a serialised Odometry; without a rotation its pose is NaN."""
    pose, twist = wire.read_odometry(content)
    if not is_rotation(*wire.read_numbers(content)[ROTATION].tolist()):
        pose = np.full(3, np.nan)
    return inputs.Odometry(wire.read_stamp(content), pose, twist)


def read_estimate(content: bytes) -> inputs.Estimate:
    """Read a serialised Odometry of an estimator."""
    pose, twist = wire.read_odometry(content)
    covariance = wire.read_numbers(content)[wire.POSE_COVARIANCE : wire.TWIST].reshape(
        6, 6
    )
    return inputs.Estimate(twist, pose, covariance[PLANAR].astype(np.float64))


def read_command(content: bytes) -> inputs.Command:
    """Read a serialised TwistStamped."""
    return inputs.Command(
        wire.read_stamp(content), np.array(wire.read_stamped_twist(content))
    )


def read_foreign_command(
    kind: str, oldest_ns: int, newest: inputs.Scan | None, content: bytes
) -> inputs.Command:
    """Read a command of another controller; it counts as computed from the newest scan.

    Its stamp, if any, must not be older than `oldest_ns`. Raises `wire.UNREADABLE`.
    """
    if newest is None:
        raise ValueError("no scan has arrived yet from which it could be computed")
    if kind == TWIST:
        return inputs.Command(newest.stamp_ns, np.array(wire.read_twist(content)))
    if 0 < wire.read_stamp(content) < oldest_ns:
        raise ValueError(
            "its stamp is older than command_age; is use_sim_time the same at both?"
        )
    return replace(read_command(content), stamp_ns=newest.stamp_ns)


def read_e_stop(content: bytes) -> inputs.EStop:
    """Read a serialised Bool."""
    return inputs.EStop(wire.read_bool(content))


class Sources:
    """Names the publishers of a topic by their nodes, as far as the middleware reports them."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = topic
        self._names: dict[bytes, str] = {}
        # number of publishers in the graph, used if messages do not identify theirs
        self.publishers = 1
        self._tells_publisher = True

    def name_of(self, info: Mapping[str, Any]) -> str:
        """Return the publisher's name for a message; empty if the middleware does not report it."""
        publisher = info.get("publisher_gid")
        if not publisher:
            self._tells_publisher = False
            return ""
        gid = bytes(publisher["data"])
        if gid not in self._names:  # named once: a name stands for its publisher
            self._names[gid] = (
                f"{self._find_node(gid)} (publisher {gid[-SHOWN:].hex()})"
            )
        return self._names[gid]

    def count_publishers(self) -> None:
        """Count the publishers in the graph, if messages do not identify theirs."""
        if not self._tells_publisher:
            self.publishers = max(1, self._node.count_publishers(self._topic))

    def _find_node(self, gid: bytes) -> str:
        for endpoint in self._node.get_publishers_info_by_topic(self._topic):
            if bytes(endpoint.endpoint_gid) == gid:
                return qos.find_owner(endpoint) or "a node"
        return "a node"
