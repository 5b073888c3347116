"""RobotPort: what one simulated robot tells, written into messages that are there already."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState, LaserScan

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.rep117 import to_device
from nics_drl_bridge.nodes import conversions, qos, transforms, wire
from nics_drl_bridge.nodes.device_parameters import Frames, Timing
from nics_drl_bridge.nodes.outbox import Outbox
from nics_drl_bridge.sim.dead_reckoning import LEAST_VARIANCE, variances
from nics_drl_bridge.sim.device_world import Sensed

PLANAR = np.array([0, 1, 5])
DIAGONAL = np.arange(0, 36, 7)


class RobotPort:
    """Publishes `scan`, `odom`, `joint_states` and `ground_truth` of one robot.

    The last two cost nothing while nobody listens.

    Args:
        node: that publishes.
        namespace: of the robot below the node's, empty or with a slash at its end.
        model: of the robot.
        frames: of the robot.
        time: how it runs.
    """

    def __init__(
        self, node: Node, namespace: str, model: SimulatorModel, frames: Frames, time: Timing
    ) -> None:
        self._model, self._time, self.frames = model, time, frames
        quality = qos.SENSOR_RELIABLE
        self._scans = node.create_publisher(LaserScan, f"{namespace}scan", quality)
        self._odoms = node.create_publisher(Odometry, f"{namespace}odom", quality)
        self._truths = node.create_publisher(Odometry, f"{namespace}ground_truth", quality)
        self._joints = node.create_publisher(JointState, f"{namespace}joint_states", quality)
        scan, odom = scan_message(model, frames.laser, time), odometry_message(frames)
        # Beam 0 of a device that turns counter-clockwise was measured first.
        sweep_s = max(0.0, scan.time_increment) * (model.lidar.beams - 1)
        self._sweep_ns = 0 if time.lockstep else round(sweep_s * NS_PER_S)
        odom.twist.covariance[DIAGONAL[PLANAR]] = variances(model.noise.odometry)
        self._scan, self._odom = wire.ScanWriter(scan), wire.OdometryWriter(odom)
        self._truth = wire.OdometryWriter(truth_message(frames))
        self._moving = [transforms.transform_message(frames.odom, frames.base)]
        if node.get_parameter("publish_map_to_odom").value:
            self._moving.append(transforms.transform_message(frames.map, frames.odom))

    def mount(self) -> TransformStamped:
        """base_link -> laser."""
        message = transforms.transform_message(self.frames.base, self.frames.laser)
        return transforms.fill(message, self._model.lidar.mount, Time())

    def moving(self, now: Time, sensed: Sensed) -> list[TransformStamped]:
        """Odom -> base_link; and map -> odom where that was asked for."""
        transforms.fill(self._moving[0], sensed.odom, now)
        for message in self._moving[1:]:
            # That which takes the pose by odometry to the true one.
            home = geometry.between(sensed.odom, np.zeros(3))
            transforms.fill(message, geometry.compose(sensed.pose, home), now)
        return self._moving

    def tell_odometry(self, sensed: Sensed, outbox: Outbox, now_ns: int) -> None:
        """Publishes where the robot takes itself to be, and what only a simulator knows."""
        late_ns = self._time.odom_late_ns
        odometry = self._odom.write(now_ns, sensed.odom, sensed.twist, sensed.covariance)
        outbox.send(self._odoms, odometry, now_ns, late_ns)
        if self._joints.get_subscription_count():
            joints = conversions.joints_to_ros(self._model.robot, sensed.state, now_ns)
            outbox.send(self._joints, joints, now_ns, late_ns)
        if self._truths.get_subscription_count():
            self._truths.publish(self._truth.write(now_ns, sensed.pose, sensed.true_twist))

    def tell_scan(self, sensed: Sensed, outbox: Outbox, now_ns: int) -> None:
        """Publishes what the robot's lidar sees, stamped with the time of beam 0."""
        ranges = to_device(sensed.ranges, self._model.lidar)
        message = self._scan.write(now_ns - self._sweep_ns, ranges)
        outbox.send(self._scans, message, now_ns, self._time.scan_late_ns)


def scan_message(model: SimulatorModel, frame: str, time: Timing) -> LaserScan:
    """A scan whose ranges and stamp are still to be filled in."""
    free = np.full(model.lidar.beams, np.inf, np.float32)
    message = conversions.scan_to_ros(model.lidar, free, 0, frame)
    message.scan_time = time.scan_ns / NS_PER_S
    return message


def odometry_message(frames: Frames) -> Odometry:
    """An odometry whose numbers are still to be filled in; what a plane lacks is unknown."""
    return _planar_message(frames.odom, frames.base)


def truth_message(frames: Frames) -> Odometry:
    """The same of what is exact."""
    message = _planar_message(frames.map, frames.base)
    for covariance in (message.pose.covariance, message.twist.covariance):
        covariance[DIAGONAL[PLANAR]] = LEAST_VARIANCE
    return message


def _planar_message(parent: str, child: str) -> Odometry:
    message = Odometry(child_frame_id=child)
    message.header.frame_id = parent
    for covariance in (message.pose.covariance, message.twist.covariance):
        covariance[DIAGONAL] = conversions.UNUSED_VARIANCE
    return message
