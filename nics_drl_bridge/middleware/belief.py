"""State of the filter at a time, and bounds on motion that no data showed."""

from itertools import product
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.middleware.kernels import Clone
from nics_drl_bridge.middleware.turning import Gyro

# Uncertainty of the time that was not observed: transmission sometimes takes longer [s]
JITTER_S = 0.2
SPEED_MARGIN = (
    1.2  # factor by which noise or slip may exceed the model's maximum speeds
)
SPEED_LEVELS = 3  # values tried per variable to find the maximum speeds
MAX_COMBINATIONS = 4096


class Belief(NamedTuple):
    """Complete state of the filter at a time; its arrays are never modified in place."""

    time_ns: int
    mean: Array  # (3 + S,) x [m], y [m], heading [rad] in `map`, then the state of the RobotSpec
    covariance: Array
    outliers: tuple[int, ...]  # consecutive ones, by kind
    clone: Clone | None  # None before the first odometry that was used
    lost: bool  # True if the robot may have moved unobserved since
    # (3 + S, S) Jacobian of the last prediction with respect to an error of the state's rates
    rates_jacobian: Array
    noise_scale: tuple[float, ...] = (
        1.0,
        1.0,
        1.0,
    )  # (3,) factors of variances, by kind
    innovations: Array = np.zeros((3, 3))  # (3, 3) the newest innovation, by kind
    gyro: Gyro | None = None  # None before the first yaw rate


def decorrelate_pose(covariance: Array) -> Array:
    """Returns a copy of a covariance (3 + S, 3 + S) with pose and state uncorrelated."""
    copied = np.array(covariance)
    copied[:3, 3:] = 0.0
    copied[3:, :3] = 0.0
    return copied


def find_max_speeds(model: SimulatorModel) -> tuple[float, float]:
    """Returns the maximum speed [m/s] and turn rate [rad/s] within the ranges of a RobotSpec."""
    variables = (*model.robot.state, *model.robot.command)
    low = np.array([variable.min for variable in variables])
    high = np.array([variable.max for variable in variables])
    count = len(variables)
    levels = SPEED_LEVELS
    if levels**count > MAX_COMBINATIONS:
        levels = 2
    if levels**count > MAX_COMBINATIONS:
        x = np.random.default_rng(0).uniform(low, high, (MAX_COMBINATIONS, count))
    else:
        x = np.array(list(product(*np.linspace(low, high, levels).T)))
    states = len(model.robot.state)
    x[:, states:] = model.kinematics.apply_curves(x[:, states:])
    twist = model.kinematics.rates(x)[:, :3]
    speed = np.hypot(twist[:, 0], twist[:, 1]).max()
    return float(speed), float(np.abs(twist[:, 2]).max())


class UnobservedMotion:
    """Bounds the motion of a robot while it sends no data, and bridges that time by odometry.

    The covariance grows by `process` (3 + S, 3 + S) per second; `noise` (3, 3) is that of a
    measured twist, `stuck_variance` (3 + S,) that of the state if the robot may be stuck or pushed.
    """

    def __init__(
        self,
        model: SimulatorModel,
        process: Array,
        noise: Array,
        stuck_variance: Array,
    ) -> None:
        self._stuck_variance = stuck_variance
        self.max_speeds = find_max_speeds(model)  # [m/s], [rad/s]
        # Variance (3,) that a pose by odometry gains in a second [m^2, m^2, rad^2]: it integrates
        # twists, so their noise is a random walk with a step each period.
        self._random_walk = np.diag(process)[:3] + np.diag(noise) * model.control_period

    def bound_motion(self, seconds: float) -> tuple[float, float]:
        """Returns the maximum distance [m] and turn [rad] in a time."""
        speed, rate = self.max_speeds
        longest = max(seconds, 0.0) + JITTER_S
        return speed * longest, min(rate * longest, np.pi)

    def widen(self, covariance: Array, seconds: float) -> Array:
        """Returns a covariance (3 + S, 3 + S) by which the robot may be anywhere within reach."""
        widened = decorrelate_pose(covariance)
        distance, turn = self.bound_motion(seconds)
        variance = np.maximum(self._stuck_variance, np.diag(widened))
        variance[:3] = np.diag(widened)[:3]
        variance[:3] += np.array([distance, distance, turn]) ** 2 / 3.0
        np.fill_diagonal(widened, variance)
        return widened

    def bridge(
        self, clone: Clone, odom: Array, seconds: float
    ) -> tuple[Array, Array] | None:
        """Returns pose (3,) and covariance where odometry has `odom`; None if beyond reach."""
        moved = geometry.between(clone.odometry.pose, odom)
        distance, turn = self.bound_motion(seconds)
        near = np.hypot(*moved[:2]) <= SPEED_MARGIN * distance
        if not (near and abs(moved[2]) <= SPEED_MARGIN * turn):
            return None
        pose = geometry.compose(clone.mean[:3], moved)
        along = pose[:2] - clone.mean[:2]
        lever = np.array([-along[1], along[0]])
        jacobian = np.eye(3)
        jacobian[:2, 2] = lever
        covariance = jacobian @ clone.covariance[:3, :3] @ jacobian.T
        return pose, covariance + self._compute_drift(lever, distance, seconds)

    def _compute_drift(self, lever: Array, distance: float, seconds: float) -> Array:
        """Returns the covariance (3, 3) that a pose by odometry gains on a path with `lever` (2,).

        A heading error that grows along the path rotates the rest of it: on a straight path with a
        third of its variance at the end. A path that was not straight may have led aside, at most
        as far as the maximum `distance` allows; Thrun et al., Probabilistic Robotics, Sec. 5.4.
        """
        seconds = max(seconds, 0.0)
        position = max(self._random_walk[:2]) * seconds
        heading = self._random_walk[2] * seconds
        aside = max(distance * distance - float(lever @ lever), 0.0) / 4.0
        drift = np.zeros((3, 3))
        drift[:2, :2] = heading / 3.0 * (np.outer(lever, lever) + aside * np.eye(2))
        drift[:2, :2] += position * np.eye(2)
        drift[:2, 2] = heading / 2.0 * lever
        drift[2, :2] = drift[:2, 2]
        drift[2, 2] = heading
        return drift
