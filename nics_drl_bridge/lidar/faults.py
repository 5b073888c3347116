"""LidarFaults: the faults of a real device's ranges, each off by default."""

from __future__ import annotations

from collections.abc import Callable
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

    They act in this order: skew, geometry, too_close, noise, quantisation, dropout.

    Attributes:
        skew: `none` measures all beams at once; otherwise the device turns in this direction while
            the robot moves, and its newest beam is measured at the time of the scan.
        too_close: report for a return nearer than range_min: `minus_inf` (REP-117), the value
            `range_min`, `no_return`, or a `ghost` anywhere within the limits.
        noise_proportional: standard deviation per metre of range, added to noise_std.
        quantisation: returns are multiples of it [m].
        dropout: probability that a return is lost and reported as no return.
        dropout_far: added to `dropout` in proportion to the square of the range, in full at
            range_max: less light returns from afar.
    """

    skew: Skew = "none"
    too_close: TooClose = "minus_inf"
    noise_proportional: float = Field(default=0.0, ge=0.0, le=10.0)
    quantisation: float = Field(default=0.0, ge=0.0, le=1e4)
    dropout: float = Field(default=0.0, ge=0.0, le=1.0)
    dropout_far: float = Field(default=0.0, ge=0.0, le=1.0)

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
    ranges: ArrayLike,
    limits: tuple[float, float],
    parameters: ArrayLike,
    seed: int,
    counter: int,
) -> NDArray[np.float32]:
    """Returns one exact scan as the device reports it, without skew.

    Args:
        ranges: (B,) REP-117 [m].
        limits: range_min and range_max [m].
        parameters: (P,) faults of the robot, see `LidarFaults.parameters`.
        seed: of the episode.
        counter: of the scan; the next scan takes the next one.

    Returns:
        A new scan (B,).
    """
    out = np.array(ranges, np.float32)
    row = np.asarray(parameters, dtype=np.float64)
    kernels.distort(out, np.asarray(limits, dtype=np.float64), row, seed, counter)
    return out


def slice_poses(
    pose: ArrayLike, twist: ArrayLike, sweep_time: float, slices: int, skew: Skew
) -> Array:
    """Returns the poses of the robot at which G equal groups of beams were measured.

    Args:
        pose: (3,) at the end of the sweep.
        twist: (3,) body twist during the sweep.
        sweep_time: duration from the first beam to the last [s], see `LidarSpec.sweep_time`.
        slices: G.
        skew: direction in which the device turns.

    Returns:
        (G, 3) poses in the order of the beams.
    """
    out = np.empty((slices, 3))
    start, rate = (np.asarray(value, dtype=np.float64) for value in (pose, twist))
    kernels.slice_poses(out, start, rate, sweep_time, SKEW[skew])
    out[:, 2] = wrap_angle(out[:, 2])
    return out


def slice_edges(beams: int, slices: int) -> NDArray[np.int64]:
    """Returns the first beam of each of G slices, and B (G + 1,)."""
    return np.arange(slices + 1, dtype=np.int64) * beams // slices


def scan_skewed(
    render: Callable[[Array], NDArray[np.float32]], poses: Array
) -> NDArray[np.float32]:
    """Returns a scan whose groups of beams are measured from different poses.

    Each pose is rendered in full: a slow reference.

    Args:
        render: returns the scan (B,) from a pose (3,).
        poses: (G, 3) of `slice_poses`.

    Returns:
        The scan (B,), each beam from the pose of its slice.
    """
    scans = [render(pose) for pose in poses]
    edges = slice_edges(len(scans[0]), len(poses))
    return np.concatenate([scans[g][edges[g] : edges[g + 1]] for g in range(len(poses))])
