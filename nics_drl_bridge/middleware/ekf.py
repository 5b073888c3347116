"""The state estimator: filterpy's extended Kalman filter around the fitted model."""

from __future__ import annotations

from collections import deque

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.kinematics.kernels import SERIES, term_arrays
from nics_drl_bridge.middleware import kernels

Array = NDArray[np.float64]

LEAST_POSE_DRIFT = 2e-3
"""No model is trusted to be off by less than this after a second [m or rad / sqrt(s)],"""
LEAST_STATE_DRIFT = 5e-3
"""nor, of a state, by less than this share of its range [1 / sqrt(s)]."""
LEAST_TWIST_STD = 1e-3
"""A twist is never trusted more than this [m/s, rad/s],"""
LEAST_POSE_STD = 1e-3
"""nor is a pose [m, rad]."""
SURPRISE = 16.27
"""A twist whose squared, normalised innovation exceeds this, once in a thousand, is news: the
robot is stuck, slips or is pushed. (99.9 % of chi-squared with three degrees of freedom.)"""
NEWS = 0.5
"""The state is then taken to be off by this share of its range."""
REACHABLE = 2.0
"""No state is believed beyond this many times its range: the model means nothing there."""
START_STD = 1e-3
"""How well the pose is known at a reset [m, rad]."""
COMMANDS_KEPT = 64
LONGEST_GAP_S = 10.0
"""Over a longer silence, as when a clock jumps, the robot is taken to have stood still."""
NANO = 1_000_000_000


