"""Measurements by a robot's sensors, their outcomes in the estimator, and health of the topics."""

import math
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
    """Kind of measurement. At equal stamps, the lower kind is applied first."""

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
    noise: Array | None = None  # covariance of the value, by default the model's
    odom: Array | None = None  # (3,) odometry pose that came with the twist
    # Variance of the twist's yaw rate as reported, by default the model's
    turn_variance: float | None = None


class Acceptance(IntEnum):
    """What the estimator did with a measurement."""

    USED = 0  # used, within its gate
    NEWS = 1  # used, beyond its gate, but plausible for a robot that is stuck or pushed
    JUMP = (
        2  # used, because too many consecutive ones were beyond the gate to be outliers
    )
    OUTLIER = 3  # rejected


class Judgement(NamedTuple):
    """The estimator's verdict on a measurement."""

    nis: float  # normalised innovation squared
    outcome: Acceptance


def check_covariance(
    covariance: ArrayLike | None, size: int, min_std: float
) -> Array | None:
    """Returns a covariance (size, size) with a deviation of at least `min_std` in any direction.

    Returns None if it is unknown (None or all zeros). Raises ValueError if it is not a covariance.
    """
    if covariance is None:
        return None
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise ValueError("covariance: NaN or inf")
    if not matrix.any():
        return None
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12):
        raise ValueError("covariance: not symmetric")
    matrix = 0.5 * (matrix + matrix.T)
    min_variance = float(np.linalg.eigvalsh(matrix)[0])
    if min_variance <= 0.0:
        raise ValueError("covariance: not positive definite")
    return matrix + max(min_std**2 - min_variance, 0.0) * np.eye(size)


@dataclass(frozen=True)
class TopicHealth:
    """Statistics of a topic's accepted data."""

    received: int
    rate_hz: float  # rate of arrivals; 0 before the second
    age_s: float  # since the latest arrival
    innovation: float = math.nan  # NIS of the newest `Judgement`; NaN without one


class Rejection(NamedTuple):
    """Reason why data of a topic are not used."""

    topic: str
    reason: str

    def __str__(self) -> str:
        return f"{self.topic}: {self.reason}"


@dataclass(frozen=True)
class Health:
    """Health of all topics of a robot that have data."""

    topics: dict[str, TopicHealth] = field(default_factory=dict)
    rejected: dict[Rejection, int] = field(default_factory=dict)  # counts
    # used, but unusual (`odom: news`)
    noticed: dict[str, int] = field(default_factory=dict)
    replayed: int = 0  # number of late data, inserted at their stamps

    def describe(self) -> dict[str, str]:
        """Returns readable keys and values."""
        values = {}
        for topic, data in self.topics.items():
            values[f"{topic} received"] = str(data.received)
            values[f"{topic} rate [Hz]"] = f"{data.rate_hz:.3g}"
            values[f"{topic} age [s]"] = f"{data.age_s:.3f}"
            if not math.isnan(data.innovation):
                values[f"{topic} innovation"] = f"{data.innovation:.3g}"
        for rejection, count in self.rejected.items():
            values[f"rejected, {rejection}"] = str(count)
        for event, count in self.noticed.items():
            values[f"noticed, {event}"] = str(count)
        values["late and put in place"] = str(self.replayed)
        return values
