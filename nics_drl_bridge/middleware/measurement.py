"""Measurements of a robot's sensors, the estimator's verdicts on them, and health of the topics."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge.geometry import Array

SCAN = "scan"
ODOM = "odom"
CMD_VEL = "cmd_vel"
POSE = "pose"
IMU = "imu"


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
    """One measurement: body twist (3,), yaw rate (1,), or pose (3,) in `map`."""

    kind: Kind
    value: Array
    noise: Array | None = None  # covariance of the value; None for the model's
    # (3,) pose that came with a twist: how far the robot came
    odom: Array | None = None
    # of a twist's yaw rate, as told; None for the model's
    turn_variance: float | None = None


class Acceptance(IntEnum):
    """Outcome of a measurement."""

    USED = 0  # within its gate
    NEWS = 1  # beyond it, but plausible for a robot that is stuck or pushed; used
    JUMP = 2  # beyond it so many times in a row that it is believed
    OUTLIER = 3  # rejected


class Judgement(NamedTuple):
    """The estimator's verdict on a measurement, with its squared, normalised innovation."""

    distance: float
    outcome: Acceptance


def check_covariance(
    covariance: ArrayLike | None, size: int, least_std: float
) -> Array | None:
    """Returns a covariance that the filter can use, of at least `least_std` in any direction.

    None if it is unknown (or zeros). Raises ValueError if it is no covariance (size, size).
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
    """Accepted data of a topic, their rate of arrival (0 before the second) and age by arrival."""

    received: int
    rate_hz: float
    age_s: float
    innovation: float = float(
        "nan"
    )  # distance of the newest `Judgement`; NaN if none corrects


@dataclass(frozen=True)
class Health:
    """Health of all topics of a robot that have data."""

    topics: dict[str, TopicHealth] = field(default_factory=dict)
    rejected: dict[str, int] = field(
        default_factory=dict
    )  # by reasons that begin with the topic
    noticed: dict[str, int] = field(
        default_factory=dict
    )  # surprised but used (`odom: news`)
    replayed: int = 0  # late ones, inserted at their time
