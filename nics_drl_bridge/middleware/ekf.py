"""The state estimator: an extended Kalman filter around the fitted model.

filterpy keeps mean and covariance and computes the usual update; the kernels do the rest.

How it works:

1. **Prediction.** The mean (pose in `map`, state of the RobotSpec) follows the model under the
   logged commands; the covariance follows its Jacobians and grows by the model's drift.
2. **Absolute measurements.** A pose corrects by the usual update, which filterpy computes. A yaw
   rate corrects nothing by itself: the next odometry's turn is fused with it, see `turning`.
3. **Odometry** is two measurements. The twist is a snapshot and corrects by the usual update. The
   pose relative to the previous odometry integrates the wheels' motion in between: it
   measures the difference between the current state and an earlier one. The filter
   therefore keeps a `Clone` of the state at the newest odometry used, and its
   covariance with the present state (stochastic cloning; Roumeliotis and Burdick 2002).
   Predictions and other measurements keep the clone up to date; the next relative pose
   corrects the current state, and a new clone is made. `kernels.correct_by_odometry`
   computes both updates at once.
4. **Gates.** A measurement whose normalised innovation squared (NIS) is too large is an outlier,
   unless it is plausible for a robot that is stuck or pushed (news), or follows so many outliers
   that it is accepted (a jump).
5. **Late measurements** are not handled here: `timeline` resets the filter to the `Belief` before
   them, and replays everything since.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.middleware import kernels
from nics_drl_bridge.middleware.belief import (
    Belief,
    UnobservedMotion,
    decorrelate_pose,
)
from nics_drl_bridge.middleware.kernels import (
    Clone,
    MotionModel,
    Odometry,
    OdometryModel,
    insert_command,
    make_log,
)
from nics_drl_bridge.middleware.measurement import (
    Acceptance,
    Judgement,
    Kind,
    Measurement,
)
from nics_drl_bridge.middleware.turning import (
    FusedOdometry,
    check_variance,
    fuse_odometry,
    take_rate,
)
from nics_drl_bridge.robot.kernels import SERIES, make_terms, wrap

# Lower bounds on the model's error after a second: pose [m or rad / sqrt(s)], and state as a
# fraction of its range [1 / sqrt(s)]
MIN_POSE_DRIFT = 1e-2
MIN_STATE_DRIFT = 2e-2
MIN_SLIP = 5e-3  # lower bound on the motion that wheels miss [m or rad / sqrt(s)]
# Lower bounds on the standard deviations of a twist [m/s, rad/s] and of a pose [m, rad]
MIN_TWIST_STD = 1e-3
MIN_POSE_STD = 1e-3
START_STD = 1e-3  # standard deviation of the pose at a reset [m, rad]
# Standard deviations of the pose before the first one of a pose sensor [m, m, rad]
ANYWHERE = (100.0, 100.0, np.pi)
GATE = 16.27  # 99.9 % of chi-squared with 3 degrees of freedom
MEDIAN_NIS = 2.37  # median of chi-squared with 3 degrees of freedom
# Number of consecutive outliers after which they are believed
PATIENCE = {Kind.TWIST: 3, Kind.POSE: 5}
# If noise exceeds its stated level, nearly all measurements become outliers. The
# variance is therefore scaled up after noisy outliers, and down again after
# measurements that fit.
NOISE_GROWTH = 4.0
NOISE_DECAY = 0.93
MAX_NOISE_SCALE = 100.0
# Possible error of the state of a stuck or pushed robot, as a fraction of its range
STUCK_DEVIATION = 0.5
RANGE_FACTOR = 2.0  # states and commands are clipped to this multiple of their range
MAX_INNOVATION = 1e8  # larger innovations are never accepted [m, rad, m/s, rad/s]
# A robot counts as at rest below these speeds [m/s, rad/s], by the model and by odometry.
REST_EXPECTED = 0.01
REST_MEASURED = 0.05
# Longest gap that is predicted [s]; after a longer one, the robot may be anywhere within reach
LONGEST_GAP_S = 10.0
T = TypeVar("T")


class Estimator:
    """Pose and state of one robot, predicted by the fitted model and corrected by measurements.

    The model's drift is Q, its sensor noise is R, and its latency delays the commands. Time is in
    integer nanoseconds, so that results are bit-identical. Measurements apply at the
    current time; `Timeline` inserts late ones.
    """

    def __init__(self, model: SimulatorModel) -> None:
        dt, _, delay = model.timing
        self._motion = MotionModel(
            make_terms(model.kinematics),
            SERIES,
            round(dt * NS_PER_S),
            round(LONGEST_GAP_S * NS_PER_S),
        )
        self._delay_ns = round(dt * delay * NS_PER_S)
        size = len(model.robot.state)
        low = np.array([v.min for v in model.robot.state])
        high = np.array([v.max for v in model.robot.state])
        self._state_limits = _widen_range(low, high)
        self._command_limits = _widen_range(
            model.robot.command_low, model.robot.command_high
        )
        drift = model.noise.drift(model.robot)
        min_drift = np.concatenate(
            [np.full(3, MIN_POSE_DRIFT), MIN_STATE_DRIFT * (high - low)]
        )
        self._process = np.diag(np.maximum(drift, min_drift) ** 2)
        self._stuck_variance = (
            np.concatenate([np.zeros(3), STUCK_DEVIATION * (high - low)]) ** 2
        )
        linear, angular = np.maximum(model.noise.odometry, MIN_TWIST_STD)
        self._noise = {
            Kind.TWIST: np.diag([linear, linear, angular]) ** 2,
            Kind.POSE: np.diag(np.maximum(model.noise.pose, MIN_POSE_STD) ** 2),
        }
        # Measured drift is motion that the model misses but the wheels see. Assumed drift may be
        # slip.
        assumed = drift**2 - model.noise.simulated_drift(model.robot) ** 2
        self._odometry_model = OdometryModel(
            random_walk=self._noise[Kind.TWIST] * model.control_period,
            slip=np.diag(np.maximum(assumed[:3], MIN_SLIP**2)),
            gate=GATE,
            state_low=self._state_limits[0],
            state_high=self._state_limits[1],
        )
        self.unobserved = UnobservedMotion(
            model, self._process, self._noise[Kind.TWIST], self._stuck_variance
        )
        self._pose_jacobian = np.eye(3, 3 + size)
        # Rates Jacobian of a zero-length prediction: errors moved the state, but not yet the pose.
        self._start_jacobian = np.eye(3 + size, size, -3)
        # Imported here, as filterpy loads scipy.stats: a second that an env without it saves.
        from filterpy.kalman import ExtendedKalmanFilter

        self._filter = ExtendedKalmanFilter(3 + size, 3)
        self._clone: Clone | None = None
        # Predicted twist and its Jacobian; None once belief or commands have changed
        self._twist: tuple[Array, Array] | None = None
        self.reset(0, np.zeros(3))

    def reset(self, time_ns: int, pose: ArrayLike, std: ArrayLike = START_STD) -> None:
        """Starts at a time [ns], at rest at a pose (3,) in `map` with deviations `std` [m, rad]."""
        mean = np.zeros(self._filter.dim_x)
        deviation = np.full(self._filter.dim_x, START_STD)
        mean[:3] = pose
        deviation[:3] = std
        self.belief = Belief(
            time_ns,
            mean,
            np.diag(deviation**2),
            outliers=(0, 0, 0),
            clone=None,
            lost=False,
            rate_error_jacobian=self._start_jacobian,
        )
        self._log = make_log(np.zeros(len(self._command_limits[0])))

    def restart(self, time_ns: int, seconds: float, command: Array) -> None:
        """Restarts at the last pose after the clock was set to a time [ns].

        The robot may be anywhere it can reach in the seconds since the last odometry. The command
        (C,) is in effect.
        """
        gyro = self._gyro
        if gyro is not None:
            gyro = gyro.restart()
        self.belief = self.belief._replace(
            time_ns=time_ns,
            covariance=self.unobserved.widen(self._filter.P, seconds),
            outliers=(0, 0, 0),
            clone=None,
            lost=False,
            rate_error_jacobian=self._start_jacobian,
            gyro=gyro,
        )
        self._log = make_log(self._clip_command(command))

    @property
    def belief(self) -> Belief:
        """State of the filter. `Timeline` sets it back when the past has changed."""
        return Belief(
            self.time_ns,
            self._filter.x,
            self._filter.P,
            self._outliers,
            self._clone,
            self._lost,
            self._rate_error_jacobian,
            self._noise_scale,
            self._innovations,
            self._gyro,
        )

    @belief.setter
    def belief(self, belief: Belief) -> None:
        self.time_ns = belief.time_ns
        self._filter.x = belief.mean
        self._filter.P = belief.covariance
        self._outliers = belief.outliers
        self._clone = belief.clone
        self._lost = belief.lost
        self._rate_error_jacobian = belief.rate_error_jacobian
        self._noise_scale = belief.noise_scale
        self._innovations = belief.innovations
        self._gyro = belief.gyro
        self._twist = None

    @property
    def covariance(self) -> Array:
        """Covariance (3 + S, 3 + S) of pose and state."""
        return np.array(self._filter.P)

    @property
    def twist_covariance(self) -> Array:
        """Covariance (3, 3) of the body twist that follows from pose and state."""
        _, jacobian = self._predict_measurement(Kind.TWIST)
        covariance: Array = jacobian @ self._filter.P @ jacobian.T
        return covariance + MIN_TWIST_STD**2 * np.eye(3)

    def clone_state(self, odom: Array, twist: Array) -> None:
        """Clones the current state for an odometry with pose (3,) and body twist (3,)."""
        covariance = self._filter.P
        odometry = Odometry(self.time_ns, odom, twist)
        cross = covariance[:, :3].copy()
        self._clone = Clone(odometry, self._filter.x, covariance, cross)

    def compute_effect_time(self, stamp_ns: int) -> int:
        """Returns the time at which a command sent at `stamp_ns` takes effect [ns]."""
        return stamp_ns + self._delay_ns

    def add_command(
        self, stamp_ns: int, command: ArrayLike, needed_ns: int | None = None
    ) -> bool:
        """Adds a command (C,) sent at a time [ns]; returns False if that time already has one.

        Keeps the commands in effect from `needed_ns` on, by default from the current
        estimate on.
        """
        if needed_ns is None:
            needed_ns = self.time_ns
        self._twist = None
        # Individual delays of commands come on top of the common latency.
        needed_ns -= (
            int(self._motion.terms.extra_delays.max(initial=0)) * self._motion.step_ns
        )
        log = insert_command(
            self._log,
            self.compute_effect_time(stamp_ns),
            self._clip_command(command),
            needed_ns,
        )
        if log is None:
            return False
        self._log = log
        return True

    def _clip_command(self, command: ArrayLike) -> Array:
        low, high = self._command_limits
        return np.minimum(np.maximum(np.asarray(command, np.float64), low), high)

    def look_ahead(self, time_ns: int) -> tuple[Array, Array]:
        """Predicts pose (3,) and body twist (3,) at a time, without moving the estimate."""
        mean, (twist, _) = self._look_ahead(time_ns)
        return mean[:3], twist

    def _look_ahead(self, time_ns: int) -> tuple[Array, tuple[Array, Array]]:
        ahead: tuple[Array, tuple[Array, Array]] = kernels.look_ahead(
            self._filter.x, self.time_ns, time_ns, self._motion, self._log
        )
        return ahead

    def predict(self, time_ns: int) -> None:
        """Moves the estimate forward to a time; an earlier time changes nothing."""
        passed_ns = time_ns - self.time_ns
        if passed_ns <= 0:
            return
        mean, covariance, twist, transition = kernels.predict_estimate(
            self._filter.x,
            self._filter.P,
            self._process,
            self.time_ns,
            time_ns,
            self._motion,
            self._log,
        )
        if passed_ns > self._motion.longest_ns:
            covariance = self.unobserved.widen(covariance, passed_ns / NS_PER_S)
            self._lost = True
        if self._clone is not None:
            cross = transition[:, : len(mean)] @ self._clone.cross
            self._clone = self._clone._replace(cross=cross)
        self.time_ns = time_ns
        self._filter.x = mean
        self._filter.P = covariance
        self._rate_error_jacobian = transition[:, len(mean) :]
        self._twist = twist

    def take_yaw_rate(self, time_ns: int, measurement: Measurement) -> Judgement:
        """Takes a yaw rate measured at a time [ns]; the next odometry fuses it, see `turning`."""
        variance = None
        if measurement.noise is not None:
            variance = float(measurement.noise[0, 0])
        rate = float(measurement.value[0])
        max_rate = self.unobserved.max_speeds[1]
        self._gyro, nis, used = take_rate(self._gyro, time_ns, rate, variance, max_rate)
        if used:
            self._count_outliers(Kind.YAW_RATE, 0)
            return Judgement(nis, Acceptance.USED)
        self._count_outliers(Kind.YAW_RATE, self._outliers[Kind.YAW_RATE] + 1)
        return Judgement(nis, Acceptance.OUTLIER)

    def correct(self, measurement: Measurement) -> Judgement:
        """Corrects by a measurement at the current time, after bridging unobserved motion."""
        if measurement.kind is Kind.YAW_RATE:
            return self.take_yaw_rate(self.time_ns, measurement)
        fused = self._fuse_gyro(measurement)
        if fused is not None:
            measurement = self._replace_turn(measurement, fused)
        bridged = self._end_gap(measurement)
        judgement = self._correct(measurement, not bridged)
        if judgement.outcome is Acceptance.OUTLIER and not bridged:
            # The clone is kept, so the next odometry's relative pose spans this one as well.
            return judgement
        if fused is not None:
            self._gyro = fused.gyro
            if fused.heading_variance > 0.0:
                covariance = np.array(self._filter.P)
                covariance[2, 2] += fused.heading_variance
                self._filter.P = covariance
        if measurement.odom is not None:
            self.clone_state(np.array(measurement.odom), np.array(measurement.value))
        elif measurement.kind is Kind.POSE:
            self._lost = False
        return judgement

    def _fuse_gyro(self, measurement: Measurement) -> FusedOdometry | None:
        """Fuses an odometry's turn with the gyro's; returns None if that is not possible."""
        if self._gyro is None or self._clone is None or measurement.odom is None:
            return None
        variance = check_variance(measurement.turn_variance)
        if variance is None:
            variance = float(self._noise[Kind.TWIST][2, 2])
        return fuse_odometry(
            self._gyro,
            self._clone.odometry.pose,
            measurement.odom,
            measurement.value,
            self.time_ns,
            variance,
            self._is_at_rest(measurement.value),
        )

    def _replace_turn(
        self, measurement: Measurement, fused: FusedOdometry
    ) -> Measurement:
        """Returns an odometry with the fused turn, and with the gyro's noise if that is larger."""
        noise = measurement.noise
        if fused.rate_variance > self._noise[Kind.TWIST][2, 2]:
            noise = np.array(self._noise[Kind.TWIST])
            noise[2, 2] = fused.rate_variance
        return measurement._replace(value=fused.twist, odom=fused.odom, noise=noise)

    def _is_at_rest(self, twist: Array) -> bool:
        """Returns True if model and odometry agree that the robot is at rest."""
        expected, _ = self._predict_measurement(Kind.TWIST)
        return bool(
            (np.abs(expected) < REST_EXPECTED).all()
            and (np.abs(twist) < REST_MEASURED).all()
        )

    def _end_gap(self, measurement: Measurement) -> bool:
        """Ends a time without data, bridged by odometry if that can be trusted.

        Returns False if there was no such time.
        """
        if not self._lost or measurement.odom is None:
            return False
        self._lost = False
        if self._clone is not None:
            seconds = (self.time_ns - self._clone.odometry.time_ns) / NS_PER_S
            bridge = self.unobserved.bridge(self._clone, measurement.odom, seconds)
            if bridge is not None:
                self._set_pose(*bridge)
                self._twist = None
        return True

    def _correct(self, measurement: Measurement, is_continuous: bool) -> Judgement:
        """Judges a measurement, and corrects by it unless it is an outlier.

        Odometry's relative pose is used only if it `is_continuous`: no gap was just bridged.
        """
        kind = measurement.kind
        noise = self._scale_noise(kind, measurement.noise)
        expected, jacobian = self._predict_measurement(kind)
        innovation = measurement.value - expected
        if kind is Kind.POSE:
            innovation[2] = wrap(innovation[2])
        nis = kernels.compute_nis(innovation, jacobian, self._filter.P, noise)
        alternates = self._record_innovation(kind, innovation)
        outcome = Acceptance.USED
        if not nis <= GATE:
            outcome = self._prepare_for_outlier(
                kind, innovation, jacobian, noise, alternates
            )
        if outcome is Acceptance.OUTLIER:
            self._count_outliers(kind, self._outliers[kind] + 1)
            return Judgement(nis, outcome)
        has_relative_pose = (
            is_continuous
            and measurement.odom is not None
            and self._clone is not None
            and self._clone.correlated
        )
        is_plain = outcome is Acceptance.USED and measurement.noise is None
        if has_relative_pose and is_plain:
            self._correct_by_odometry(measurement, innovation, jacobian, noise)
        else:
            self._correct_alone(measurement, outcome, innovation, jacobian, noise)
            if has_relative_pose:
                # The twist has been used; a zero Jacobian leaves only the relative pose to correct.
                # Reusing this kernel avoids compiling another one while the robot moves.
                zeros = np.zeros_like(jacobian)
                self._correct_by_odometry(measurement, np.zeros(3), zeros, noise)
        if outcome is not Acceptance.JUMP or kind is not Kind.TWIST:
            self._count_outliers(kind, 0)
        self._twist = None
        if outcome is Acceptance.USED and not (alternates and nis > MEDIAN_NIS):
            self._change_noise(kind, NOISE_DECAY)
        return Judgement(nis, outcome)

    def _correct_by_odometry(
        self, measurement: Measurement, innovation: Array, jacobian: Array, noise: Array
    ) -> None:
        odometry = Odometry(
            self.time_ns, np.array(measurement.odom), np.array(measurement.value)
        )
        model = self._odometry_model
        scale = self._noise_scale[Kind.TWIST]
        if scale != 1.0:
            model = model._replace(random_walk=scale * model.random_walk)
        self._filter.x, self._filter.P = kernels.correct_by_odometry(
            self._filter.x,
            self._filter.P,
            innovation,
            jacobian,
            noise,
            self._clone,
            odometry,
            model,
        )

    def _correct_alone(
        self,
        measurement: Measurement,
        outcome: Acceptance,
        innovation: Array,
        jacobian: Array,
        noise: Array,
    ) -> None:
        """Corrects clone and current state by a pose, or by a twist only."""
        if self._clone is not None and self._clone.correlated:
            self._clone = kernels.correct_clone(
                self._clone, innovation, jacobian, self._filter.P, noise
            )
        if measurement.kind is Kind.POSE and outcome is Acceptance.JUMP:
            self._set_pose(measurement.value, noise)
        else:
            # The innovation is known, so filterpy gets an expected measurement of zero.
            self._filter.update(
                innovation, lambda _: jacobian, lambda _: np.zeros(3), R=noise
            )
        kernels.repair_estimate(self._filter.x, self._filter.P, *self._state_limits)

    def _prepare_for_outlier(
        self,
        kind: Kind,
        innovation: Array,
        jacobian: Array,
        noise: Array,
        alternates: bool,
    ) -> Acceptance:
        """Judges a measurement beyond its gate, and prepares the filter if it will be used.

        Returns NEWS for a twist that a stuck or pushed robot explains, JUMP after too many
        consecutive outliers, else OUTLIER.
        """
        if not (np.abs(innovation) < MAX_INNOVATION).all():
            return Acceptance.OUTLIER
        covariance = self._filter.P
        max_noise = noise * (MAX_NOISE_SCALE / self._noise_scale[kind])
        nis = kernels.compute_nis(innovation, jacobian, covariance, max_noise)
        # Innovations that alternate in direction are noise, up to the maximum scale of the noise.
        is_noise = alternates and not nis > GATE
        is_believed = self._outliers[kind] + 1 >= PATIENCE[kind] and not is_noise
        if kind is Kind.TWIST:
            doubt = np.maximum(self._stuck_variance - np.diag(covariance), 0.0)
            # Whatever changed the state since the prediction began also moved the pose.
            moved = self._rate_error_jacobian @ np.linalg.inv(
                self._rate_error_jacobian[3:]
            )
            doubted = covariance + (moved * doubt[3:]) @ moved.T
            if kernels.compute_nis(innovation, jacobian, doubted, noise) <= GATE:
                self._filter.P = doubted
                return Acceptance.NEWS
            if is_believed:
                self._filter.P = decorrelate_pose(doubted)
                self._end_correlation()
        if is_noise:
            self._change_noise(kind, NOISE_GROWTH)
        return Acceptance.JUMP if is_believed else Acceptance.OUTLIER

    def _predict_measurement(self, kind: Kind) -> tuple[Array, Array]:
        """Returns the expected value (3,) of a measurement and its Jacobian (3, 3 + S)."""
        if kind is Kind.POSE:
            return self._filter.x[:3], self._pose_jacobian
        if self._twist is not None:
            return self._twist
        return self._look_ahead(self.time_ns)[1]

    def _record_innovation(self, kind: Kind, innovation: Array) -> bool:
        """Records an innovation; returns True if it opposes the last one, which suggests noise."""
        before = self._innovations[kind]
        self._innovations = self._innovations.copy()
        self._innovations[kind] = np.clip(innovation, -MAX_INNOVATION, MAX_INNOVATION)
        return bool(self._innovations[kind] @ before < 0.0)

    def _scale_noise(self, kind: Kind, noise: Array | None) -> Array:
        """Returns the scaled noise (n, n) of a measurement, by default the model's."""
        if noise is None:
            noise = self._noise[kind]
        return self._noise_scale[kind] * noise

    def _change_noise(self, kind: Kind, factor: float) -> None:
        scale = min(max(1.0, factor * self._noise_scale[kind]), MAX_NOISE_SCALE)
        self._noise_scale = _replace_item(self._noise_scale, kind, scale)

    def _count_outliers(self, kind: Kind, count: int) -> None:
        self._outliers = _replace_item(self._outliers, kind, count)

    def _end_correlation(self) -> None:
        if self._clone is not None:
            self._clone = self._clone._replace(correlated=False)

    def _set_pose(self, pose: Array, covariance: Array) -> None:
        """Sets the pose (3,) with a covariance (3, 3), and keeps the state."""
        self._end_correlation()
        mean = np.array(self._filter.x)
        mean[:3] = pose
        self._filter.x = mean
        self._filter.P = decorrelate_pose(self._filter.P)
        self._filter.P[:3, :3] = covariance


def _replace_item(values: tuple[T, ...], index: int, value: T) -> tuple[T, ...]:
    return *values[:index], value, *values[index + 1 :]


def _widen_range(low: Array, high: Array) -> tuple[Array, Array]:
    center = (high + low) / 2.0
    half = RANGE_FACTOR * (high - low) / 2.0
    return center - half, center + half
