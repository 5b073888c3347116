"""Names of arrays by the type of their numbers, and structures of several numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array as Array

AnyArray = NDArray[Any]
Singles = NDArray[np.float32]
Integers = NDArray[np.int64]
ShortIntegers = NDArray[np.int32]
Mask = NDArray[np.bool_]


def structure_of(record: type) -> np.dtype[Any]:
    """Return the structure for the kernels that has the fields of a class."""
    fields = [
        (name, np.int64 if kind is int else kind)
        for name, kind in record.__annotations__.items()
    ]
    return np.dtype(fields, align=True)
