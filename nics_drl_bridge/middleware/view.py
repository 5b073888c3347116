"""The middleware: topics in, RobotView out (Sec. VI, Fig. 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.cache import TopicCache
from nics_drl_bridge.middleware.ekf import Estimator

SCAN, ODOM, CMD_VEL = "scan", "odom", "cmd_vel"


class Middleware:
    """Caches the newest scan and odometry of a robot and estimates its state.

    The simulator in process, the nodes and the vehicle all feed this one class, so that the
    same data give the same view. Times are stamps in nanoseconds.

    Args:
        model: of the robot.
    """

    def __init__(self, model: SimulatorModel) -> None:
        self._beams = model.lidar.beams
        self.estimator = Estimator(model)
        self.cache = TopicCache()

    def reset(self, time_ns: int, pose: ArrayLike) -> None:
        """Forgets everything; the robot stands at a known pose (3,) in `map`."""
        self.cache = TopicCache()
        self.estimator.reset(time_ns, pose)

    def command(self, stamp_ns: int, command: ArrayLike) -> bool:
        """Notes a command (C,) that was sent to the robot; says whether it was used."""
        if not np.isfinite(command).all():
            self.cache.reject(f"{CMD_VEL}: NaN or inf")
            return False
        self.estimator.command(stamp_ns, command)
        return True

    def scan(self, stamp_ns: int, arrival_ns: int, ranges: NDArray[np.float32]) -> bool:
        """Takes a scan (B,); says whether it was used."""
        if ranges.shape != (self._beams,):
            self.cache.reject(f"{SCAN}: shape {ranges.shape}, not ({self._beams},)")
            return False
        return self.cache.put(SCAN, stamp_ns, arrival_ns, ranges)

    def odometry(self, stamp_ns: int, arrival_ns: int, pose: ArrayLike, twist: ArrayLike) -> bool:
        """Takes an odometry: pose (3,) in `odom`, body twist (3,); says whether it was used."""
        pose, twist = np.asarray(pose, dtype=np.float64), np.asarray(twist, dtype=np.float64)
        if not (np.isfinite(pose).all() and np.isfinite(twist).all()):
            self.cache.reject(f"{ODOM}: NaN or inf")
            return False
        if not self.cache.put(ODOM, stamp_ns, arrival_ns, (pose, twist)):
            return False
        if stamp_ns > self.estimator.time_ns:
            self.estimator.predict(stamp_ns)
            self.estimator.update_twist(twist)
        return True

    def view(self, now_ns: int) -> RobotView:
        """What is known about the robot at a time; NaN ranges before the first scan."""
        pose, twist = self.estimator.at(now_ns)
        scan = self.cache.newest.get(SCAN)
        ranges = np.full(self._beams, np.nan, np.float32) if scan is None else scan.value
        newest = max((datum.stamp_ns for datum in self.cache.newest.values()), default=now_ns)
        return RobotView(
            pose=pose,
            twist=twist,
            ranges=ranges,
            stamp_s=newest * 1e-9,
            scan_age_s=self.cache.age_s(SCAN, now_ns),
            odom_age_s=self.cache.age_s(ODOM, now_ns),
        )
