"""What the vector env is asked for, and how what its parts came to is put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env.task import Outcome
from nics_drl_bridge.errors import ConfigError

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Observation = NDArray[np.float32]
MODES = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}


def flat(observations: Observation) -> Observation:
    """(N, M O) what the robots of each world see, one after the other; no copy."""
    return observations.reshape(len(observations), -1)


def over_robots(rewards: Array) -> Array:
    """(N,) sums of rewards (N, M), robot by robot as a single env does."""
    total = rewards[:, 0].copy()
    for m in range(1, rewards.shape[1]):
        total += rewards[:, m]
    return total


def joined(parts: Sequence[Outcome]) -> Outcome:
    """What worlds came to, of parts that follow each other."""
    if len(parts) == 1:
        return parts[0]

    def join(one: Callable[[Outcome], dict[str, Any]]) -> dict[str, Any]:
        return {name: np.concatenate([one(part)[name] for part in parts]) for name in one(parts[0])}

    ended = np.concatenate([part.ended for part in parts])
    return Outcome(join(lambda part: part.terms), ended, join(lambda part: part.info))


def mode_of(mode: str | AutoresetMode) -> AutoresetMode:
    """An autoreset mode by its value. Raises ConfigError for one that there is not."""
    value = mode.value if isinstance(mode, AutoresetMode) else mode
    if value not in MODES:
        raise ConfigError(f"autoreset_mode {value!r}: must be one of {', '.join(MODES)}.")
    return MODES[value]


def chosen_worlds(options: dict[str, Any] | None, count: int) -> Flags:
    """(N,) which worlds a reset is for. Raises ConfigError for a wrong `reset_mask`."""
    if not options or "reset_mask" not in options:
        return np.ones(count, np.bool_)
    mask: ArrayLike = options["reset_mask"]
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != np.bool_ or not chosen.any():
        raise ConfigError(
            f"options['reset_mask'] of shape {chosen.shape}, {chosen.dtype}: must be ({count},) "
            "bool with at least one True."
        )
    return chosen.copy()


def named_seeds(
    seed: int | Sequence[int | None] | None, chosen: Flags, unnamed: Flags, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Flags]:
    """The seeds that a reset gives to worlds.

    Args:
        seed: of the first world, or of each (None keeps what it has), or None for all.
        chosen: (N,) worlds that are reset.
        unnamed: (N,) worlds that never had a seed; they draw one if they are given none.
        rng: to draw by.

    Returns:
        Seeds (N,), and (N,) which worlds begin a series of episodes by them.

    Raises:
        ConfigError: wrong number of seeds, or a negative one.
    """
    count = len(chosen)
    if isinstance(seed, Sequence | np.ndarray):
        if len(seed) != count:
            raise ConfigError(f"{len(seed)} seeds for {count} worlds; give one each.")
        given = chosen & np.array([one is not None for one in seed])
        seeds = np.array([0 if one is None else one for one in seed], np.int64)
    else:
        given = chosen & (seed is not None)
        seeds = (seed or 0) + np.arange(count, dtype=np.int64)
    new = chosen & unnamed & ~given
    if new.any():
        seeds = np.where(new, int(rng.integers(2**31)) + np.arange(count), seeds)
    fresh = given | new
    if (seeds[fresh] < 0).any():
        raise ConfigError("a seed must not be negative.")
    return seeds, fresh