class Estimator:
    """Pose and state of one robot, predicted by the fitted model, corrected by measurements.

    The mean is x [m], y [m], heading [rad] in `map`, then the state of the RobotSpec. Time is
    an integer of nanoseconds, so that the same messages give the same numbers to the bit.

    Args:
        model: its kinematics predict, its drift is the Q and its sensors' noise the R of the
            filter, its latency delays the commands.
    """

    def __init__(self, model: SimulatorModel) -> None:
        self._terms = term_arrays(model.kinematics)
        dt, _, delay = model.timing
        self._dt_ns, self._delay_ns = round(dt * NANO), round(dt * delay * NANO)
        size = len(model.robot.state)
        reach = np.array([v.max - v.min for v in model.robot.state])
        least = np.concatenate([np.full(3, LEAST_POSE_DRIFT), LEAST_STATE_DRIFT * reach])
        self._process = np.diag(np.maximum(model.noise.drift(model.robot), least) ** 2)
        self._news = np.concatenate([np.zeros(3), NEWS * reach]) ** 2
        center = np.array([v.max + v.min for v in model.robot.state]) / 2.0
        self._limits = center - REACHABLE / 2.0 * reach, center + REACHABLE / 2.0 * reach
        self._pose_std = np.maximum(model.noise.pose, LEAST_POSE_STD)
        linear, angular = (max(std, LEAST_TWIST_STD) for std in model.noise.odometry)
        self._twist_noise = np.diag([linear, linear, angular]) ** 2
        self._width = len(model.robot.command)
        self._filter = ExtendedKalmanFilter(dim_x=3 + size, dim_z=3)
        self.reset(0, np.zeros(3))

    def reset(self, time_ns: int, pose: ArrayLike) -> None:
        """Begins at a known pose (3,), standing still, with a zero command."""
        self.time_ns = time_ns
        size = self._filter.dim_x
        self._filter.x = np.zeros(size)
        self._filter.x[:3] = pose
        self._filter.P = np.eye(size) * START_STD**2
        self._commands: deque[tuple[int, Array]] = deque(maxlen=COMMANDS_KEPT)
        self._commands.append((np.iinfo(np.int64).min, np.zeros(self._width)))

    @property
    def covariance(self) -> Array:
        """(3 + S, 3 + S) of pose and state."""
        return np.array(self._filter.P)

    def command(self, stamp_ns: int, command: ArrayLike) -> None:
        """Notes a command (C,) sent at a time; it takes effect one latency later."""
        self._commands.append((stamp_ns + self._delay_ns, np.array(command, dtype=np.float64)))

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Pose (3,) and body twist (3,) expected at a time, without moving the estimate.

        Data that arrive later, with earlier stamps, still count in full.
        """
        mean, command = np.array(self._filter.x), self._command_at(time_ns - 1)
        self._carry(mean, np.eye(len(mean)), time_ns)
        return mean[:3], kernels.twist_of(mean, command, self._terms)[0]

    def predict(self, time_ns: int) -> None:
        """Moves the estimate forward to a time; an earlier time changes nothing."""
        if time_ns <= self.time_ns:
            return
        transition = np.eye(self._filter.dim_x)
        self._carry(self._filter.x, transition, time_ns)
        elapsed = (time_ns - self.time_ns) / NANO
        self._filter.P = transition @ self._filter.P @ transition.T + self._process * elapsed
        self.time_ns = time_ns

    def _carry(self, mean: Array, transition: Array, time_ns: int) -> None:
        """Moves a mean from the time of the estimate to a later one, command by command."""
        now = self.time_ns
        if time_ns - now > LONGEST_GAP_S * NANO:
            mean[3:] = 0.0
            return
        for effective in [*(effective for effective, _ in self._commands), time_ns]:
            until = min(effective, time_ns)
            if until > now:
                self._move(mean, transition, self._command_at(now), until - now)
                now = until

    def _move(self, mean: Array, transition: Array, command: Array, duration_ns: int) -> None:
        steps, rest = divmod(duration_ns, self._dt_ns)
        kernels.predict(mean, transition, command, self._dt_ns / NANO, steps, self._terms, SERIES)
        if rest:
            kernels.predict(mean, transition, command, rest / NANO, 1, self._terms, SERIES)

    def _command_at(self, time_ns: int) -> Array:
        """The command (C,) in effect at a time."""
        newest = self._commands[0][1]
        for effective, command in self._commands:
            if effective <= time_ns:
                newest = command
        return newest

    def update_twist(self, twist: ArrayLike) -> None:
        """Corrects by a measured body twist (3,) at the time of the estimate."""
        command = self._command_at(self.time_ns - 1)
        expected, derivative = kernels.twist_of(self._filter.x, command, self._terms)
        measured = np.asarray(twist, dtype=np.float64)
        innovation = measured - expected
        covariance = derivative @ self._filter.P @ derivative.T + self._twist_noise
        if innovation @ np.linalg.solve(covariance, innovation) > SURPRISE:
            variance = np.diag(self._filter.P)
            self._filter.P = self._filter.P + np.diag(np.maximum(self._news - variance, 0.0))
        self._filter.update(
            measured,
            HJacobian=lambda _: derivative,
            Hx=lambda _: expected,
            R=self._twist_noise,
        )
        self._settle()

    def update_pose(self, pose: ArrayLike, std: ArrayLike | None = None) -> None:
        """Corrects by a measured pose (3,).

        Args:
            pose: x [m], y [m], heading [rad] in `map`.
            std: (3,) its standard deviations; those of the model's pose sensor when None.
        """
        std = self._pose_std if std is None else std
        observe = np.eye(3, self._filter.dim_x)
        self._filter.update(
            np.asarray(pose, dtype=np.float64),
            HJacobian=lambda _: observe,
            Hx=lambda mean: mean[:3],
            R=np.diag(np.asarray(std, dtype=np.float64) ** 2),
            residual=_pose_residual,
        )
        self._settle()

    def _settle(self) -> None:
        """Brings the heading into [-pi, pi) and the state to where it can be."""
        self._filter.x[2] = wrap_angle(self._filter.x[2])
        self._filter.x[3:] = np.clip(self._filter.x[3:], *self._limits)


def _pose_residual(measured: Array, expected: Array) -> Array:
    """Difference of two poses (3,), its heading in [-pi, pi)."""
    difference = measured - expected
    difference[2] = wrap_angle(difference[2])
    return difference
