"""What the filter holds at a time, and what it foresees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
