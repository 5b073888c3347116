"""LidarFaults: the faults of a real device's ranges, each off by default."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.lidar import fault_kernels as kernels

Array = NDArray[np.float64]
TooClose = Literal["minus_inf", "range_min", "no_return", "ghost"]
Skew = Literal["none", "counter_clockwise", "clockwise"]

TOO_CLOSE: dict[TooClose, int] = {
    "minus_inf": kernels.AS_MINUS_INF,
    "range_min": kernels.AS_RANGE_MIN,
    "no_return": kernels.AS_NO_RETURN,
    "ghost": kernels.AS_GHOST,
}
SKEW: dict[Skew, int] = {
    "none": kernels.AT_ONCE,
    "counter_clockwise": kernels.COUNTER_CLOCKWISE,
    "clockwise": kernels.CLOCKWISE,
}


class LidarFaults(Schema):
    """The faults of a device, in addition to the `noise_std` of its LidarSpec.

    They act in this order: skew, geometry, too_close, noise, quantisation, dropout. With a skew the
    device turns in this direction while the robot moves, and its newest beam is measured at the
    time of the scan; without, all beams are measured at once. A return nearer than range_min is
    reported as `-inf` (REP-117), as `range_min`, as no return, or as a `ghost` anywhere within the
    limits. Less light returns from afar: `dropout_far` acts with the square of the range, in full
    at range_max.
    """

    skew: Skew = "none"
    too_close: TooClose = "minus_inf"
    noise_proportional: float = Field(default=0.0, ge=0.0, le=10.0)  # added to noise_std, per metre
    quantisation: float = Field(default=0.0, ge=0.0, le=1e4)  # returns are multiples of it [m]
    dropout: float = Field(default=0.0, ge=0.0, le=1.0)  # probability that a return is lost
    dropout_far: float = Field(default=0.0, ge=0.0, le=1.0)  # added to it

    @model_validator(mode="after")
    def _probable(self) -> LidarFaults:
        if self.dropout + self.dropout_far > 1.0:
            raise ValueError("dropout and dropout_far must add up to at most 1")
        return self

    def parameters(self, noise_std: float) -> Array:
        """Returns the kernels' row (P,), see `fault_kernels`."""
        row = np.zeros(kernels.PARAMETERS)
        row[kernels.NOISE_STD] = noise_std
        row[kernels.NOISE_PROPORTIONAL] = self.noise_proportional
        row[kernels.DROPOUT] = self.dropout
        row[kernels.DROPOUT_FAR] = self.dropout_far
        row[kernels.TOO_CLOSE] = TOO_CLOSE[self.too_close]
        row[kernels.QUANTISATION] = self.quantisation
        row[kernels.SKEW] = SKEW[self.skew]
        return row


def distort(
    ranges: ArrayLike, limits: tuple[float, float], parameters: ArrayLike, seed: int, counter: int
) -> NDArray[np.float32]:
    """Returns one exact scan (B,) as the device reports it, without skew.

    The limits are range_min and range_max [m], the parameters (P,) those of
    `LidarFaults.parameters`. The seed is the episode's; each scan takes the next counter.
    """
    out = np.array(ranges, np.float32)
    row = np.asarray(parameters, dtype=np.float64)
    kernels.distort(out, np.asarray(limits, dtype=np.float64), row, seed, counter)
    return out


def slice_poses(
    pose: ArrayLike, twist: ArrayLike, sweep_time: float, slices: int, skew: Skew
) -> Array:
    """Returns the poses (G, 3) of the robot at which G equal groups of beams were measured.

    The robot has a body twist (3,) during the sweep, which takes `LidarSpec.sweep_time` [s] and
    ends at `pose`.
    """
    out = np.empty((slices, 3))
    start, rate = (np.asarray(value, dtype=np.float64) for value in (pose, twist))
    kernels.slice_poses(out, start, rate, sweep_time, SKEW[skew])
    out[:, 2] = wrap_angle(out[:, 2])
    return out
