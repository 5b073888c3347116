"""Seeds and options that a reset can't use, told before anything begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from nics_drl_bridge.errors import ConfigError, nearest

SEEDS = 2**63
"""A seed is below it: it is a signed 64-bit integer over ROS 2 and in the kernels."""
START = "start"
"""The option that any task takes, beside the names of its memory."""


def check_reset(seed: Any, options: Any, worlds: int = 1) -> None:
    """Refuses what can be refused before the task is asked.

    Gymnasium itself refuses a seed that is negative.

    Args:
        seed: of the first world, or one for each; those of the next worlds count on.
        options: as given to `reset`.
        worlds: how many.

    Raises:
        ConfigError: a seed that is no integer or too great, or options that are no dict.
    """
    last = SEEDS - worlds if isinstance(seed, int | np.integer) else SEEDS - 1
    for one in seed if isinstance(seed, list | tuple | np.ndarray) else [seed]:
        if not (one is None or isinstance(one, int | np.integer)):
            raise ConfigError(f"seed of type {type(one).__name__}: must be an integer, or None.")
        if one is not None and one > last:
            raise ConfigError(f"seed {_shown(int(one))}: must be at most 2**63 - {SEEDS - last}.")
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(
            f"reset options of type {type(options).__name__}: must be a dict, as {{'start': "
            "(x, y, heading)}, or None."
        )


def _shown(seed: int) -> str:
    """A number as long as a line can hold it."""
    return str(seed) if seed < SEEDS**2 else f"of {seed.bit_length()} bits"


def check_options(
    options: Mapping[str, Any] | None, memory: Iterable[str], more: tuple[str, ...] = ()
) -> None:
    """Raises ConfigError for a reset option that nothing takes.

    Args:
        options: as given to `reset`.
        memory: names of what the task remembers.
        more: further names that the env takes.
    """
    valid = {START, *memory, *more}
    for name in options or ():
        if name not in valid:
            raise ConfigError(f"unknown reset option {name!r}; {nearest(str(name), valid)}")
