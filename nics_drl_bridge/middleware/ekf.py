"""The state estimator: filterpy's extended Kalman filter around the fitted model."""

from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import ArrayLike

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.belief import Belief, Unseen, parted
from nics_drl_bridge.middleware.kernels import Anchor, Log, MotionModel, log_of
from nics_drl_bridge.middleware.measurement import (
    Acceptance,
    Judgement,
    Kind,
    Measurement,
)
from nics_drl_bridge.middleware.turning import (
    Turned,
    believable_variance,
    take_rate,
    turn_odometry,
)
from nics_drl_bridge.robot.kernels import SERIES, make_terms, wrap

LEAST_POSE_DRIFT, LEAST_STATE_DRIFT = 1e-2, 2e-2
"""Lower bounds on the model's error after a second, of the pose [m or rad / sqrt(s)], and of the
state as a share of its range [1 / sqrt(s)]."""
LEAST_SLIP = 5e-3  # Lower bound on the motion that wheels miss [m or rad / sqrt(s)]
LEAST_TWIST_STD = LEAST_POSE_STD = START_STD = 1e-3
"""Lower bounds on the standard deviations of a twist [m/s, rad/s] and of a pose [m, rad], and that
of the pose at a reset."""
# Gates on the squared, normalised innovation: 99.9 % of chi-squared with 3 degrees of freedom.
GATE = {Kind.TWIST: 16.27, Kind.POSE: 16.27}
PATIENCE = {
    Kind.TWIST: 3,
    Kind.POSE: 5,
}  # consecutive outliers after which they are believed
# Factors of variances, after each outlier and after each measurement that fits well, and the
# greatest: noise may be more than was told, and nearly all measurements would then be outliers.
ROUGHER = 4.0
SMOOTHER = 0.93
ROUGHEST = 100.0
WELL = 2.37  # less is half of the squared, normalised innovations of three numbers
NEWS = 0.5  # Possible error of the state of a stuck or pushed robot, as a share of its range
STILL = np.zeros(3)
REACHABLE = 2.0  # States and commands are cut at this many times their range
FARTHEST = 1e8  # Innovations beyond this [m, rad, m/s, rad/s] are never believed
ANYWHERE = (
    100.0,
    100.0,
    np.pi,
)  # Std of a pose in a pose sensor's map, by odometry [m, rad]
# of a robot at rest: expected and measured speeds [m/s, rad/s]
STANDS = 0.01
ABOUT_STANDS = 0.05
# Longest gap that is predicted [s]: beyond, the robot may be anywhere
LONGEST_GAP_S = 10.0


