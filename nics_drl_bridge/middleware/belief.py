"""What the filter holds at a time, and what it foresees.

How far a robot may have come while nothing could be used of what it said.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel

Array = NDArray[np.float64]


class Anchor(NamedTuple):
    """The newest odometry, and what the filter held after it.

    Attributes:
        time_ns: of it [ns].
        odom: (3,) its pose in `odom`.
        mean: (3 + S,) see `Belief`.
        covariance: (3 + S, 3 + S).
    """

    time_ns: int
    odom: Array
    mean: Array
    covariance: Array


class Belief(NamedTuple):
    """All that the filter holds at a time; its arrays are never changed in place.

    Attributes:
        time_ns: of the belief [ns].
        mean: (3 + S,) x [m], y [m], heading [rad] in `map`, then the state of the RobotSpec.
        covariance: (3 + S, 3 + S).
        outliers: how many of each kind came in a row.
        anchor: the newest odometry; None before the first.
        lost: whether the robot may have driven unseen since the anchor.
    """

    time_ns: int
    mean: Array
    covariance: Array
    outliers: tuple[int, int, int]
    anchor: Anchor | None
    lost: bool


class Foreseen(NamedTuple):
    """What a prediction comes to: time [ns], mean, covariance, and the twist to measure then.

    And where there was time for it, what such a measurement makes of it, whatever its value: the
    gain (3 + S, 3) and the covariance after it.
    """

    time_ns: int
    mean: Array
    covariance: Array
    expected: tuple[Array, Array]
    update: tuple[Array, Array] | None = None


def parted(covariance: Array) -> Array:
    """A copy of a covariance (3 + S, 3 + S) in which pose and state tell nothing of each other."""
    copied = np.array(covariance)
    copied[:3, 3:], copied[3:, :3] = 0.0, 0.0
    return copied


JITTER_S = 0.2
"""The time that is not accounted for is known this well: data take longer now and then [s]."""
MARGIN = 1.2
"""Odometry that is noisy or slips tells of at most so many times the greatest speed."""
LEVELS, MOST_CORNERS = 3, 4096
"""Of each variable, so many values are tried for the greatest speed, and so many together."""


def greatest_twist(model: SimulatorModel) -> tuple[float, float]:
    """Greatest speed [m/s] and turn rate [rad/s] of a model within the ranges of its RobotSpec."""
    ranges = [(v.min, v.max) for v in (*model.robot.state, *model.robot.command)]
    levels = LEVELS if LEVELS ** len(ranges) <= MOST_CORNERS else 2
    values = [np.linspace(low, high, levels) for low, high in ranges]
    if levels ** len(ranges) > MOST_CORNERS:
        low, high = np.array(ranges).T
        tried = np.random.default_rng(0).uniform(low, high, (MOST_CORNERS, len(ranges)))
    else:
        tried = np.array(list(product(*values)))
    twist = model.kinematics.rates(tried)[:, :3]
    return float(np.hypot(twist[:, 0], twist[:, 1]).max()), float(np.abs(twist[:, 2]).max())


class Unseen:
    """Says how far a robot may have come unseen, and how well its odometry bridges that.

    Args:
        model: of the robot.
        process: (3 + S, 3 + S) what the filter's covariance grows by in a second.
        noise: (3, 3) of the twist that odometry measures.
        news: (3 + S,) variance of a state about which there may be news; 0 for the pose.

    Attributes:
        walk: (3,) variance that a pose by odometry gains in a second [m^2, m^2, rad^2].
    """

    def __init__(self, model: SimulatorModel, process: Array, noise: Array, news: Array) -> None:
        self._news = news
        self._fastest = greatest_twist(model)
        # Odometry adds up its twists, so their noise walks at random, a step each period.
        self.walk = np.diag(process)[:3] + np.diag(noise) * model.control_period

    def reach(self, seconds: float) -> tuple[float, float]:
        """How far [m] and by what angle [rad] it may have come, by its greatest speeds."""
        speed, rate = self._fastest
        longest = max(seconds, 0.0) + JITTER_S
        return speed * longest, min(rate * longest, np.pi)

    def doubted(self, covariance: Array, seconds: float) -> Array:
        """A covariance (3 + S, 3 + S), after a time in which the robot may have driven anywhere.

        Of x, y and heading every place within reach is as likely as another.
        """
        doubted, (far, turned) = parted(covariance), self.reach(seconds)
        variance = np.maximum(self._news, np.diag(doubted))
        variance[:3] = np.diag(doubted)[:3] + np.array([far, far, turned]) ** 2 / 3.0
        np.fill_diagonal(doubted, variance)
        return doubted

    def bridged(self, anchor: Anchor, odom: Array, seconds: float) -> tuple[Array, Array] | None:
        """Pose (3,) and its covariance (3, 3) by what odometry says has been driven unseen.

        Args:
            anchor: before.
            odom: (3,) pose in `odom` now.
            seconds: between the two.

        Returns:
            None where the robot can't have come so far: its odometry began anew, or jumped.
        """
        moved = geometry.between(anchor.odom, odom)
        far, turned = self.reach(seconds)
        if not (np.hypot(*moved[:2]) <= MARGIN * far and abs(moved[2]) <= MARGIN * turned):
            return None
        pose = geometry.compose(anchor.mean[:3], moved)
        along = pose[:2] - anchor.mean[:2]
        lever = np.array([-along[1], along[0]])
        derivative = np.eye(3)
        derivative[:2, 2] = lever
        before = derivative @ anchor.covariance[:3, :3] @ derivative.T
        return pose, before + self._drift(lever, far, max(seconds, 0.0))

    def _drift(self, lever: Array, far: float, seconds: float) -> Array:
        """(3, 3) that a pose by odometry gains in a time, on a way that ends at a `lever` (2,).

        An error of the heading that grows on the way turns the rest of it: on a straight one by a
        third of its variance at the end. A way that was no straight one led aside, at most as
        far as the greatest speed allows; Thrun et al., Probabilistic Robotics, Sec. 5.4.
        """
        position, heading = max(self.walk[:2]) * seconds, self.walk[2] * seconds
        aside = max(far * far - float(lever @ lever), 0.0) / 4.0
        added = np.zeros((3, 3))
        added[:2, :2] = heading / 3.0 * (np.outer(lever, lever) + aside * np.eye(2))
        added[:2, :2] += position * np.eye(2)
        added[:2, 2] = added[2, :2] = heading / 2.0 * lever
        added[2, 2] = heading
        return added
