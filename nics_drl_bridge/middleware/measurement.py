"""Measurements of a robot's sensors, the estimator's verdicts on them, and health of the topics."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SCAN, ODOM, CMD_VEL, POSE, IMU = "scan", "odom", "cmd_vel", "pose", "imu"


class Kind(IntEnum):
    """Kind of measurement; of measurements with equal stamps, the lower kind is applied first."""

    TWIST = 0
    YAW_RATE = 1
    POSE = 2

    @property
    def topic(self) -> str:
        """Topic of the measurement."""
        return (ODOM, IMU, POSE)[self]


class Measurement(NamedTuple):
    """One measurement: body twist (3,), yaw rate (1,), or pose (3,) in `map`.

    The noise is the covariance of the value, the model's if it is None. With a twist came the pose
    (3,) in `odom`, which bridges unobserved motion.
    """

    kind: Kind
    value: Array
    noise: Array | None = None
    odom: Array | None = None


class Acceptance(IntEnum):
    """Outcome of a measurement.

    `USED`: within its gate. `NEWS`: beyond it, but plausible for a robot that is stuck or pushed;
    used. `JUMP`: beyond it so many times in a row that it is believed. `OUTLIER`: rejected.
    """

    USED = 0
    NEWS = 1
    JUMP = 2
    OUTLIER = 3


class Judgement(NamedTuple):
    """The estimator's verdict on a measurement, with its squared, normalised innovation."""

    distance: float
    outcome: Acceptance


def checked_covariance(covariance: ArrayLike | None, size: int, least_std: float) -> Array | None:
    """Returns a covariance (size, size) that the filter can use; None if it is unknown (or zeros).

    The standard deviation in any direction is raised to `least_std`. Raises ValueError if it is no
    covariance.
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


@dataclass(frozen=True)
class TopicHealth:
    """Accepted data of one topic, their rate of arrival (0 before the second) and age by arrival.

    The innovation is the distance of the newest `Judgement`; NaN for topics that correct nothing.
    """

    received: int
    rate_hz: float
    age_s: float
    innovation: float = float("nan")


@dataclass(frozen=True)
class Health:
    """Health of all topics of a robot that have data.

    Numbers of data `rejected`, by reasons that begin with the topic; `noticed`, which surprised but
    were used (`odom: news`); and `replayed`, which were late and inserted at their time.
    """

    topics: dict[str, TopicHealth] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    noticed: dict[str, int] = field(default_factory=dict)
    replayed: int = 0