class Estimator:
    """Pose and state of one robot, predicted by the fitted model, corrected by measurements.

    The model's drift is Q, its sensors' noise R, its latency delays the commands. Time is in whole
    nanoseconds, for identical bits. Measurements apply now; `Timeline` inserts late ones.
    """

    def __init__(self, model: SimulatorModel) -> None:
        dt, _, delay = model.timing
        steps = round(dt * NS_PER_S), round(LONGEST_GAP_S * NS_PER_S)
        self._motion = MotionModel(make_terms(model.kinematics), SERIES, *steps)
        self._delay_ns = round(dt * delay * NS_PER_S)
        size = len(model.robot.state)
        reach = np.array([v.max - v.min for v in model.robot.state])
        least = np.concatenate(
            [np.full(3, LEAST_POSE_DRIFT), LEAST_STATE_DRIFT * reach]
        )
        self._process = np.diag(np.maximum(model.noise.drift(model.robot), least) ** 2)
        self._news = np.concatenate([np.zeros(3), NEWS * reach]) ** 2
        low, high = (
            np.array([(v.min, v.max) for v in model.robot.state]).reshape(-1, 2).T
        )
        self._limits = _widened(low, high)
        self._least, self._most = _widened(
            model.robot.command_low, model.robot.command_high
        )
        linear, angular = (max(std, LEAST_TWIST_STD) for std in model.noise.odometry)
        self._noise = {
            Kind.TWIST: np.diag([linear, linear, angular]) ** 2,
            Kind.POSE: np.diag(np.maximum(model.noise.pose, LEAST_POSE_STD) ** 2),
        }
        # Measured drift is motion that the model misses, wheels do not; an assumed one may be slip.
        missed = (
            model.noise.drift(model.robot) ** 2
            - model.noise.simulated_drift(model.robot) ** 2
        )
        slip = np.diag(np.maximum(missed[:3], LEAST_SLIP**2))
        walk = self._noise[Kind.TWIST] * model.control_period
        self._wheels = kernels.Wheels(walk, slip, *self._limits)
        self.unseen = Unseen(model, self._process, self._noise[Kind.TWIST], self._news)
        self._observe_pose = np.eye(3, 3 + size)
        self._suddenly = np.eye(3 + size, size, -3)
        self._filter = ExtendedKalmanFilter(3 + size, 3)
        self._anchor: Anchor | None = None
        # Expected twist and its derivative, of the present belief and commands.
        self._expected: tuple[Array, Array] | None = None
        self.reset(0, np.zeros(3))

    def reset(self, time_ns: int, pose: ArrayLike, std: ArrayLike = START_STD) -> None:
        """Begins at a time [ns] and a pose (3,) in `map`, of a deviation [m, rad], at rest."""
        mean = np.zeros(self._filter.dim_x)
        deviation = np.full(self._filter.dim_x, START_STD)
        mean[:3] = pose
        deviation[:3] = std
        spread = np.diag(deviation**2)
        error = self._suddenly
        self.belief = Belief(time_ns, mean, spread, (0, 0, 0), None, False, error)
        self._log = log_of(np.zeros(len(self._least)))

    def anchor(self, odom: Array, twist: Array = STILL) -> None:
        """Records the present pose (3,) in `odom` and body twist (3,)."""
        mean = self._filter.x
        covariance = self._filter.P
        self._anchor = Anchor(
            self.time_ns, odom, twist, mean, covariance, covariance[:, :3].copy()
        )

    def restart(self, time_ns: int, seconds: float, command: Array) -> None:
        """Begins anew at the last pose, at a time [ns] to which the clock was set.

        The robot may be anywhere that it reaches in the seconds since the last odometry. The
        command (C,) is in effect.
        """
        mean = self._filter.x
        covariance = self.unseen.doubted(self._filter.P, seconds)
        gyro = None if self._gyro is None else self._gyro.restarted()
        begun = mean, covariance, (0, 0, 0), None, False, self._suddenly
        self.belief = Belief(time_ns, *begun, self._roughness, self._missed, gyro)
        self._log = log_of(np.minimum(np.maximum(command, self._least), self._most))

    @property
    def belief(self) -> Belief:
        """State of the filter; set to an earlier one when the past has changed."""
        own = self._filter
        known = self.time_ns, own.x, own.P, self._outliers, self._anchor, self._lost
        return Belief(*known, self._error, self._roughness, self._missed, self._gyro)

    @belief.setter
    def belief(self, belief: Belief) -> None:
        self.time_ns, self._filter.x, self._filter.P = belief[:3]
        self._outliers, self._anchor, self._lost, self._error = belief[3:7]
        self._roughness, self._missed, self._gyro = belief[7:]
        self._expected = None

    @property
    def covariance(self) -> Array:
        """(3 + S, 3 + S) of pose and state."""
        return np.array(self._filter.P)

    @property
    def twist_covariance(self) -> Array:
        """(3, 3) of the body twist that follows from pose and state."""
        _, derivative = self._expect(Kind.TWIST)
        spread: Array = derivative @ self._filter.P @ derivative.T
        return spread + LEAST_TWIST_STD**2 * np.eye(3)

    def effective_ns(self, stamp_ns: int) -> int:
        """Time at which a command sent at `stamp_ns` takes effect [ns]."""
        return stamp_ns + self._delay_ns

    def command(
        self, stamp_ns: int, command: ArrayLike, needed_ns: int | None = None
    ) -> bool:
        """Adds a command (C,) sent at a time [ns]; False if there is one of that time.

        The estimate may be set back as far as `needed_ns`, by default not at all.
        """
        needed_ns = self.time_ns if needed_ns is None else needed_ns
        self._expected = None
        # By the longest delay of a command after the common latency.
        needed_ns -= int(self._motion.terms.late.max(initial=0)) * self._motion.step_ns
        given = np.asarray(command, np.float64), self._least, self._most, needed_ns
        log = Log(*kernels.logged(self._log, self.effective_ns(stamp_ns), *given))
        self._log = log if len(log.effective) else self._log
        return log is self._log

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Predicts pose (3,) and body twist (3,) at a time, without moving the estimate."""
        now = self.time_ns
        motion = self._motion
        mean, twist = kernels.look_ahead(
            self._filter.x, now, time_ns, motion, self._log
        )
        return mean[:3], twist

    def predict(self, time_ns: int) -> None:
        """Moves the estimate forward to a time; an earlier time changes nothing."""
        now = self.time_ns
        if time_ns <= now:
            return
        own = self._filter
        motion = self._motion
        log = self._log
        mean, covariance, expected, error, transition = kernels.forecast(
            own.x, own.P, self._process, now, time_ns, motion, log
        )
        if time_ns - now > motion.longest_ns:
            covariance = self.unseen.doubted(covariance, (time_ns - now) / NS_PER_S)
            self._lost = True
        anchor = self._anchor
        if anchor is not None and anchor.cross is not None:
            self._anchor = anchor._replace(cross=transition @ anchor.cross)
        self.time_ns = time_ns
        own.x = mean
        own.P = covariance
        self._error = error
        self._expected = expected

    def update(
        self, kind: Kind, value: ArrayLike, std: ArrayLike | None = None
    ) -> Judgement:
        """Corrects by a measured value (n,), with its standard deviations or the model's."""
        noise = None if std is None else np.diag(np.atleast_1d(std) ** 2.0)
        return self.correct(
            Measurement(kind, np.atleast_1d(value).astype(np.float64), noise)
        )

    def turn(self, time_ns: int, measurement: Measurement) -> Judgement:
        """Takes a yaw rate measured at a time; the next odometry turns by it, see `turning`."""
        variance = None if measurement.noise is None else float(measurement.noise[0, 0])
        rate = float(measurement.value[0])
        fastest = self.unseen.fastest[1]
        self._gyro, distance, used = take_rate(
            self._gyro, time_ns, rate, variance, fastest
        )
        outcome = Acceptance.USED if used else Acceptance.OUTLIER
        self._count(Kind.YAW_RATE, 0 if used else self._outliers[Kind.YAW_RATE] + 1)
        return Judgement(distance, outcome)

    def _turned(self, measurement: Measurement) -> tuple[Measurement, Turned | None]:
        """Returns an odometry that turns by the gyro; the same one where there is none."""
        if self._gyro is None or self._anchor is None or measurement.odom is None:
            return measurement, None
        variance = believable_variance(measurement.turn_variance)
        known = float(self._noise[Kind.TWIST][2, 2]) if variance is None else variance
        turned = turn_odometry(
            self._gyro,
            self._anchor.odom,
            measurement.odom,
            measurement.value,
            self.time_ns,
            known,
            self._rests(measurement.value),
        )
        noise = measurement.noise
        if turned.rate_variance > self._noise[Kind.TWIST][2, 2]:
            noise = np.array(self._noise[Kind.TWIST])
            noise[2, 2] = turned.rate_variance
        return measurement._replace(
            value=turned.twist, odom=turned.odom, noise=noise
        ), turned

    def _rests(self, twist: Array) -> bool:
        """True if the robot is expected to stand, and odometry does not say otherwise."""
        expected, _ = self._expect(Kind.TWIST)
        return bool(
            (np.abs(expected) < STANDS).all() and (np.abs(twist) < ABOUT_STANDS).all()
        )

    def correct(self, measurement: Measurement) -> Judgement:
        """Corrects by a measurement at this time, after bridging unobserved motion."""
        if measurement.kind is Kind.YAW_RATE:
            return self.turn(self.time_ns, measurement)
        measurement, turned = self._turned(measurement)
        kind = measurement.kind
        odom = measurement.odom
        anchor = self._anchor
        lost = self._lost
        if lost and odom is not None:
            self._lost = False
            if anchor is None:
                seconds = 0.0
            else:
                seconds = (self.time_ns - anchor.time_ns) / NS_PER_S
            if (
                anchor
                and (bridged := self.unseen.bridged(anchor, odom, seconds)) is not None
            ):
                self._jump(*bridged)
                self._expected = None
        verdict = self._correct(measurement, odom is not None and not lost)
        if verdict.outcome is Acceptance.OUTLIER and not (lost and odom is not None):
            return verdict  # the next odometry's way then leads past this one
        if turned is not None:
            self._gyro = turned.gyro
            if turned.heading_variance > 0.0:
                spread = np.array(self._filter.P)
                spread[2, 2] += turned.heading_variance
                self._filter.P = spread
        if odom is not None:
            self.anchor(np.array(odom), np.array(measurement.value))
        elif kind is Kind.POSE:
            self._lost = False
        return verdict

    def _correct(self, measurement: Measurement, follows: bool) -> Judgement:
        kind, value, given_noise, odom, _ = measurement
        noise = self._noise_of(kind, given_noise)
        expected, derivative = self._expect(kind)
        residual = _between_poses if kind is Kind.POSE else np.subtract
        innovation = residual(value, expected)
        distance = kernels.distance(innovation, derivative, self._filter.P, noise)
        outcome = Acceptance.USED
        scattered = self._scatters(kind, innovation)
        if not distance <= GATE[kind]:
            outcome = self._surprise(kind, innovation, derivative, noise, scattered)
        if outcome is Acceptance.OUTLIER:
            self._count(kind, self._outliers[kind] + 1)
            return Judgement(distance, outcome)
        anchor = self._anchor
        own = self._filter
        way = None
        if follows and anchor is not None and anchor.cross is not None:
            way = (
                np.array(odom),
                np.array(value),
                self.time_ns,
                self._wheels_now,
                GATE[Kind.POSE],
            )
        if way and outcome is Acceptance.USED and given_noise is None:
            # A twist is but a moment's, the way between two odometries all that wheels did since.
            recall = kernels.recall(anchor, derivative, own.P, noise)
            gain = kernels.gain(own.P, derivative, noise)
            own.x, own.P = kernels.follow(own.x, innovation, gain, recall, anchor, *way)
        else:
            self._recall(innovation, derivative, noise)
            if kind is Kind.POSE and outcome is Acceptance.JUMP:
                self._jump(value, noise)
            else:
                own.update(
                    value,
                    HJacobian=lambda _: derivative,
                    Hx=lambda _: expected,
                    R=noise,
                    residual=residual,
                )
            kernels.settle(own.x, own.P, *self._limits)
            if way:
                since: Any = self._anchor
                done = (
                    np.zeros((own.dim_x, 3)),
                    own.P,
                )  # nothing is left to correct but by the way
                kept = np.zeros((3, 3)), since.covariance, since.cross
                own.x, own.P = kernels.follow(own.x, STILL, done, kept, since, *way)
        if self._outliers[kind] and not (
            outcome is Acceptance.JUMP and kind is Kind.TWIST
        ):
            self._count(kind, 0)
        self._expected = None
        if outcome is Acceptance.USED and not (scattered and distance > WELL):
            self._roughen(kind, SMOOTHER)
        return Judgement(distance, outcome)

    def _noise_of(self, kind: Kind, given: Array | None = None) -> Array:
        """Returns the noise (n, n) of measurements, that told or as much more as was seen."""
        return self._roughness[kind] * (self._noise[kind] if given is None else given)

    @property
    def _wheels_now(self) -> kernels.Wheels:
        wheels = self._wheels
        rough = self._roughness[Kind.TWIST]
        return wheels if rough == 1.0 else wheels._replace(walk=rough * wheels.walk)

    def _scatters(self, kind: Kind, innovation: Array) -> bool:
        """True if a measurement errs in another way than the one before, as noise alone does."""
        before = self._missed[kind]
        size = len(innovation)
        self._missed = self._missed.copy()
        self._missed[kind, :size] = np.clip(innovation, -FARTHEST, FARTHEST)
        return bool(self._missed[kind] @ before < 0.0)

    def _roughen(self, kind: Kind, factor: float) -> None:
        rough = min(max(1.0, factor * self._roughness[kind]), ROUGHEST)
        if rough != self._roughness[kind]:
            self._roughness = _with(self._roughness, kind, rough)

    def _recall(self, innovation: Array, derivative: Array, noise: Array) -> None:
        """Corrects where the newest odometry was, by what is about to correct the present."""
        if (anchor := self._anchor) is not None and anchor.cross is not None:
            spread = self._filter.P
            mean = anchor.mean.copy()
            gain, covariance, cross = kernels.recall(anchor, derivative, spread, noise)
            mean[:3] += innovation @ gain
            self._anchor = anchor._replace(
                mean=mean, covariance=covariance, cross=cross
            )

    def _expect(self, kind: Kind) -> tuple[Array, Array]:
        if kind is Kind.POSE:
            return self._filter.x[:3], self._observe_pose
        if self._expected is not None:
            return self._expected
        now = self.time_ns
        twist, derivative = kernels.expect(self._filter.x, now, self._motion, self._log)
        return twist, derivative

    def _surprise(
        self,
        kind: Kind,
        innovation: Array,
        derivative: Array,
        noise: Array,
        scattered: bool,
    ) -> Acceptance:
        """Decides on a measurement beyond its gate; that of a stuck or pushed robot is news."""
        if not (np.abs(innovation) < FARTHEST).all():
            return Acceptance.OUTLIER
        most = noise * (ROUGHEST / self._roughness[kind])
        far = (
            kernels.distance(innovation, derivative, self._filter.P, most) > GATE[kind]
        )
        noisy = scattered and not far  # neither off in one way, nor a glitch
        believed = self._outliers[kind] + 1 >= PATIENCE[kind] and not noisy
        if kind is Kind.TWIST:
            doubt = np.maximum(self._news - np.diag(self._filter.P), 0.0)
            # What moved the state moved the pose, too, since the prediction began.
            moved = self._error @ np.linalg.inv(self._error[3:])
            doubtful = self._filter.P + (moved * doubt[3:]) @ moved.T
            if kernels.distance(innovation, derivative, doubtful, noise) <= GATE[kind]:
                self._filter.P = doubtful
                return Acceptance.NEWS
            if believed:
                self._filter.P = parted(doubtful)
                self._part()
        if noisy:
            self._roughen(kind, ROUGHER)
        return Acceptance.JUMP if believed else Acceptance.OUTLIER

    def _part(self) -> None:
        if (anchor := self._anchor) is not None:
            self._anchor = anchor._replace(cross=None)

    def _jump(self, pose: Array, noise: Array) -> None:
        self._part()
        self._filter.P = parted(self._filter.P)
        mean = np.array(self._filter.x)
        mean[:3] = pose
        self._filter.P[:3, :3] = noise
        self._filter.x = mean

    def _count(self, kind: Kind, outliers: int) -> None:
        self._outliers = _with(self._outliers, kind, outliers)


def _with(values: tuple[Any, ...], kind: Kind, value: Any) -> tuple[Any, ...]:
    return *values[:kind], value, *values[kind + 1 :]


def _widened(low: Array, high: Array) -> tuple[Array, Array]:
    center = (high + low) / 2.0
    half = REACHABLE * (high - low) / 2.0
    return center - half, center + half


def _between_poses(measured: Array, expected: Array) -> Array:
    difference = measured - expected
    difference[2] = wrap(difference[2])
    return difference
