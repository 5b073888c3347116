"""What digests are made of: projections of many numbers, and names that are kept as they are."""

from __future__ import annotations

from typing import Any

import numpy as np

PROJECTIONS = 3
Found = dict[str, list[float] | list[str]]


def projected(values: Any) -> list[float]:
    """How many numbers, and sums of them over random signs, in which each has its own part."""
    array = np.asarray(values, np.float64).ravel()
    array = np.nan_to_num(array, nan=1e6, posinf=1e7, neginf=-1e7)
    rng = np.random.default_rng(len(array))
    weights = rng.uniform(0.5, 1.5, (PROJECTIONS, len(array)))
    signs = rng.choice([-1.0, 1.0], weights.shape)
    return [float(len(array)), *((weights * signs) @ array).tolist()]


def joined(arrays: list[Any]) -> list[float]:
    """Projections of all numbers of some arrays, one array after the other."""
    return projected(np.concatenate([np.ravel(array) for array in arrays]))
