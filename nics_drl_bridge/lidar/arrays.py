"""Names of arrays by the type of their numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array

__all__ = ["AnyArray", "Array", "Integers", "Mask", "ShortIntegers", "Singles"]

AnyArray = NDArray[Any]
Singles = NDArray[np.float32]
Integers = NDArray[np.int64]
ShortIntegers = NDArray[np.int32]
Mask = NDArray[np.bool_]
