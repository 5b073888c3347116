"""State of the filter at a time, and bounds on motion that none of a robot's data showed."""

from itertools import product
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.middleware.kernels import Anchor
from nics_drl_bridge.middleware.turning import Gyro

JITTER_S = 0.2  # Uncertainty of the unobserved time: transmission takes longer now and then [s]
MARGIN = 1.2  # Factor by which odometry, through noise or slip, may exceed the greatest speed
LEVELS = 3  # values tried per variable for the greatest speed
MOST_CORNERS = 4096  # combinations


class Belief(NamedTuple):
    """Complete state of the filter at a time; its arrays are never modified in place."""

    time_ns: int
    mean: Array  # (3 + S,) x [m], y [m], heading [rad] in `map`, then the state of the RobotSpec
    covariance: Array
    outliers: tuple[int, ...]  # consecutive ones, by kind
    anchor: Anchor | None  # None before the first odometry that was used
    lost: bool  # True if the robot may have moved unobserved since
    error: Array  # (3 + S, S) derivative to a constant error of the state's rates since before
    roughness: tuple[float, ...] = (1.0, 1.0, 1.0)  # (3,) factors of variances, by kind
    missed: Array = np.zeros((3, 3))  # (3, 3) the newest innovation, by kind
    gyro: Gyro | None = None  # None before the first yaw rate


def parted(covariance: Array) -> Array:
    """Returns a copy of a covariance (3 + S, 3 + S) with pose and state uncorrelated."""
    copied = np.array(covariance)
    copied[:3, 3:] = 0.0
    copied[3:, :3] = 0.0
    return copied


def greatest_twist(model: SimulatorModel) -> tuple[float, float]:
    """Greatest speed [m/s] and turn rate [rad/s] of a model within the ranges of its RobotSpec."""
    ranges = [(v.min, v.max) for v in (*model.robot.state, *model.robot.command)]
    levels = LEVELS if LEVELS ** len(ranges) <= MOST_CORNERS else 2
    if levels ** len(ranges) > MOST_CORNERS:
        low, high = np.array(ranges).T
        tried = np.random.default_rng(0).uniform(low, high, (MOST_CORNERS, len(ranges)))
    else:
        tried = np.array(
            list(product(*(np.linspace(*each, levels) for each in ranges)))
        )
    states = len(model.robot.state)
    tried[:, states:] = model.kinematics.apply_curves(tried[:, states:])
    twist = model.kinematics.rates(tried)[:, :3]
    return float(np.hypot(twist[:, 0], twist[:, 1]).max()), float(
        np.abs(twist[:, 2]).max()
    )


class Unseen:
    """Bounds the unobserved motion of a robot, and bridges it by odometry.

    The covariance grows by `process` (3 + S, 3 + S) per second; `noise` (3, 3) is the measured
    twist's, `news` (3 + S,) the variance of the state after possible news, see `Acceptance`.
    """

    def __init__(
        self, model: SimulatorModel, process: Array, noise: Array, news: Array
    ) -> None:
        self._news = news
        self.fastest = greatest_twist(model)  # [m/s], [rad/s]
        # Variance (3,) that a pose by odometry gains in a second [m^2, m^2, rad^2]: it integrates
        # its twists, so their noise is a random walk with a step each period.
        self.walk = np.diag(process)[:3] + np.diag(noise) * model.control_period

    def reach(self, seconds: float) -> tuple[float, float]:
        """Greatest distance [m] and turn [rad] in a time, by the greatest speeds."""
        speed, rate = self.fastest
        longest = max(seconds, 0.0) + JITTER_S
        return speed * longest, min(rate * longest, np.pi)

    def doubted(self, covariance: Array, seconds: float) -> Array:
        """Covariance (3 + S, 3 + S) if the robot may now be anywhere within reach."""
        doubted, (far, turned) = parted(covariance), self.reach(seconds)
        variance = np.maximum(self._news, np.diag(doubted))
        variance[:3] = np.diag(doubted)[:3] + np.array([far, far, turned]) ** 2 / 3.0
        np.fill_diagonal(doubted, variance)
        return doubted

    def bridged(
        self, anchor: Anchor, odom: Array, seconds: float
    ) -> tuple[Array, Array] | None:
        """Returns pose and covariance where odometry has `odom`; None if beyond reach."""
        moved = geometry.between(anchor.odom, odom)
        far, turned = self.reach(seconds)
        if not (
            np.hypot(*moved[:2]) <= MARGIN * far and abs(moved[2]) <= MARGIN * turned
        ):
            return None
        pose = geometry.compose(anchor.mean[:3], moved)
        along = pose[:2] - anchor.mean[:2]
        lever = np.array([-along[1], along[0]])
        derivative = np.eye(3)
        derivative[:2, 2] = lever
        before = derivative @ anchor.covariance[:3, :3] @ derivative.T
        return pose, before + self._drift(lever, far, max(seconds, 0.0))

    def _drift(self, lever: Array, far: float, seconds: float) -> Array:
        """Covariance (3, 3) that a pose by odometry gains in a time, on a path with `lever` (2,).

        A heading error that grows along the path rotates the rest of it: on a straight path with a
        third of its variance at the end. A path that was not straight may have led aside, at most
        as far as the greatest speed allows; Thrun et al., Probabilistic Robotics, Sec. 5.4.
        """
        position = max(self.walk[:2]) * seconds
        heading = self.walk[2] * seconds
        aside = max(far * far - float(lever @ lever), 0.0) / 4.0
        added = np.zeros((3, 3))
        added[:2, :2] = heading / 3.0 * (np.outer(lever, lever) + aside * np.eye(2))
        added[:2, :2] += position * np.eye(2)
        added[:2, 2] = added[2, :2] = heading / 2.0 * lever
        added[2, 2] = heading
        return added
