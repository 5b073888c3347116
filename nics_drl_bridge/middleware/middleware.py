"""The middleware: topics in, RobotView out (Sec. VI, Fig. 5)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, RobotView
from nics_drl_bridge.middleware.cache import Stamps, TopicCache
from nics_drl_bridge.middleware.ekf import LEAST_POSE_STD, LEAST_TWIST_STD, START_STD, Estimator
from nics_drl_bridge.middleware.measurement import (
    CMD_VEL,
    ODOM,
    SCAN,
    Acceptance,
    Health,
    Kind,
    Measurement,
    TopicHealth,
    checked_covariance,
)
from nics_drl_bridge.middleware.timeline import BEFORE_START, TOO_OLD, Timeline
from nics_drl_bridge.middleware.trail import ReportedPose, Trail

Array = NDArray[np.float64]

NOT_FINITE = "NaN or inf"


class Middleware:
    """Caches the newest datum of a robot's topics and estimates its state.

    The simulator in process, the nodes and the vehicle all feed this one class, so that the
    same data give the same view. Times are stamps in nanoseconds; arrivals are on the clock of
    the receiver, which need not be that of the stamps. Data that cannot be used are counted by
    reason, see `health`, and change nothing else.

    Args:
        model: of the robot.
    """

    def __init__(self, model: SimulatorModel) -> None:
        self._beams = model.lidar.beams
        self._width = len(model.robot.command)
        self._unknown = np.full(self._beams, np.nan, np.float32)
        self.estimator = Estimator(model)
        self._timeline = Timeline(self.estimator)
        self._trail = Trail(self.estimator.unseen.walk)
        self._stamps = Stamps(round(model.control_period * NS_PER_S))
        self._off_the_clock = (self._stamps.from_the_future, TOO_OLD, BEFORE_START)
        self.reset(0, np.zeros(3))

    def reset(self, time_ns: int, pose: ArrayLike, std: ArrayLike = START_STD) -> None:
        """Forgets everything; the robot is at rest at a pose (3,) in `map`.

        Args:
            time_ns: of the reset [ns]; data that are not newer correct nothing.
            pose: x [m], y [m], heading [rad].
            std: standard deviation of the pose [m, rad]: one number, or (3,).
        """
        self.cache = TopicCache()
        self._clock_jumps = 0
        self._commanded = np.zeros(self._width)
        self.estimator.reset(time_ns, pose, std)
        self._trail.reset()
        self._begin(time_ns)

    def _begin(self, time_ns: int) -> None:
        """Continues from a time with the present state of the estimator."""
        self._start_ns, self._unstamped_ns = time_ns, time_ns - 1
        self._stamps.reset()
        self._timeline.reset()

    def expect_beams(self, beams: int) -> None:
        """Sets the number of beams of the scans to come; the newest scan is forgotten."""
        self._beams, self._unknown = beams, np.full(beams, np.nan, np.float32)
        self.cache.newest.pop(SCAN, None)

    def command(
        self, stamp_ns: int | None, command: ArrayLike, arrival_ns: int | None = None
    ) -> bool:
        """Takes a command (C,) that was sent to the robot; True if it was used.

        Args:
            stamp_ns: when it was sent [ns]; if None, at the stamp of the newest datum, and
                after every earlier command without a stamp.
            command: in the units and the order of the RobotSpec.
            arrival_ns: when it arrived [ns]; None for own commands, whose stamps need no check.
        """
        if stamp_ns is None:
            stamp_ns = max(self.newest_ns or self._start_ns, self._unstamped_ns + 1)
            self._unstamped_ns = stamp_ns
        value = np.array(command, dtype=np.float64)
        reason = ""
        if value.shape != (self._width,):
            reason = f"shape {value.shape}, not ({self._width},)"
        elif not np.isfinite(value).all():
            reason = NOT_FINITE
        else:
            # The robot follows it whatever its stamp: the clock may have been set meanwhile.
            self._commanded = value
        reason = reason or self._stamps.fault(stamp_ns, arrival_ns)
        reason = reason or self._timeline.command(stamp_ns, value)
        if reason:
            self.cache.reject(f"{CMD_VEL}: {reason}")
            return False
        return True

    def foresee(self, stamp_ns: int) -> None:
        """Prepares for the next expected odometry, of a stamp [ns]."""
        self.estimator.foresee(stamp_ns)

    def scan(self, stamp_ns: int, arrival_ns: int, ranges: NDArray[np.float32]) -> bool:
        """Takes a scan (B,); True if it was used. Only the newest scan is kept."""
        fault = self._stamps.fault(stamp_ns, arrival_ns)
        if ranges.shape != (self._beams,):
            fault = f"shape {ranges.shape}, not ({self._beams},)"
        if fault:
            self.cache.reject(f"{SCAN}: {fault}")
            return False
        if not self.cache.put(SCAN, stamp_ns, arrival_ns, ranges):
            return False
        self._stamps.accept(stamp_ns, arrival_ns)
        return True

    def odometry(self, stamp_ns: int, arrival_ns: int, pose: ArrayLike, twist: ArrayLike) -> bool:
        """Takes an odometry: pose (3,) in `odom`, body twist (3,); True if it was accepted.

        The twist corrects the estimate. The pose, which drifts, only bridges motion for which
        there are no other data: when the clock was set, or after a loss of data.
        """
        value = np.array(pose, dtype=np.float64), np.array(twist, dtype=np.float64)
        if not (np.isfinite(value[0]).all() and np.isfinite(value[1]).all()):
            self.cache.reject(f"{ODOM}: {NOT_FINITE}")
            return False
        if fault := self._stamps.fault(stamp_ns, None):
            self.cache.reject(f"{ODOM}: {fault}")
            return False
        told = ReportedPose(stamp_ns, arrival_ns, *value)
        if stamp_ns == self._start_ns and ODOM not in self.cache.newest:
            # At a reset the pose is known: the odometry of that time adds nothing.
            self._timeline.anchor(value[0])
        elif self._trail.contradicts(told):
            self._follow_clock(told)
        else:
            return self._measure_odometry(told, value)
        self._stamps.accept(stamp_ns, arrival_ns)
        self.cache.take(ODOM, stamp_ns, arrival_ns, value)
        self._trail.use(told)
        return True

    def _measure_odometry(self, told: ReportedPose, value: tuple[Array, Array]) -> bool:
        """Measures an odometry; True if accepted. Continues from it if the clock was set."""
        measurement = Measurement(Kind.TWIST, told.twist, odom=told.pose)
        reason = self._measure(told.stamp_ns, told.arrival_ns, measurement, value)
        if not reason:
            self._trail.use(told)
        elif reason in self._off_the_clock:
            if self._stamps.refuse():
                self._follow_clock(told)
            else:
                self._trail.refuse(told)
        return not reason

    def pose(
        self,
        stamp_ns: int,
        arrival_ns: int,
        pose: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Takes a measured pose, such as from motion capture or AMCL; True if it was accepted.

        Args:
            stamp_ns: when it was measured [ns].
            arrival_ns: when it arrived [ns].
            pose: (3,) x [m], y [m], heading [rad] in `map`.
            covariance: (3, 3) of the pose; the model's pose noise if None or all zeros.
        """
        value = np.array(pose, dtype=np.float64)
        return self._optional(Kind.POSE, stamp_ns, arrival_ns, value, covariance, LEAST_POSE_STD)

    def imu(
        self, stamp_ns: int, arrival_ns: int, yaw_rate: float, variance: float | None = None
    ) -> bool:
        """Takes a yaw rate [rad/s] of a gyro; True if it was accepted.

        Args:
            stamp_ns: when it was measured [ns].
            arrival_ns: when it arrived [ns].
            yaw_rate: about the upward axis, counter-clockwise [rad/s].
            variance: of the yaw rate [rad^2/s^2]; that of a cheap gyro if None or zero.
        """
        value = np.array([yaw_rate], dtype=np.float64)
        covariance = None if variance is None else [[variance]]
        least = LEAST_TWIST_STD
        return self._optional(Kind.YAW_RATE, stamp_ns, arrival_ns, value, covariance, least)

    def _optional(
        self,
        kind: Kind,
        stamp_ns: int,
        arrival_ns: int,
        value: NDArray[np.float64],
        covariance: ArrayLike | None,
        least_std: float,
    ) -> bool:
        """Takes a measurement that came with its own covariance; True if it was accepted."""
        if not np.isfinite(value).all():
            self.cache.reject(f"{kind.topic}: {NOT_FINITE}")
            return False
        try:
            noise = checked_covariance(covariance, len(value), least_std)
        except ValueError as error:
            self.cache.reject(f"{kind.topic}: {error}")
            return False
        return not self._measure(stamp_ns, arrival_ns, Measurement(kind, value, noise), value)

    def _measure(self, stamp_ns: int, arrival_ns: int, measurement: Measurement, kept: Any) -> str:
        """Takes a measurement; returns the reason if it cannot be used, or an empty string."""
        topic = measurement.kind.topic
        fault = self._stamps.fault(stamp_ns, arrival_ns)
        reason = fault or self._timeline.measure(stamp_ns, measurement)
        if reason:
            self.cache.reject(f"{topic}: {reason}")
        else:
            self._stamps.accept(stamp_ns, arrival_ns)
            self.cache.take(topic, stamp_ns, arrival_ns, kept)
        return reason

    def _follow_clock(self, told: ReportedPose) -> None:
        """Continues from an odometry to whose stamp the clock was set.

        Starts at the estimate after the last used odometry and adds the motion that odometry
        shows since; if odometry is not continuous, the robot may be anywhere within reach.
        """
        seconds, continuous = self._trail.seconds(told), self._trail.continuous(told)
        self.estimator.lose(told.stamp_ns, seconds, continuous, self._commanded)
        self.estimator.correct(Measurement(Kind.TWIST, told.twist, odom=told.pose))
        self._begin(told.stamp_ns)
        self._trail.reset()
        self._trail.use(told)
        self.cache.newest.clear()
        self._clock_jumps += 1

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest datum of all topics [ns]; None if there is none."""
        return max((datum.stamp_ns for datum in self.cache.newest.values()), default=None)

    def view(self, now_ns: int) -> RobotView:
        """Returns the view of the robot at a time; NaN ranges before the first scan."""
        pose, twist = self.estimator.at(now_ns)
        scan, newest_ns = self.cache.newest.get(SCAN), self.newest_ns
        return RobotView(
            pose=pose,
            twist=twist,
            ranges=self._unknown.copy() if scan is None else scan.value,
            stamp_s=(now_ns if newest_ns is None else newest_ns) * 1e-9,
            scan_age_s=self.cache.age_s(SCAN, now_ns),
            odom_age_s=self.cache.age_s(ODOM, now_ns),
        )

    def health(self, arrival_ns: int) -> Health:
        """Returns the health of all topics at a time of the receiver's clock [ns]."""
        cache, outcomes = self.cache, self._timeline.outcomes()
        distances = {kind.topic: d for kind, d in self._timeline.distances().items()}
        topics = {
            topic: TopicHealth(
                received,
                cache.rate_hz(topic, arrival_ns),
                (arrival_ns - cache.arrivals[topic][-1]) * 1e-9,
                distances.get(topic, math.nan),
            )
            for topic, received in cache.received.items()
        }
        surprises = {
            (kind, outcome): f"{kind.topic}: {outcome.name.lower()}" for kind, outcome in outcomes
        }
        rejected = {surprises[k]: n for k, n in outcomes.items() if k[1] is Acceptance.OUTLIER}
        noticed = {
            surprises[k]: n
            for k, n in outcomes.items()
            if k[1] in (Acceptance.NEWS, Acceptance.JUMP)
        }
        if self._clock_jumps:
            noticed["clock: jump"] = self._clock_jumps
        return Health(topics, cache.rejected | rejected, noticed, self._timeline.replayed)


def rehearse(model: SimulatorModel) -> RobotView:
    """Runs a middleware through two periods of a robot at rest; returns its last view.

    This compiles everything beforehand, which could take seconds while the robot moves.
    """
    middleware, period_ns = Middleware(model), round(model.control_period * 1e9)
    middleware.reset(0, np.zeros(3))
    still, free = np.zeros(3), np.full(model.lidar.beams, np.inf, np.float32)
    for stamp_ns in (period_ns, 2 * period_ns):
        middleware.command(stamp_ns - period_ns, model.robot.from_cmd_vel(still))
        middleware.odometry(stamp_ns, stamp_ns, still, still)
        middleware.scan(stamp_ns, stamp_ns, free)
    return middleware.view(2 * period_ns)
