"""The normaliser of observations: a part of the network, so that it can't get lost."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

Array = NDArray[np.float64]
LEAST_STD = 0.05
LIMIT = 5.0
LOOKS = 64


class Normaliser(BaseFeaturesExtractor):
    """First layer of actor and critic: (observation - mean) / std, cut at +-5. It never learns.

    Args:
        space: of the observations, Box (O,).
        mean, std: (O,), see `observed`.
    """

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, space: gymnasium.spaces.Box, mean: Array, std: Array) -> None:
        super().__init__(space, features_dim=int(np.prod(space.shape)))
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("std", torch.as_tensor(std, dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(N, O) normalised."""
        return torch.clamp((observations - self.mean) / self.std, -LIMIT, LIMIT)


def observed(env: VecEnv, rng: np.random.Generator) -> tuple[Array, Array]:
    """Mean and standard deviation (O,) of what worlds show under random actions.

    Each world holds its action for several steps, as otherwise a robot with inertia stays where
    it is. A part that hardly varies gets a deviation of 0.05. The env stands anywhere afterwards.
    """
    seen = [np.array(env.reset())]
    for k in range(LOOKS):
        if k % 8 == 0:
            actions = _random_actions(env, rng)
        seen.append(np.array(env.step(actions)[0]))
    rows = np.concatenate(seen).reshape(-1, seen[0].shape[-1]).astype(np.float64)
    return rows.mean(axis=0), np.maximum(rows.std(axis=0), LEAST_STD)


def _random_actions(env: VecEnv, rng: np.random.Generator) -> NDArray[Any]:
    space = env.action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return np.asarray(rng.integers(space.n, size=env.num_envs))
    return rng.uniform(-1.0, 1.0, (env.num_envs, *space.shape)).astype(np.float32)
