"""A skid-steer robot in DART, Gazebo's physics engine, behind the topics of an ordinary driver.

The extra `dart` builds the place and casts the lidar's rays. Nothing here uses this package's
kinematics: four wheels roll and slip by DART's contacts. The wheels turn the robot less than the
driver's odometry believes, because the driver computes with one effective track. A gyro measures
the true turn rate, with noise and a constant bias.

Subscribes to `cmd_vel` (TwistStamped), publishes `odom`, `scan`, `imu` and, for the judge alone,
`true_pose` and `touched`. `hold` (Bool) fixes the body to the ground while its wheels go on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import dartpy
import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge.extras.dart import scenery
from nics_drl_bridge.extras.physics.scenery import Box, Cylinder
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode

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
LEVEL = 0.5  # of the lidar, and of the middle of walls and pillars [m]
# by which the driver converts wheel speeds and turn rates
BELIEVED_TRACK = 1.35 * TRACK
COMMAND_TIMEOUT_S = 0.5
ODOM_HZ = 20
IMU_HZ = 50
SCAN_HZ = 10
GYRO_BIAS = 0.01  # [rad/s]
GYRO_NOISE = 0.005  # [rad/s]
RANGE_NOISE = 0.005  # standard deviation as a fraction of a range
LIDAR = load_lidar("rplidar_a2")
FRAMES = ("odom", "base_link")
VARIANCES = (0.001, 0.03, 0.001, 0.03)


def _write_wheel(name: str) -> str:
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


def write_robot() -> str:
    """Returns the URDF of the robot: a box on four wheels."""
    size = " ".join(str(side) for side in BODY)
    return f"""<robot name="skid_steer">
    <link name="base_link">
      <inertial><origin xyz="0 0 0.2"/><mass value="38"/>
        <inertia ixx="0.6" iyy="1.4" izz="1.7" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin xyz="0 0 0.25"/><geometry><box size="{size}"/></geometry></collision>
    </link>{"".join(_write_wheel(name) for name in WHEELS)}
    </robot>"""


class Engine:
    """The world of DART with the robot between walls (2,) [m] and pillars x, y, radius (P, 3)."""

    def __init__(
        self, size: Sequence[float], pillars: Sequence[Any], pose: Sequence[float]
    ) -> None:
        self.world = dartpy.simulation.World()
        self.world.setTimeStep(STEP_S)
        self.world.setCollisionDetector(dartpy.simulation.CollisionDetectorType.ODE)
        ground = scenery.add_fixed_body(self.world, "ground")
        slab = dartpy.dynamics.BoxShape([80.0, 80.0, 0.2])
        below = scenery.make_transform([0.0, 0.0, -0.1])
        scenery.let_touch(scenery.add_shape(ground, slab, below), friction=1.0)
        self._seen = scenery.make_group(self._add_walls(size, pillars))
        self._robot = dartpy.utils.DartLoader().parseSkeletonString(write_robot(), "")
        self._base = self._robot.getBodyNode("base_link")
        self._prepare_wheels()
        scenery.place_body(self._base, np.array(pose))
        self.world.addSkeleton(self._robot)
        self._weld: dartpy.constraint.WeldJointConstraint | None = None
        self.wheel_speeds = np.zeros(4)  # asked of the motors [rad/s]

    def _add_walls(self, size: Sequence[float], pillars: Sequence[Any]) -> list[Any]:
        body = scenery.add_fixed_body(self.world, "walls")
        length, width = np.array(size) + THICK
        solids: list[tuple[Any, Array]] = []
        for sign in (-0.5, 0.5):
            beside = Box(np.array([0.0, sign * width]), 0.0, (length, THICK))
            ahead = Box(np.array([sign * length, 0.0]), 0.0, (THICK, width))
            solids += [(wall, scenery.ORIGIN) for wall in (beside, ahead)]
        for x, y, radius in pillars:
            solids.append((Cylinder(radius), np.array([x, y, 0.0])))
        return [
            scenery.add_solid(body, solid, LEVEL, height=1.0, pose=pose)
            for solid, pose in solids
        ]

    def _prepare_wheels(self) -> None:
        joints = [self._robot.getJoint(f"{name}_joint") for name in WHEELS]
        self._wheels = [joint.getIndexInSkeleton(0) for joint in joints]
        for joint, index in zip(joints, self._wheels, strict=True):
            joint.setActuatorType(dartpy.dynamics.ActuatorType.SERVO)
            self._robot.getDof(index).setForceLimits(-MOTOR_TORQUE, MOTOR_TORQUE)
            for node in joint.getChildBodyNode().getShapeNodes():
                node.getDynamicsAspect().setFrictionCoeff(FRICTION)

    def step(self) -> None:
        """Moves the world by one step."""
        self._robot.setCommands(self._wheels, self.wheel_speeds)
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
        return np.array(self._robot.getVelocities(self._wheels))

    @property
    def touches(self) -> bool:
        """True if the robot touches something other than the ground."""
        for contact in self.world.getLastCollisionResult().getContacts():
            pair = (contact.collisionObject1, contact.collisionObject2)
            nodes = [one.getShapeFrame().asShapeNode() for one in pair]
            if {node.getSkeleton().getName() for node in nodes} == {
                "skid_steer",
                "walls",
            }:
                return True
        return False

    def cast_scan(self) -> Array:
        """Returns the ranges (B,) [m] of the lidar, without noise."""
        return scenery.cast_scan(self._seen, LIDAR, self.pose, LEVEL)


class Driver(SpunNode):
    """The topics of the robot, in real time."""

    def __init__(self, engine: Engine, seed: int, has_imu: bool) -> None:
        super().__init__("base_driver")
        self._engine = engine
        self._rng = np.random.default_rng(seed)
        self._odometry = np.zeros(3)
        self._command = np.zeros(3)
        self._command_time_s = -math.inf
        self._steps = 0
        self._touched = False
        self._started_ns = time.time_ns()
        node = self.node
        node.create_subscription(TwistStamped, "cmd_vel", self._take_command, 1)
        node.create_subscription(
            Bool, "hold", lambda message: engine.hold(message.data), 10
        )
        self._odom = node.create_publisher(Odometry, "odom", 10)
        self._scan = node.create_publisher(LaserScan, "scan", qos.SENSOR)
        self._imu = node.create_publisher(Imu, "imu", qos.SENSOR) if has_imu else None
        self._truth = node.create_publisher(Odometry, "true_pose", 10)
        self._touch = node.create_publisher(Bool, "touched", 10)

    def _take_command(self, message: TwistStamped) -> None:
        self._command = conversions.twist_from_ros(message)
        self._command_time_s = self._engine.time_s

    def catch_up(self) -> None:
        """Catches up with the clock, and publishes what has become due."""
        elapsed_s = (time.time_ns() - self._started_ns) / NS_PER_S
        while self._engine.time_s + STEP_S <= elapsed_s:
            self._drive_wheels()
            self._engine.step()
            self._steps += 1
            forward, turn = self._measure_twist()
            heading = self._odometry[2] + 0.5 * turn * STEP_S
            way = [math.cos(heading) * forward, math.sin(heading) * forward, turn]
            self._odometry += STEP_S * np.array(way)
            if self._is_due(IMU_HZ) and self._imu is not None:
                self._publish_imu()
            if self._is_due(ODOM_HZ):
                self._publish_odometry([forward, 0.0, turn])
            if self._is_due(SCAN_HZ):
                ranges = self._engine.cast_scan()
                ranges *= 1.0 + self._rng.normal(0.0, RANGE_NOISE, LIDAR.beams)
                ranges = ranges.astype(np.float32)
                scan = conversions.scan_to_ros(LIDAR, ranges, self._stamp_ns, "laser")
                self._scan.publish(scan)

    def _is_due(self, rate_hz: int) -> bool:
        return self._steps % round(1.0 / (STEP_S * rate_hz)) == 0

    def _drive_wheels(self) -> None:
        forward, _, turn = self._command
        if self._engine.time_s - self._command_time_s > COMMAND_TIMEOUT_S:
            forward = turn = 0.0
        left = (forward - 0.5 * BELIEVED_TRACK * turn) / WHEEL_RADIUS
        right = (forward + 0.5 * BELIEVED_TRACK * turn) / WHEEL_RADIUS
        missing = np.array([left, right, left, right]) - self._engine.wheel_speeds
        change = WHEEL_ACCELERATION * STEP_S
        self._engine.wheel_speeds += np.clip(missing, -change, change)

    def _measure_twist(self) -> tuple[float, float]:
        """Returns speed and turn rate as the driver believes them by its encoders."""
        speeds = WHEEL_RADIUS * self._engine.measured_wheel_speeds
        left, right = 0.5 * (speeds[:2] + speeds[2:])
        return 0.5 * (left + right), (right - left) / BELIEVED_TRACK

    @property
    def _stamp_ns(self) -> int:
        return self._started_ns + round(NS_PER_S * self._engine.time_s)

    def _publish_odometry(self, twist: Sequence[float]) -> None:
        about = twist, self._stamp_ns, FRAMES, VARIANCES
        self._odom.publish(conversions.odometry_to_ros(self._odometry, *about))
        self._truth.publish(conversions.odometry_to_ros(self._engine.pose, *about))
        self._touched |= self._engine.touches
        self._touch.publish(Bool(data=self._touched))

    def _publish_imu(self) -> None:
        message = Imu(header=conversions.header_to_ros(self._stamp_ns, "base_link"))
        noise = self._rng.normal(0.0, GYRO_NOISE)
        message.angular_velocity.z = self._engine.turn_rate + GYRO_BIAS + noise
        message.angular_velocity_covariance[8] = GYRO_NOISE**2
        message.linear_acceleration.z = 9.81
        message.orientation_covariance[0] = -1.0  # REP-145: it measures no orientation
        self._imu.publish(message)


def run(
    size: Sequence[float], pillars: Sequence[Any], seed: int, has_imu: bool
) -> None:
    """Runs the driver until it is killed."""
    driver = Driver(Engine(size, pillars, [0.0, 0.0, 0.0]), seed, has_imu)
    while True:
        driver.spin(0.001)
        driver.catch_up()
