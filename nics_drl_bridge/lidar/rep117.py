"""Ranges as a device reports them, to and from the package's own, which follow REP-117.

Inside: `inf` is no return, `-inf` too close, NaN an invalid measurement, and everything else
lies within the limits. Devices agree on little of that; `LidarSpec.no_return` names the
convention, and this is the one place that knows it. Limits are compared in float32, as the
message carries them: 0.16 m is a little less there, and still a return.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.lidar.spec import LidarSpec

Ranges = NDArray[np.float32]


def to_device(ranges: ArrayLike, spec: LidarSpec) -> Ranges:
    """Ranges (..., B) of the package as the device puts them on the wire.

    Only no return is rewritten. A device that can't say `-inf` has another
    `LidarFaults.too_close`.
    """
    out = np.array(ranges, dtype=np.float32)
    if spec.no_return != "inf":
        value = {"zero": 0.0, "nan": np.nan, "range_max": spec.range_max}[spec.no_return]
        out[out == np.inf] = value
    return out


def from_device(values: ArrayLike, spec: LidarSpec) -> Ranges:
    """What a device put on the wire (..., B) as ranges of the package.

    A finite value below range_min means that something is too close, unless it is the device's
    word for no return: it must not be taken for free space. Of a device that says NaN for no
    return, invalid measurements can't be told from it.
    """
    out = np.array(values, dtype=np.float32)
    low, high = np.float32(spec.range_min), np.float32(spec.range_max)
    if spec.no_return == "zero":
        out[out == 0.0] = np.inf
    elif spec.no_return == "nan":
        out[np.isnan(out)] = np.inf
    elif spec.no_return == "range_max":
        out[out == high] = np.inf
    out[out > high] = np.inf
    out[out < low] = -np.inf
    return out
