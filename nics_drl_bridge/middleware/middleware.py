"""The middleware: topics in, RobotView out (Sec. VI, Fig. 5)."""

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, S_PER_NS, Array, RobotView
from nics_drl_bridge.lidar.sensor import unread
from nics_drl_bridge.middleware.belief import decorrelate_pose
from nics_drl_bridge.middleware.ekf import (
    MIN_POSE_STD,
    MIN_TWIST_STD,
    START_STD,
    Estimator,
)
from nics_drl_bridge.middleware.measurement import (
    CMD_VEL,
    ODOM,
    SCAN,
    Acceptance,
    Health,
    Kind,
    Measurement,
    Rejection,
    TopicHealth,
    check_covariance,
)
from nics_drl_bridge.middleware.timeline import Refusal, Stamps, Timeline

NOT_FINITE = "NaN or inf"
MIN_STD = {Kind.YAW_RATE: MIN_TWIST_STD, Kind.POSE: MIN_POSE_STD}
RATE_WINDOW = 32  # number of arrivals over which rates are computed


class Datum(NamedTuple):
    """A message with stamp, arrival on the receiver's clock, and number of earlier messages."""

    stamp_ns: int
    arrival_ns: int
    sequence: int
    value: Any


@dataclass
class TopicCache:
    """Newest datum, number and latest arrivals [ns] of each topic's data; counts of rejections."""

    newest: dict[str, Datum] = field(default_factory=dict)
    rejected: Counter[Rejection] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)
    arrivals: dict[str, deque[int]] = field(default_factory=dict)

    def put(self, topic: str, stamp_ns: int, arrival_ns: int, value: Any) -> bool:
        """Stores a datum unless it is older than the cached one or a duplicate; True if stored."""
        newest = self.newest.get(topic)
        if newest is not None and stamp_ns < newest.stamp_ns:
            return self.reject(topic, "out of order")
        if newest is not None and stamp_ns == newest.stamp_ns:
            return self.reject(topic, "duplicate")
        self.take(topic, stamp_ns, arrival_ns, value)
        return True

    def take(self, topic: str, stamp_ns: int, arrival_ns: int, value: Any) -> None:
        """Counts a datum, and stores it if it is the newest."""
        newest = self.newest.get(topic)
        if newest is None or stamp_ns > newest.stamp_ns:
            self.newest[topic] = Datum(
                stamp_ns, arrival_ns, self.received[topic], value
            )
        self.received[topic] += 1
        self.arrivals.setdefault(topic, deque(maxlen=RATE_WINDOW)).append(arrival_ns)

    def reject(self, topic: str, reason: str) -> bool:
        """Counts a rejected datum; returns False."""
        self.rejected[Rejection(topic, reason)] += 1
        return False

    def age_s(self, topic: str, now_ns: int) -> float:
        """Age of the newest datum by its stamp [s]; inf if there is none."""
        newest = self.newest.get(topic)
        if newest is None:
            return math.inf
        return (now_ns - newest.stamp_ns) * S_PER_NS

    def silence_s(self, topic: str, now_ns: int) -> float:
        """Time since the latest arrival, by the receiver's clock [s]; inf if there was none."""
        if topic not in self.arrivals:
            return math.inf
        return (now_ns - self.arrivals[topic][-1]) * S_PER_NS

    def rate_hz(self, topic: str, arrival_ns: int) -> float:
        """Rate of arrivals by the receiver's clock [Hz]; it falls while a datum is overdue."""
        arrivals = self.arrivals.get(topic, deque())
        intervals = len(arrivals) - 1
        if intervals < 1:
            return 0.0
        overdue_ns = (arrival_ns - arrivals[0]) * intervals / (intervals + 1)
        span_ns = max(arrivals[-1] - arrivals[0], overdue_ns)
        if span_ns <= 0:
            return 0.0
        return intervals / (span_ns * S_PER_NS)


