"""Checks of seeds: non-negative integers that fit into signed 64 bits."""

import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError

GREATEST_SEED = 2**63 - 1
_SHORT = reprlib.Repr()
_SHORT.maxlong = _SHORT.maxstring = _SHORT.maxother = 40


def check_seeds(
    seeds: ArrayLike | Any, maximum: int = GREATEST_SEED
) -> NDArray[np.int64]:
    """Returns seeds (n,). Raises ConfigError if one is negative, too large or not an integer."""
    if (
        isinstance(seeds, np.ndarray)
        and seeds.dtype == np.int64
        and maximum == GREATEST_SEED
    ):
        numbers = np.atleast_1d(seeds)
        if not (numbers < 0).any():
            return numbers
    values = np.atleast_1d(np.asarray(seeds, dtype=object)).ravel()
    for seed in values:
        is_integer = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
        if not (is_integer and 0 <= seed <= maximum):
            is_short = not isinstance(seed, int) or seed.bit_length() < 1000
            quoted = _SHORT.repr(seed) if is_short else "of very many digits"
            raise ConfigError(
                f"seed {quoted}: must be a whole number from 0 to {maximum}."
            )
    return np.asarray([int(seed) for seed in values], dtype=np.int64)
