"""What the engines share: the layers of their networks, and checks of the settings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.evaluation import Act
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

Array = NDArray[np.float64]
RECENT = 1000  # number of episodes over which the progress reports its rates
LEAST_RATE = 0.02  # share of PPO's learning rate that is left at the end
LEAST_STD, LIMIT = 0.05, 5.0
OBSERVED_STEPS = 64
GAIN = 2.0**0.5
ACTION_GAIN = 0.01  # initial gain of an actor's last layer: all its actions are near zero


def check_serves(settings: TrainingSettings, env: TrainVecEnv) -> None:
    """Raises ConfigError if the algorithm does not suit the task."""
    if len(env.observation_space.shape) != 1:
        shown = f"task {settings.task!r}: shows {env.observation_space.shape}"
        raise ConfigError(f"{shown}, not vectors; train a task of one robot.")
    if settings.algorithm == "sac" and not isinstance(env.action_space, gymnasium.spaces.Box):
        raise ConfigError("algorithm 'sac' needs continuous actions; use 'ppo'.")
    size = settings.ppo.rollout * env.num_envs
    if settings.algorithm == "ppo" and settings.ppo.batch > size:
        batch = f"ppo.batch {settings.ppo.batch}: is more than the {size} transitions of a rollout"
        raise ConfigError(f"{batch}; lower it, or raise ppo.rollout or worlds.")


def act_of(algorithm: BaseAlgorithm | Actor) -> Act:
    """Returns the deterministic policy of an algorithm, without exploration noise."""

    def act(observations: NDArray[np.float32]) -> NDArray[Any]:
        seen = torch.as_tensor(observations)
        with torch.no_grad():
            if isinstance(algorithm, Actor):
                return np.asarray(algorithm.best(seen).numpy())
            policy: Any = algorithm.policy
            return np.asarray(policy._predict(seen, deterministic=True).numpy())

    return act


class Normaliser(BaseFeaturesExtractor):
    """First layer of actor and critic: (observation - mean) / std (O,), cut at +-5; not trained."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, space: gymnasium.spaces.Box, mean: Array, std: Array) -> None:
        super().__init__(space, features_dim=int(np.prod(space.shape)))
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("std", torch.as_tensor(std, dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalises observations (N, O)."""
        return torch.clamp((observations - self.mean) / self.std, -LIMIT, LIMIT)


def observed(env: VecEnv, rng: np.random.Generator) -> tuple[Array, Array]:
    """Mean and standard deviation (O,), at least 0.05, of observations under random actions."""
    seen = [np.array(env.reset())]
    for k in range(OBSERVED_STEPS):
        if k % 8 == 0:  # else a robot with inertia would stay in place
            space: Any = env.action_space
            if isinstance(space, gymnasium.spaces.Discrete):
                actions: NDArray[Any] = rng.integers(space.n, size=env.num_envs)
            else:
                actions = rng.uniform(-1.0, 1.0, (env.num_envs, *space.shape)).astype(np.float32)
        seen.append(np.array(env.step(actions)[0]))
    rows = np.concatenate(seen).reshape(-1, seen[0].shape[-1]).astype(np.float64)
    return rows.mean(axis=0), np.maximum(rows.std(axis=0), LEAST_STD)


class Actor(torch.nn.Module):
    """Maps observations (n, O) to raw actions (n, C), or to logits (n, A) of discrete ones."""

    def __init__(
        self, observations: gymnasium.spaces.Box,
        actions: gymnasium.spaces.Box | gymnasium.spaces.Discrete, hidden: Sequence[int],
        normaliser: tuple[Array, Array], activation: type[torch.nn.Module] = torch.nn.Tanh,
    ) -> None:  # fmt: skip
        super().__init__()
        self.discrete, size = isinstance(actions, gymnasium.spaces.Discrete), actions.shape or ()
        count = int(actions.n if isinstance(actions, gymnasium.spaces.Discrete) else np.prod(size))
        self.normaliser = Normaliser(observations, *normaliser)
        widths = [self.normaliser.features_dim, *hidden, count]
        self.layers = layers_of(widths, ACTION_GAIN, activation)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Parameters of the distribution of actions: its mode if continuous, else logits."""
        raw: torch.Tensor = self.layers(self.normaliser(observations))
        return raw

    def best(self, observations: torch.Tensor) -> torch.Tensor:
        """The most likely actions (n, C), or (n,) discrete."""
        raw = self(observations)
        return raw.argmax(dim=1) if self.discrete else raw


def layers_of(
    widths: Sequence[int], gain: float, activation: type[torch.nn.Module] = torch.nn.Tanh
) -> torch.nn.Sequential:
    """Linear layers, initialised as in Stable-Baselines3, the last by gain."""
    layers: list[torch.nn.Module] = []
    for ins, outs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(ins, outs), activation()]
    del layers[-1]
    for layer in layers[::2]:
        torch.nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else GAIN)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(*layers)
