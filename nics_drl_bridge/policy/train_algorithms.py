"""PPO and SAC of Stable-Baselines3, made from settings."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.evaluation_batch import Act
from nics_drl_bridge.policy.train_actor import Actor
from nics_drl_bridge.policy.train_normaliser import Normaliser
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import PpoSettings, SacSettings, TrainingSettings

Array = NDArray[np.float64]
RECENT = 1000
"""Episodes that the success rate of the progress is of."""
LEAST_RATE = 0.02
"""Share of the learning rate of PPO at the end."""


def make_algorithm(
    settings: TrainingSettings, env: TrainVecEnv, seed: int, normaliser: tuple[Array, Array]
) -> BaseAlgorithm:
    """An algorithm that has learned nothing yet.

    Args:
        settings: of the training.
        env: to learn on.
        seed: of the network's weights and all that the algorithm draws.
        normaliser: mean and standard deviation (O,) of the observations.

    Raises:
        ConfigError: the algorithm does not serve the task.
    """
    check_serves(settings, env)
    torch.set_num_threads(settings.threads)
    shared: dict[str, Any] = {"seed": seed, "device": "cpu", "stats_window_size": RECENT}
    network = {
        "net_arch": list(settings.hidden),
        "features_extractor_class": Normaliser,
        "features_extractor_kwargs": {"mean": normaliser[0], "std": normaliser[1]},
    }
    if settings.algorithm == "ppo":
        return _ppo(settings.ppo, env, network, shared)
    return _sac(settings.sac, env, network, shared)


def check_serves(settings: TrainingSettings, env: TrainVecEnv) -> None:
    """Raises ConfigError when the algorithm does not serve the task."""
    if len(env.observation_space.shape) != 1:
        raise ConfigError(
            f"task {settings.task!r}: shows {env.observation_space.shape}, and training "
            "takes vectors only; train a task of one robot."
        )
    if settings.algorithm == "sac" and not isinstance(env.action_space, gymnasium.spaces.Box):
        raise ConfigError("algorithm 'sac' needs continuous actions; use 'ppo'.")
    size = settings.ppo.rollout * env.num_envs
    if settings.algorithm == "ppo" and settings.ppo.batch > size:
        raise ConfigError(
            f"ppo.batch {settings.ppo.batch}: is more than the {size} transitions of a rollout; "
            "lower it, or raise ppo.rollout or worlds."
        )


def _ppo(
    chosen: PpoSettings, env: TrainVecEnv, network: dict[str, Any], shared: dict[str, Any]
) -> PPO:
    return PPO(
        "MlpPolicy",
        env,
        lambda remaining: chosen.learning_rate * max(remaining, LEAST_RATE),
        n_steps=chosen.rollout,
        batch_size=chosen.batch,
        n_epochs=chosen.epochs,
        gamma=chosen.discount,
        gae_lambda=chosen.gae_lambda,
        clip_range=chosen.clip,
        ent_coef=chosen.entropy,
        policy_kwargs={
            **network,
            "log_std_init": chosen.log_std,
            "activation_fn": torch.nn.Tanh,
        },
        **shared,
    )


def _sac(
    chosen: SacSettings, env: TrainVecEnv, network: dict[str, Any], shared: dict[str, Any]
) -> SAC:
    return SAC(
        "MlpPolicy",
        env,
        chosen.learning_rate,
        buffer_size=chosen.buffer,
        learning_starts=chosen.begin_after,
        batch_size=chosen.batch,
        tau=chosen.soft_update,
        gamma=chosen.discount,
        train_freq=1,
        gradient_steps=chosen.updates,
        policy_kwargs=network,
        **shared,
    )


def act_of(algorithm: BaseAlgorithm | Actor) -> Act:
    """What the policy of an algorithm does at its best: without the noise of exploration."""

    def act(observations: NDArray[np.float32]) -> NDArray[Any]:
        seen = torch.as_tensor(observations)
        with torch.no_grad():
            if isinstance(algorithm, Actor):
                return np.asarray(algorithm.best(seen).numpy())
            policy: Any = algorithm.policy
            return np.asarray(policy._predict(seen, deterministic=True).numpy())

    return act
