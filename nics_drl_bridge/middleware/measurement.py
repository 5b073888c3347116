"""What a sensor says about a robot, and what the estimator makes of it.

How well a robot is heard: what the diagnostics tell.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.robot.kernels import wrap

Array = NDArray[np.float64]

SCAN, ODOM, CMD_VEL, POSE, IMU = "scan", "odom", "cmd_vel", "pose", "imu"


class Kind(IntEnum):
    """What is measured; of measurements with the same stamp, the lower kind counts first."""

    TWIST = 0
    YAW_RATE = 1
    POSE = 2

    @property
    def topic(self) -> str:
        """Where it comes from."""
        return (ODOM, IMU, POSE)[self]


class Measurement(NamedTuple):
    """One measurement.

    Attributes:
        kind: what is measured.
        value: (3,) body twist vx, vy [m/s], wz [rad/s]; (1,) yaw rate [rad/s]; or (3,) pose
            x, y [m], heading [rad] in `map`.
        noise: covariance of the value, (3, 3) or (1, 1); the model's when None.
        odom: (3,) pose in `odom` that came with a twist; it bridges what was not seen.
    """

    kind: Kind
    value: Array
    noise: Array | None = None
    odom: Array | None = None


class Outcome(IntEnum):
    """What became of a measurement.

    `USED`: within its gate. `NEWS`: beyond it, but what a robot that is stuck or pushed would
    do; used. `JUMP`: beyond it so often in a row that it is believed. `OUTLIER`: refused.
    """

    USED = 0
    NEWS = 1
    JUMP = 2
    OUTLIER = 3


class Verdict(NamedTuple):
    """What the estimator makes of a measurement.

    Attributes:
        distance: squared, normalised innovation; about the size of the value when all is well.
        outcome: whether it was used.
    """

    distance: float
    outcome: Outcome


def checked_covariance(covariance: ArrayLike | None, size: int, least_std: float) -> Array | None:
    """A covariance (size, size) that may enter the filter.

    Args:
        covariance: as the sensor gave it. All zeros means unknown, as in the messages of ROS.
        size: of what is measured.
        least_std: nothing is trusted more than this.

    Returns:
        None when it is unknown.

    Raises:
        ValueError: it is no covariance.
    """
    if covariance is None:
        return None
    given = np.array(covariance, dtype=np.float64)
    if given.shape != (size, size) or not np.isfinite(given).all():
        raise ValueError("covariance: NaN or inf")
    if not given.any():
        return None
    if not np.allclose(given, given.T, rtol=1e-6, atol=1e-12):
        raise ValueError("covariance: not symmetric")
    given = 0.5 * (given + given.T)
    least = float(np.linalg.eigvalsh(given)[0])
    if least <= 0.0:
        raise ValueError("covariance: not positive definite")
    return given + max(least_std**2 - least, 0.0) * np.eye(size)


def pose_residual(measured: Array, expected: Array) -> Array:
    """Difference of two poses (3,), its heading in [-pi, pi)."""
    difference = measured - expected
    difference[2] = wrap(difference[2])
    return difference


@dataclass(frozen=True)
class TopicHealth:
    """One topic.

    Attributes:
        received: how many data were taken.
        rate_hz: how many come in a second [1/s]; 0 before the second.
        age_s: how long ago the newest came [s], on the clock of the receiver.
        innovation: squared, normalised innovation of the newest measurement, about its number of
            components when all is well; NaN for what corrects nothing.
    """

    received: int
    rate_hz: float
    age_s: float
    innovation: float = float("nan")


@dataclass(frozen=True)
class Health:
    """All topics of a robot.

    Attributes:
        topics: topic -> its health; those that nothing came from are missing.
        rejected: reason -> how many; a reason begins with the topic.
        noticed: what was used although it was surprising (`odom: news`), and how often.
        replayed: how many data came late and were put in their place.
    """

    topics: dict[str, TopicHealth] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    noticed: dict[str, int] = field(default_factory=dict)
    replayed: int = 0
