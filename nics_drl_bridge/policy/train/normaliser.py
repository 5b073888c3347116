"""Normalisation of observations, the first layer of every actor and critic; not trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Mask, Singles
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

LIMIT = 5.0  # of a normalised observation
NEAR = 0.1  # fraction of the range that is mapped to one half, see `bend`
LEAST_STD = 0.05
# minimum deviation as a fraction of the span of an observation, or of its mean if smaller
LEAST_SHARE = 0.25
OBSERVED_STEPS = 32
OBSERVED_WORLDS = 256
# steps for which a random action is held, or a robot with inertia would hardly move
HELD_STEPS = 8


@dataclass(frozen=True)
class Normaliser:
    """Maps observations to (bent - mean) / std, clamped to +-5.

    Only observations from 0 to 1 are bent, see `bend`, because small fractions of a range matter
    most.
    """

    mean: Singles  # (O,)
    std: Singles  # (O,)
    shares: Singles  # (O,) 1 for observations from 0 to 1, else 0

    @classmethod
    def of(cls, space: gymnasium.spaces.Box, mean: Array, std: Array) -> Normaliser:
        """Makes the normaliser of an observation space, see `observe_statistics`."""
        return cls(mean.astype(np.float32), std.astype(np.float32), find_shares(space))

    def __call__(self, observations: Singles) -> Singles:
        """Normalises observations (n, O)."""
        normalised = (bend(observations, self.shares) - self.mean) / self.std
        clamped: Singles = np.clip(normalised, np.float32(-LIMIT), np.float32(LIMIT))
        return clamped


def find_shares(space: gymnasium.spaces.Box) -> Singles:
    """Returns 1 for the observations (O,) of a space that lie between 0 and 1, else 0."""
    shares: Mask = (space.low == 0.0) & (space.high == 1.0)
    return shares.astype(np.float32)


def bend(observations: Any, shares: Any) -> Any:
    """Maps fractions x to (1 + k) x / (k + x), also from 0 to 1; k = `NEAR` maps to about 1/2.

    Observations are (n, O), as an array or a tensor; `shares` (O,) is 1 for those to bend, and 0
    for the others.
    """
    factors, offsets = compute_bend(shares)
    return observations * factors / (observations * shares + offsets)


def compute_bend(shares: Any) -> tuple[Any, Any]:
    """Returns factors a and offsets b (O,): observations bend to a x / (x shares + b)."""
    return 1.0 + NEAR * shares, 1.0 + (NEAR - 1.0) * shares


def observe_statistics(
    worlds: TrainingWorlds, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Returns mean and standard deviation (O,) of bent observations under random actions.

    The deviation is at least 0.05 and at least a quarter of the span or the mean, whichever is
    smaller.
    """
    some = slice(None, None, max(1, worlds.num_envs // OBSERVED_WORLDS))
    seen = [worlds.reset()[some].copy()]
    for k in range(OBSERVED_STEPS):
        if k % HELD_STEPS == 0:
            actions = draw_actions(worlds.action_space, worlds.num_envs, rng)
        seen.append(worlds.step(actions).observations[some].copy())
    rows = np.concatenate(seen).astype(np.float64)
    space = worlds.observation_space
    rows = bend(rows, find_shares(space))
    mean = rows.mean(axis=0)
    # Later observations may vary more than those near the starts.
    span = np.minimum(space.high - space.low, np.abs(mean))
    return mean, np.maximum(rows.std(axis=0), np.maximum(LEAST_STD, LEAST_SHARE * span))


def draw_actions(
    space: gymnasium.Space[Any], count: int, rng: np.random.Generator
) -> AnyArray:
    """Draws random actions (count, C), or indices (count,) of discrete ones."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n, size=count)
    return rng.uniform(-1.0, 1.0, (count, *(space.shape or ()))).astype(np.float32)
