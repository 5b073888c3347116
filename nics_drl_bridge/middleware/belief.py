"""The filter's state at a time, and bounds on unobserved motion."""

from itertools import product
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.middleware.kernels import Clone
from nics_drl_bridge.middleware.turning import Gyro

# Margin on the length of an unobserved time, because transmission delays vary [s]
JITTER_S = 0.2
# Factor by which noise or slip may exceed the model's maximum speeds
SPEED_MARGIN = 1.2
SPEED_LEVELS = 3  # values tried per variable to find the maximum speeds
MAX_COMBINATIONS = 4096


class Belief(NamedTuple):
    """Complete state of the filter at a time; its arrays are not modified once it is made."""

    time_ns: int
    mean: Array  # (3 + S,) x [m], y [m], heading [rad] in `map`, then the state of the RobotSpec
    covariance: Array
    outliers: tuple[int, ...]  # number of consecutive outliers, by kind
    clone: Clone | None  # None before the first odometry that was used
    lost: bool  # True after a gap too long to predict, until an odometry or a pose
    # (3 + S, S) Jacobian of the last prediction with respect to an error in the state's rates
    rate_error_jacobian: Array
    # (3,) factors on the noise variances, by kind
    noise_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    innovations: Array = np.zeros((3, 3))  # (3, 3) newest innovation of each kind
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
    levels = SPEED_LEVELS
    if levels ** len(variables) > MAX_COMBINATIONS:
        levels = 2  # only the ends
    x = np.array(list(product(*np.linspace(low, high, levels).T)))
    states = len(model.robot.state)
    x[:, states:] = model.kinematics.apply_curves(x[:, states:])
    twist = model.kinematics.rates(x)[:, :3]
    speed = np.hypot(twist[:, 0], twist[:, 1]).max()
    return float(speed), float(np.abs(twist[:, 2]).max())


class UnobservedMotion:
    """Bounds the motion of a robot while it sends no data, and bridges that time with odometry.

    The covariance grows by `process` (3 + S, 3 + S) per second. A measured twist has covariance
    `noise` (3, 3). The state of a robot that may be stuck or pushed has variance `stuck_variance`
    (3 + S,).
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
        # Variance (3,) that an odometry pose gains per second [m^2, m^2, rad^2]. It integrates
        # twists, so their noise is a random walk with one step per period.
        self._random_walk = np.diag(process)[:3] + np.diag(noise) * model.control_period

    def bound_motion(self, seconds: float) -> tuple[float, float]:
        """Returns the maximum distance [m] and turn [rad] within a number of seconds."""
        speed, rate = self.max_speeds
        longest = max(seconds, 0.0) + JITTER_S
        return speed * longest, min(rate * longest, np.pi)

    def widen(self, covariance: Array, seconds: float) -> Array:
        """Returns a covariance (3 + S, 3 + S) that covers everywhere the robot may have gone."""
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
        """Returns pose (3,) and covariance (3, 3) at odometry pose `odom`; None if out of reach."""
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
        """Returns the covariance (3, 3) that an odometry pose gains on a path.

        `lever` (2,) is the path's displacement [m], rotated by 90 degrees. A heading error that
        grows along the path rotates the rest of the path. On a straight path, a third of the final
        heading variance acts on the position. Other paths may deviate sideways, at most as far as
        the maximum `distance` [m] allows. See Thrun et al., Probabilistic Robotics, Sec. 5.4.
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
