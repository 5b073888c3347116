"""A skid-steer robot in DART, Gazebo's physics engine, behind the topics of an ordinary driver.

The extra `dart` builds the place. Nothing here uses this package's kinematics or lidar: four wheels
roll and slip by DART's contacts, and the lidar is an analytic ray cast. The wheels turn the robot
less than the driver's odometry believes, because the driver computes with one effective track. A
gyro measures the true turn rate, with noise and a constant bias.

Subscribes to `cmd_vel` (TwistStamped), publishes `odom`, `scan`, `imu` and, for the judge alone,
`true_pose` and `touched`. `hold` (Bool) fixes the body to the ground while its wheels go on.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import dartpy
import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge.extras.dart import scenery
from nics_drl_bridge.extras.physics.scenery import Box, Cylinder

Array = NDArray[np.float64]

STEP_S = 0.002
WHEEL_RADIUS = 0.165  # [m]
TRACK = 0.57  # between the wheels [m]
WHEELBASE = 0.512  # [m]
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
FRICTION = 0.6
MOTOR_TORQUE = 80.0  # [N m]
WHEEL_ACCELERATION = 12.0  # [rad/s^2]
BODY = (0.9, 0.4, 0.2)  # [m]
THICK = 0.2  # of walls [m]
BELIEVED_TRACK = (
    1.35 * TRACK
)  # by which the driver converts wheel speeds and turn rates
COMMAND_TIMEOUT_S = 0.5


@dataclass(frozen=True)
class Place:
    """What stands around the robot.

    Attributes:
        size: of the walls around the middle (2,) [m].
        pillars: x, y, radius of each (P, 3) [m].
    """

    size: Array
    pillars: Array

    @classmethod
    def read(cls, file: Path) -> Place:
        """Reads a JSON file with `size` and `pillars`."""
        content = json.loads(file.read_text(encoding="utf-8"))
        pillars = np.array(content["pillars"], dtype=float).reshape(-1, 3)
        return cls(np.array(content["size"], dtype=float), pillars)


@dataclass(frozen=True)
class Lidar:
    """A lidar that sees all around, by default with the figures of an RPLIDAR A2."""

    beams: int = 800
    range_min: float = 0.15
    range_max: float = 12.0
    noise: float = 0.005  # standard deviation as a fraction of a range

    @property
    def angles(self) -> Array:
        """Of the beams, seen from the lidar (B,) [rad]."""
        return -math.pi + self.angle_increment * np.arange(self.beams)

    @property
    def angle_increment(self) -> float:
        """Between two beams [rad]."""
        return 2.0 * math.pi / self.beams

    def scan(self, place: Place, pose: Array, rng: np.random.Generator) -> Array:
        """Returns the ranges (B,) [m] from a pose (3,) of the lidar; inf where nothing is hit."""
        directions = pose[2] + self.angles
        rays = np.stack([np.cos(directions), np.sin(directions)], axis=1)
        ranges = np.minimum(
            _range_of_walls(place, pose, rays), _range_of_pillars(place, pose, rays)
        )
        ranges *= 1.0 + rng.normal(0.0, self.noise, self.beams)
        return np.where(
            (ranges > self.range_min) & (ranges < self.range_max), ranges, np.inf
        )


def _range_of_walls(place: Place, pose: Array, rays: Array) -> Array:
    """Returns the distance to the walls, from within them (B,) [m]."""
    ahead = np.where(rays > 0.0, 0.5 * place.size, -0.5 * place.size) - pose[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays == 0.0, np.inf, ahead / rays).min(axis=1)


def _range_of_pillars(place: Place, pose: Array, rays: Array) -> Array:
    """Returns the distance to the nearest pillar on each ray (B,) [m]."""
    if len(place.pillars) == 0:
        return np.full(len(rays), np.inf)
    to_middle = place.pillars[:, :2] - pose[:2]
    along = rays @ to_middle.T
    squared = np.sum(to_middle**2, axis=1) - along**2
    chord_squared = place.pillars[:, 2] ** 2 - squared
    hit = (chord_squared > 0.0) & (along > 0.0)
    entry = along - np.sqrt(np.maximum(chord_squared, 0.0))
    return np.where(hit, entry, np.inf).min(axis=1)


def _wheel_urdf(name: str) -> str:
    side = 1 if name.endswith("left") else -1
    end = 1 if name.startswith("front") else -1
    origin = f"{end * 0.5 * WHEELBASE} {side * 0.5 * TRACK} {WHEEL_RADIUS}"
    return f"""
    <link name="{name}">
      <inertial><mass value="2.6"/>
        <inertia ixx="0.02" iyy="0.035" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin rpy="1.5707963 0 0"/>
        <geometry><cylinder radius="{WHEEL_RADIUS}" length="0.11"/></geometry></collision>
    </link>
    <joint name="{name}_joint" type="continuous">
      <parent link="base_link"/><child link="{name}"/>
      <origin xyz="{origin}"/><axis xyz="0 1 0"/>
    </joint>"""


def robot_urdf() -> str:
    """Returns the URDF of the robot: a box on four wheels."""
    size = " ".join(str(side) for side in BODY)
    return f"""<robot name="skid_steer">
    <link name="base_link">
      <inertial><origin xyz="0 0 0.2"/><mass value="38"/>
        <inertia ixx="0.6" iyy="1.4" izz="1.7" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin xyz="0 0 0.25"/><geometry><box size="{size}"/></geometry></collision>
    </link>{"".join(_wheel_urdf(name) for name in WHEELS)}
    </robot>"""


class Engine:
    """The world of DART with the robot in a place."""

    def __init__(self, place: Place, pose: Array) -> None:
        self.world = dartpy.simulation.World()
        self.world.setTimeStep(STEP_S)
        self.world.setCollisionDetector(dartpy.simulation.CollisionDetectorType.ODE)
        ground = scenery.add_fixed_body(self.world, "ground")
        slab = dartpy.dynamics.BoxShape([80.0, 80.0, 0.2])
        below = scenery.make_transform([0.0, 0.0, -0.1])
        scenery.let_touch(scenery.add_shape(ground, slab, below), friction=1.0)
        self._add_walls(place)
        self._robot = dartpy.utils.DartLoader().parseSkeletonString(robot_urdf(), "")
        self._base = self._robot.getBodyNode("base_link")
        self._prepare_wheels()
        scenery.place_body(self._base, pose)
        self.world.addSkeleton(self._robot)
        self._weld: dartpy.constraint.WeldJointConstraint | None = None
        self.wheel_speeds = np.zeros(4)  # asked of the motors [rad/s]

    def _add_walls(self, place: Place) -> None:
        body = scenery.add_fixed_body(self.world, "walls")
        length, width = place.size + THICK
        for sign in (-1, 1):
            beside = Box(np.array([0.0, sign * 0.5 * width]), 0.0, (length, THICK))
            ahead = Box(np.array([sign * 0.5 * length, 0.0]), 0.0, (THICK, width))
            for wall in (beside, ahead):
                scenery.add_solid(body, wall, level=0.5, height=1.0)
        for x, y, radius in place.pillars:
            pose = np.array([x, y, 0.0])
            scenery.add_solid(body, Cylinder(radius), level=0.5, height=1.0, pose=pose)

    def _prepare_wheels(self) -> None:
        names = [degree.getName() for degree in self._robot.getDofs()]
        self._wheels = [names.index(f"{name}_joint") for name in WHEELS]
        for name, index in zip(WHEELS, self._wheels, strict=True):
            joint = self._robot.getJoint(f"{name}_joint")
            joint.setActuatorType(dartpy.dynamics.ActuatorType.SERVO)
            self._robot.getDof(index).setForceLimits(-MOTOR_TORQUE, MOTOR_TORQUE)
            for node in self._robot.getBodyNode(name).getShapeNodes():
                node.getDynamicsAspect().setFrictionCoeff(FRICTION)

    def step(self) -> None:
        """Moves the world by one step."""
        for index, speed in zip(self._wheels, self.wheel_speeds, strict=True):
            self._robot.setCommand(index, float(speed))
        self.world.step()

    def hold(self, held: bool) -> None:
        """Fixes the body to the ground, or lets it go."""
        solver = self.world.getConstraintSolver()
        if held and self._weld is None:
            self._weld = dartpy.constraint.WeldJointConstraint(self._base)
            solver.addConstraint(self._weld)
        if not held and self._weld is not None:
            solver.removeConstraint(self._weld)
            self._weld = None

    @property
    def time_s(self) -> float:
        """Since the start [s]."""
        return float(self.world.getTime())

    @property
    def pose(self) -> Array:
        """The true x, y, heading (3,) [m, rad]."""
        transform = self._base.getTransform()
        rotation = transform.rotation()
        x, y, _ = transform.translation()
        return np.array([x, y, math.atan2(rotation[1, 0], rotation[0, 0])])

    @property
    def turn_rate(self) -> float:
        """The true turn rate [rad/s]."""
        return float(self._base.getAngularVelocity()[2])

    @property
    def measured_wheel_speeds(self) -> Array:
        """Of the encoders (4,) [rad/s]."""
        return np.array([self._robot.getVelocity(index) for index in self._wheels])

    @property
    def touches(self) -> bool:
        """Whether the robot touches something other than the ground."""
        for contact in self.world.getLastCollisionResult().getContacts():
            names = {
                contact.collisionObject1.getShapeFrame()
                .asShapeNode()
                .getSkeleton()
                .getName(),
                contact.collisionObject2.getShapeFrame()
                .asShapeNode()
                .getSkeleton()
                .getName(),
            }
            if "skid_steer" in names and "ground" not in names and len(names) == 2:
                return True
        return False


class Driver(Node):
    """The topics of the robot, in real time."""

    ODOM_HZ = 20
    IMU_HZ = 50
    SCAN_HZ = 10
    GYRO_BIAS = 0.01  # [rad/s]
    GYRO_NOISE = 0.005  # [rad/s]

    def __init__(self, place: Place, pose: Array, seed: int, imu: bool) -> None:
        super().__init__("base_driver")
        self.engine = Engine(place, pose)
        self._place = place
        self._lidar = Lidar()
        self._rng = np.random.default_rng(seed)
        self._odometry = np.zeros(3)
        self._command = np.zeros(2)
        self._command_time_s = -math.inf
        self._steps = 0
        self._touched = False
        self._started_ns = self.get_clock().now().nanoseconds
        self.create_subscription(TwistStamped, "cmd_vel", self._on_command, 1)
        self.create_subscription(
            Bool, "hold", lambda message: self.engine.hold(message.data), 10
        )
        self._odom = self.create_publisher(Odometry, "odom", 10)
        self._scan = self.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
        self._imu = (
            self.create_publisher(Imu, "imu", qos_profile_sensor_data) if imu else None
        )
        self._true_pose = self.create_publisher(PoseStamped, "true_pose", 10)
        self._touch = self.create_publisher(Bool, "touched", 10)
        self.create_timer(0.01, self._run)

    def _on_command(self, message: TwistStamped) -> None:
        self._command = np.array([message.twist.linear.x, message.twist.angular.z])
        self._command_time_s = self.engine.time_s

    def _run(self) -> None:
        """Catches up with the clock, and publishes what has become due."""
        elapsed_s = 1e-9 * (self.get_clock().now().nanoseconds - self._started_ns)
        while self.engine.time_s + STEP_S <= elapsed_s:
            self._drive_wheels()
            self.engine.step()
            self._steps += 1
            self._integrate_odometry()
            if self._is_due(self.IMU_HZ) and self._imu is not None:
                self._publish_imu()
            if self._is_due(self.ODOM_HZ):
                self._publish_odometry()
            if self._is_due(self.SCAN_HZ):
                self._publish_scan()

    def _is_due(self, rate_hz: int) -> bool:
        return self._steps % round(1.0 / (STEP_S * rate_hz)) == 0

    def _drive_wheels(self) -> None:
        forward, turn = self._command
        if self.engine.time_s - self._command_time_s > COMMAND_TIMEOUT_S:
            forward = 0.0
            turn = 0.0
        left = (forward - 0.5 * BELIEVED_TRACK * turn) / WHEEL_RADIUS
        right = (forward + 0.5 * BELIEVED_TRACK * turn) / WHEEL_RADIUS
        wanted = np.array([left, right, left, right])
        change = WHEEL_ACCELERATION * STEP_S
        self.engine.wheel_speeds += np.clip(
            wanted - self.engine.wheel_speeds, -change, change
        )

    def _odometry_twist(self) -> tuple[float, float]:
        speeds = WHEEL_RADIUS * self.engine.measured_wheel_speeds
        left = 0.5 * (speeds[0] + speeds[2])
        right = 0.5 * (speeds[1] + speeds[3])
        return 0.5 * (left + right), (right - left) / BELIEVED_TRACK

    def _integrate_odometry(self) -> None:
        forward, turn = self._odometry_twist()
        heading = self._odometry[2] + 0.5 * turn * STEP_S
        step = np.array(
            [math.cos(heading) * forward, math.sin(heading) * forward, turn]
        )
        self._odometry += STEP_S * step

    def _stamp_ns(self) -> int:
        return self._started_ns + round(1e9 * self.engine.time_s)

    def _set_stamp(self, header: object) -> None:
        seconds, nanoseconds = divmod(self._stamp_ns(), 10**9)
        header.stamp.sec = seconds  # type: ignore[attr-defined]
        header.stamp.nanosec = nanoseconds  # type: ignore[attr-defined]

    def _publish_odometry(self) -> None:
        forward, turn = self._odometry_twist()
        message = Odometry()
        self._set_stamp(message.header)
        message.header.frame_id = "odom"
        message.child_frame_id = "base_link"
        _fill_pose(message.pose.pose, self._odometry)
        message.twist.twist.linear.x = forward
        message.twist.twist.angular.z = turn
        message.pose.covariance = _covariance(0.001, 0.03)
        message.twist.covariance = _covariance(0.001, 0.03)
        self._odom.publish(message)
        truth = PoseStamped()
        truth.header = message.header
        _fill_pose(truth.pose, self.engine.pose)
        self._true_pose.publish(truth)
        self._touched |= self.engine.touches
        self._touch.publish(Bool(data=self._touched))

    def _publish_imu(self) -> None:
        message = Imu()
        self._set_stamp(message.header)
        message.header.frame_id = "base_link"
        noise = self._rng.normal(0.0, self.GYRO_NOISE)
        message.angular_velocity.z = self.engine.turn_rate + self.GYRO_BIAS + noise
        message.angular_velocity_covariance[8] = self.GYRO_NOISE**2
        message.linear_acceleration.z = 9.81
        message.orientation_covariance[0] = -1.0  # REP-145: it measures no orientation
        self._imu.publish(message)

    def _publish_scan(self) -> None:
        lidar = self._lidar
        ranges = lidar.scan(self._place, self.engine.pose, self._rng)
        message = LaserScan()
        self._set_stamp(message.header)
        message.header.frame_id = "laser"
        message.angle_min = float(lidar.angles[0])
        message.angle_max = float(lidar.angles[-1])
        message.angle_increment = lidar.angle_increment
        message.scan_time = 1.0 / self.SCAN_HZ
        message.range_min = lidar.range_min
        message.range_max = lidar.range_max
        message.ranges = ranges.astype(np.float32).tolist()
        self._scan.publish(message)


def _fill_pose(pose: object, values: Array) -> None:
    pose.position.x = float(values[0])  # type: ignore[attr-defined]
    pose.position.y = float(values[1])  # type: ignore[attr-defined]
    pose.orientation.z = math.sin(0.5 * values[2])  # type: ignore[attr-defined]
    pose.orientation.w = math.cos(0.5 * values[2])  # type: ignore[attr-defined]


def _covariance(linear: float, angular: float) -> list[float]:
    """Returns a planar covariance (36,) by the variances of x, y and heading."""
    values = np.zeros((6, 6))
    for index in (0, 1):
        values[index, index] = linear
    for index in (2, 3, 4):
        values[index, index] = 1e6
    values[5, 5] = angular
    return values.ravel().tolist()


def main() -> None:
    """Runs the driver until it is interrupted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--place", type=Path, required=True, help="JSON: size, pillars")
    parser.add_argument("--pose", type=float, nargs=3, default=(0.0, 0.0, 0.0))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-imu", action="store_true")
    options = parser.parse_args()
    rclpy.init()
    driver = Driver(
        Place.read(options.place),
        np.array(options.pose),
        options.seed,
        not options.no_imu,
    )
    try:
        rclpy.spin(driver)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