class Middleware:
    """Caches the newest datum of a robot's topics and estimates its state.

    Simulator, nodes and vehicle all feed this class, so the same data give the same view. Times are
    stamps [ns]; arrivals are on the receiver's clock, which may differ from the stamps' clock.
    Refused data are counted by reason, see `health`, and do not change the estimate.
    """

    def __init__(self, model: SimulatorModel) -> None:
        self._beams = model.lidar.beams
        self._width = len(model.robot.command)
        self._sensors = model.sensors
        self.estimator = Estimator(model)
        self._timeline = Timeline(self.estimator)
        self._stamps = Stamps(round(model.control_period * NS_PER_S))
        self.reset(0, np.zeros(3))

    def reset(self, time_ns: int, pose: ArrayLike, std: ArrayLike = START_STD) -> None:
        """Forgets everything; the robot is at rest at a pose (3,) in `map`, with deviations."""
        self.cache = TopicCache()
        self._clock_jumps = 0
        self._commanded = np.zeros(self._width)
        self.estimator.reset(time_ns, pose, std)
        self._start(time_ns)

    def place(self, pose: ArrayLike, covariance: ArrayLike) -> None:
        """Moves the estimate to a pose (3,) in `map`, with a covariance (3, 3).

        The robot's state, its odometry and all topics are kept.
        """
        belief = self.estimator.belief
        mean = belief.mean.copy()
        mean[:3] = pose
        whole = decorrelate_pose(belief.covariance)
        whole[:3, :3] = covariance
        clone = belief.clone
        if clone is not None:
            clone = clone._replace(mean=mean, covariance=whole, correlated=False)
        self.estimator.belief = belief._replace(
            mean=mean, covariance=whole, clone=clone
        )
        self._timeline.reset()

    def _start(self, time_ns: int) -> None:
        self._start_ns = time_ns
        self._unstamped_ns = time_ns - 1
        self._stamps.reset()
        self._timeline.reset()

    def expect_beams(self, beams: int) -> None:
        """Sets the number of beams of future scans, and forgets the newest scan."""
        self._beams = beams
        self.cache.newest.pop(SCAN, None)

    def command(
        self, stamp_ns: int | None, command: ArrayLike, arrival_ns: int | None = None
    ) -> bool:
        """Takes a command (C,) that was sent to the robot; True if it was used.

        Without a stamp, it counts as sent with the newest datum. A node's own commands have no
        arrival.
        """
        if stamp_ns is None:
            stamp_ns = max(self.newest_ns or self._start_ns, self._unstamped_ns + 1)
            self._unstamped_ns = stamp_ns
        value = np.array(command, dtype=np.float64)
        if value.shape != (self._width,):
            reason = f"shape {value.shape}, not ({self._width},)"
            return self.cache.reject(CMD_VEL, reason)
        if not np.isfinite(value).all():
            return self.cache.reject(CMD_VEL, NOT_FINITE)
        # The robot follows it regardless of its stamp, because the clock may have been
        # set.
        self._commanded = value
        refusal = self._stamps.find_fault(stamp_ns, arrival_ns)
        if refusal is None:
            refusal = self._timeline.command(stamp_ns, value)
        return refusal is None or self.cache.reject(CMD_VEL, refusal.reason)

    def scan(self, stamp_ns: int, arrival_ns: int, ranges: NDArray[np.float32]) -> bool:
        """Takes a scan (B,); True if it was used. Only the newest scan is kept."""
        taken = self._keep(SCAN, stamp_ns, arrival_ns, ranges, self._beams)
        if taken:
            self._stamps.accept(stamp_ns, arrival_ns)
        return taken

    def sense(
        self, name: str, stamp_ns: int, arrival_ns: int, reading: NDArray[np.float32]
    ) -> bool:
        """Takes a reading (S,) of an additional sensor; True if used. Only the newest is kept."""
        size = next(sensor.size for sensor in self._sensors if sensor.name == name)
        return self._keep(name, stamp_ns, arrival_ns, reading, size)

    def _keep(
        self,
        topic: str,
        stamp_ns: int,
        arrival_ns: int,
        values: NDArray[np.float32],
        size: int,
    ) -> bool:
        if values.shape != (size,):
            return self.cache.reject(topic, f"shape {values.shape}, not ({size},)")
        refusal = self._stamps.find_fault(stamp_ns, arrival_ns)
        if refusal is not None:
            return self.cache.reject(topic, refusal.reason)
        return self.cache.put(topic, stamp_ns, arrival_ns, values)

    def odometry(
        self,
        stamp_ns: int,
        arrival_ns: int,
        pose: ArrayLike,
        twist: ArrayLike,
        turn_variance: float | None = None,
    ) -> bool:
        """Takes an odometry: pose (3,) in `odom`, body twist (3,); True if it was accepted.

        The twist and the pose relative to the previous odometry correct the estimate. The pose
        itself drifts, so it only bridges motion without other data. The larger the
        variance of the twist's yaw rate (by default the model's), the higher the weight
        of the gyro's turn.
        """
        value = np.array((pose, twist), dtype=np.float64)
        if not np.isfinite(value).all():
            return self.cache.reject(ODOM, NOT_FINITE)
        refusal = self._stamps.find_fault(stamp_ns, None)
        if refusal is not None:
            return self.cache.reject(ODOM, refusal.reason)
        if stamp_ns == self._start_ns and ODOM not in self.cache.newest:
            # The pose is known at a reset, so odometry at that time adds no
            # information.
            self._timeline.clone_start(value[0])
            self._stamps.accept(stamp_ns, arrival_ns)
            self.cache.take(ODOM, stamp_ns, arrival_ns, value)
            return True
        measurement = Measurement(
            Kind.TWIST, value[1], odom=value[0], turn_variance=turn_variance
        )
        refusal = self._measure(stamp_ns, arrival_ns, measurement, value)
        if refusal is None:
            return True
        if refusal.may_be_clock and self._stamps.refuse():
            self._follow_clock(stamp_ns, arrival_ns, measurement)
        return False

    def pose(
        self,
        stamp_ns: int,
        arrival_ns: int,
        pose: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Takes a pose (3,) in `map`, by default with the model's covariance; True if used."""
        return self._take_optional(Kind.POSE, stamp_ns, arrival_ns, pose, covariance)

    def imu(
        self,
        stamp_ns: int,
        arrival_ns: int,
        yaw_rate: float,
        variance: float | None = None,
    ) -> bool:
        """Takes a yaw rate [rad/s], by default with a cheap gyro's variance; True if used.

        The next odometry's turn is fused with it, see `turning`.
        """
        covariance = None if variance is None else [[variance]]
        return self._take_optional(
            Kind.YAW_RATE, stamp_ns, arrival_ns, [yaw_rate], covariance
        )

    def _take_optional(
        self,
        kind: Kind,
        stamp_ns: int,
        arrival_ns: int,
        values: ArrayLike,
        covariance: ArrayLike | None,
    ) -> bool:
        value = np.array(values, dtype=np.float64)
        if not np.isfinite(value).all():
            return self.cache.reject(kind.topic, NOT_FINITE)
        try:
            noise = check_covariance(covariance, len(value), MIN_STD[kind])
        except ValueError as error:
            return self.cache.reject(kind.topic, str(error))
        measurement = Measurement(kind, value, noise)
        return self._measure(stamp_ns, arrival_ns, measurement, value) is None

    def _measure(
        self, stamp_ns: int, arrival_ns: int, measurement: Measurement, datum: Array
    ) -> Refusal | None:
        """Takes a measurement and caches its datum; returns the reason for a refusal, or None."""
        topic = measurement.kind.topic
        refusal = self._stamps.find_fault(stamp_ns, arrival_ns)
        if refusal is None:
            refusal = self._timeline.measure(stamp_ns, measurement)
        if refusal is not None:
            self.cache.reject(topic, refusal.reason)
        else:
            self._stamps.accept(stamp_ns, arrival_ns)
            self.cache.take(topic, stamp_ns, arrival_ns, datum)
        return refusal

    def _follow_clock(
        self, stamp_ns: int, arrival_ns: int, odometry: Measurement
    ) -> None:
        """Restarts at the last pose and at the stamp of an odometry, after the clock was set."""
        seconds = 0.0
        if ODOM in self.cache.newest:
            last_ns = self.cache.newest[ODOM].arrival_ns
            seconds = (arrival_ns - last_ns) * S_PER_NS
        self.estimator.restart(stamp_ns, seconds, self._commanded)
        self.estimator.correct(odometry)
        self._start(stamp_ns)
        self.cache.newest.clear()
        self._clock_jumps += 1

    @property
    def commanded(self) -> Array:
        """Latest command (C,), regardless of its stamp."""
        return self._commanded

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest datum of all topics [ns]; None if there is none."""
        return max(
            (datum.stamp_ns for datum in self.cache.newest.values()), default=None
        )

    def view(self, now_ns: int) -> RobotView:
        """Returns the view of the robot at a time; its ranges are NaN before the first scan."""
        newest = self.cache.newest
        newest_ns = self.newest_ns
        if newest_ns is None:
            newest_ns = now_ns
        ranges = np.full(self._beams, np.nan, np.float32)
        if SCAN in newest:
            ranges = newest[SCAN].value
        sensed = unread(self._sensors)
        sensed |= {name: newest[name].value for name in sensed if name in newest}
        oldest_s = max((self.cache.age_s(name, now_ns) for name in sensed), default=0.0)
        return RobotView(
            *self.estimator.look_ahead(now_ns),
            sensed=sensed,
            sensed_age_s=oldest_s,
            ranges=ranges,
            stamp_s=newest_ns * S_PER_NS,
            scan_age_s=self.cache.age_s(SCAN, now_ns),
            odom_age_s=self.cache.age_s(ODOM, now_ns),
        )

    def list_facts(self, now_ns: int) -> dict[str, Any]:
        """Returns facts for `info`: the covariance of the pose (3, 3), and each newest datum.

        Of a datum they hold its number, its stamp [ns] and the silence since it arrived [s].
        """
        facts: dict[str, Any] = {"covariance": self.estimator.covariance[:3, :3].copy()}
        for topic, datum in self.cache.newest.items():
            facts[f"{topic}_sequence"] = datum.sequence
            facts[f"{topic}_stamp_ns"] = datum.stamp_ns
            facts[f"{topic}_silence_s"] = (now_ns - datum.arrival_ns) * S_PER_NS
        return facts

    def health(self, arrival_ns: int) -> Health:
        """Returns the health of all topics at a time of the receiver's clock [ns]."""
        cache = self.cache
        innovations = {
            kind.topic: nis for kind, nis in self._timeline.newest_nis.items()
        }
        topics = {
            topic: TopicHealth(
                received=received,
                rate_hz=cache.rate_hz(topic, arrival_ns),
                age_s=cache.silence_s(topic, arrival_ns),
                innovation=innovations.get(topic, math.nan),
            )
            for topic, received in cache.received.items()
        }
        rejected = dict(cache.rejected)
        noticed = dict[str, int]()
        for (kind, outcome), count in self._timeline.outcomes.items():
            # A replay may have reset the count to 0.
            if outcome is Acceptance.USED or not count:
                continue
            verdict = outcome.name.lower()
            if outcome is Acceptance.OUTLIER:
                rejected[Rejection(kind.topic, verdict)] = count
            else:
                noticed[f"{kind.topic}: {verdict}"] = count
        if self._clock_jumps:
            noticed["clock: jump"] = self._clock_jumps
        return Health(topics, rejected, noticed, self._timeline.replayed)


def rehearse(model: SimulatorModel) -> RobotView:
    """Compiles all kernels in two periods at rest, because compiling takes seconds."""
    middleware = Middleware(model)
    period_ns = round(model.control_period * 1e9)
    middleware.reset(0, np.zeros(3))
    still = np.zeros(3)
    free = np.full(model.lidar.beams, np.inf, np.float32)
    for stamp_ns in (period_ns, 2 * period_ns):
        middleware.command(stamp_ns - period_ns, np.zeros(len(model.robot.command)))
        middleware.odometry(stamp_ns, stamp_ns, still, still)
        middleware.scan(stamp_ns, stamp_ns, free)
        middleware.pose(stamp_ns, stamp_ns, still)
    _ = middleware.estimator.twist_covariance
    return middleware.view(2 * period_ns)
