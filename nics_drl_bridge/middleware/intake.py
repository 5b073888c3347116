"""Feeds the middleware with a robot's messages; those of ROS 2 and of bags have the same fields."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.sectors import Reader
from nics_drl_bridge.lidar.sensor import Sensor
from nics_drl_bridge.lidar.spec import from_device
from nics_drl_bridge.middleware.ekf import ANYWHERE, START_STD
from nics_drl_bridge.middleware.measurement import IMU, ODOM, POSE, SCAN
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.recording.imu_axis import GyroReader
from nics_drl_bridge.recording.messages import (
    get_stamp,
    read_pose_covariance,
    read_turn_variance,
    read_twist,
    read_whole_pose,
)


class Intake:
    """Takes messages by their roles, and starts the estimate.

    The first odometry defines `map`, or with `has_pose` the first pose.
    """

    def __init__(self, model: SimulatorModel, has_pose: bool) -> None:
        self._model = model
        self._start_std = ANYWHERE if has_pose else START_STD
        self.middleware = Middleware(model)
        self._gyro = GyroReader()
        self._takes: dict[str, Callable[[int, Any], bool]] = {
            SCAN: self._take_scan,
            ODOM: self._take_odometry,
            POSE: self._take_pose,
            IMU: self._take_imu,
        }
        for sensor in model.sensors:
            self._takes[sensor.name] = partial(self._take_reading, sensor)
        self.restart()

    def restart(self) -> None:
        """Clear all state; the next odometry starts again."""
        self._started = False
        self._since_ns = 0
        # pose (3,) in `map` at the start, and its covariance (3, 3), if they are known
        self._placed: tuple[Array, Array] | None = None
        self.middleware.reset(0, np.zeros(3))

    def begin(self, stamp_ns: int, pose: Array) -> None:
        """Clear all state before a stamp [ns] at which the robot stands at a pose (3,)."""
        self._started = True
        self._since_ns = stamp_ns
        self.middleware.reset(stamp_ns, pose)

    def place(self, pose: Array, covariance: Array) -> None:
        """Define `map` so that the robot's pose in it is `pose` (3,), now or when it starts."""
        self._placed = pose, covariance
        if self._started:
            self.middleware.place(pose, covariance)

    def find_reader(self, scan: Any) -> Reader | None:
        """Return the reader for a scan's ranges; None for a lidar that can't be used."""
        raise NotImplementedError

    def take(self, role: str, arrival_ns: int, message: Any) -> bool:
        """Take a message; True if it was used and is the newest of its topic."""
        if not self._takes[role](arrival_ns, message):
            return False
        newest = self.middleware.cache.newest.get(role)
        return newest is not None and newest.stamp_ns == get_stamp(message)

    def _take_scan(self, arrival_ns: int, message: Any) -> bool:
        stamp_ns = get_stamp(message)
        if stamp_ns < self._since_ns:
            return False
        reader = self.find_reader(message)
        if reader is None:
            return self.middleware.cache.reject(SCAN, "another lidar")
        ordered = reader.ordered(np.asarray(message.ranges, np.float32))
        ranges = from_device(np.ascontiguousarray(ordered), reader.lidar)
        return self.middleware.scan(stamp_ns, arrival_ns, ranges)

    def _take_odometry(self, arrival_ns: int, message: Any) -> bool:
        stamp_ns = get_stamp(message)
        pose = np.array(read_whole_pose(message))
        if not self._started and np.isfinite(pose).all():
            self.middleware.reset(stamp_ns, pose, self._start_std)
            self._started = True
            if self._placed is not None:
                self.middleware.place(*self._placed)
        twist = np.array(read_twist(message))
        variance = read_turn_variance(message)
        return self.middleware.odometry(stamp_ns, arrival_ns, pose, twist, variance)

    def _take_pose(self, arrival_ns: int, message: Any) -> bool:
        pose = read_whole_pose(message)
        covariance = read_pose_covariance(message)
        return self.middleware.pose(get_stamp(message), arrival_ns, pose, covariance)

    def _take_imu(self, arrival_ns: int, message: Any) -> bool:
        measured = self._gyro.read(message)
        if measured is None:
            return self.middleware.cache.reject(IMU, "no angular velocity")
        return self.middleware.imu(get_stamp(message), arrival_ns, *measured)

    def _take_reading(self, sensor: Sensor, arrival_ns: int, message: Any) -> bool:
        name = sensor.name
        try:
            reading = sensor.read(message)
        except ValueError as error:
            return self.middleware.cache.reject(name, str(error))
        return self.middleware.sense(name, get_stamp(message), arrival_ns, reading)
