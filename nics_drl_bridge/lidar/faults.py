"""LidarFaults: deviations of a real device's ranges, each off by default."""

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.lidar import fault_kernels as kernels
from nics_drl_bridge.lidar.arrays import Array

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
    "clockwise": kernels.CLOCKWISE,
    "counter_clockwise": kernels.COUNTER_CLOCKWISE,
}


class LidarFaults(Schema):
    """The faults of a device, in addition to the `noise_std` of its LidarSpec.

    They are applied in this order: skew, geometry, too_close, noise, quantisation,
    dropout. With skew, the device turns while the robot moves, and its newest beam is
    measured at the time of the scan; without skew, all beams are measured at once. A
    return nearer than range_min is reported as `-inf` (REP-117), as `range_min`, as no
    return, or as a `ghost` at a random range within the limits. `dropout_far` grows
    with the square of the range up to its full value at range_max.
    """

    # direction in which the device turns while the robot moves; none: all beams at once
    skew: Skew = "none"
    # value reported for a return nearer than range_min
    too_close: TooClose = "minus_inf"
    # added to noise_std, per metre
    noise_proportional: float = Field(default=0.0, ge=0.0, le=10.0)
    # returns are multiples of this [m]
    quantisation: float = Field(default=0.0, ge=0.0, le=1e4)
    # probability that a return is lost
    dropout: float = Field(default=0.0, ge=0.0, le=1.0)
    # added to dropout, in full at range_max
    dropout_far: float = Field(default=0.0, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _check_probability(self) -> "LidarFaults":
        if self.dropout + self.dropout_far > 1.0:
            raise ValueError("dropout and dropout_far must add up to at most 1")
        return self

    def parameters(self, noise_std: float) -> Array:
        """Return the kernels' row (P,), in the order of the columns in `fault_kernels`."""
        return np.array(
            [
                noise_std,
                self.noise_proportional,
                self.dropout,
                self.dropout_far,
                TOO_CLOSE[self.too_close],
                self.quantisation,
                SKEW[self.skew],
            ]
        )
