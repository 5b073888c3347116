"""Training a policy with Stable-Baselines3 on the vector env: begun, kept, taken up again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError, shortened
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.policy.evaluation_batch import FIRST_SEED, Outcomes, drive_worlds
from nics_drl_bridge.policy.train_actor import Actor
from nics_drl_bridge.policy.train_algorithms import act_of, make_algorithm
from nics_drl_bridge.policy.train_checkpoint import read_checkpoint, resume, save_checkpoint
from nics_drl_bridge.policy.train_normaliser import observed
from nics_drl_bridge.policy.train_progress import Companion, Progress
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings
from nics_drl_bridge.sim.world import World

CHECKPOINT = "checkpoint.pt"
SEEDS = 2**40
Tell = Callable[[Progress], None]
LOG_EVERY = {"ppo": 1, "sac": 1000}
"""Rollouts, or episodes, between two entries of TensorBoard."""


@dataclass(frozen=True)
class Trained:
    """A training that has ended.

    Attributes:
        algorithm: with its policy; on Ray only the part that acts.
        steps: environment steps of all.
        wall_s: time that this process spent on it [s].
        stepping_s: of which in the simulator [s].
    """

    algorithm: BaseAlgorithm | Actor
    steps: int
    wall_s: float
    stepping_s: float


def train(
    settings: TrainingSettings,
    seed: int,
    folder: Path,
    tell: Tell = lambda _: None,
    resumed: bool = False,
) -> Trained:
    """Trains one policy.

    Interrupted and taken up again, it comes to the same weights, to the bit, as without a break:
    a checkpoint holds the network, the optimiser, all random generators and all worlds.

    Args:
        settings: what to learn.
        seed: of all that is drawn.
        folder: for checkpoint and TensorBoard's logs; made when missing.
        tell: is told of the progress, some times a second.
        resumed: whether to go on from the checkpoint in `folder`.

    Raises:
        ConfigError: settings that do not fit together, or no checkpoint that fits them.
    """
    begin, path = time.perf_counter(), folder / CHECKPOINT
    content = read_checkpoint(path) if resumed else None
    about: dict[str, Any] = {"seed": seed, "settings": settings.model_dump(mode="json")}
    env = make_train_env(settings)
    algorithm = _begin(settings, env, seed) if content is None else _again(
        content, about, settings, env, path
    )  # fmt: skip
    algorithm.set_logger(configure(str(folder), ["tensorboard"]))
    busy = env.stepping_s

    def save() -> None:
        save_checkpoint(path, algorithm, env, about)

    companion = Companion(env, seed, settings.steps, settings.checkpoint_every, save, tell)
    left = settings.steps - algorithm.num_timesteps
    if left > 0:
        every = LOG_EVERY[settings.algorithm]
        algorithm.learn(left, companion, log_interval=every, reset_num_timesteps=False)
        save()
    algorithm.logger.close()
    taken = time.perf_counter() - begin
    return Trained(algorithm, algorithm.num_timesteps, taken, env.stepping_s - busy)


def make_train_env(
    settings: TrainingSettings,
    model: SimulatorModel | None = None,
    scenes: Mapping[str, World] | None = None,
) -> TrainVecEnv:
    """The worlds that settings name, side by side.

    Args:
        settings: of the training.
        model: of the robot, where it is open already.
        scenes: name -> world, where they are loaded already.
    """
    model = model or open_model(settings.robot)
    return TrainVecEnv(
        *(
            BridgeVectorEnv(
                count, model, (scenes or {}).get(world, world), settings.task,
                settings.task_options,
                settings.max_episode_steps, "SameStep", randomisation=settings.randomisation,
            )
            for world, count in settings.worlds.items()
        )
    )  # fmt: skip


def _begin(settings: TrainingSettings, env: TrainVecEnv, seed: int) -> BaseAlgorithm:
    rng = np.random.default_rng(seed)
    env.seed(int(rng.integers(SEEDS)))
    algorithm = make_algorithm(settings, env, seed, observed(env, rng))
    env.seed(int(rng.integers(SEEDS)))  # the algorithm gave its own seed, whose next are near
    return algorithm


def _again(
    content: dict[str, Any],
    about: dict[str, Any],
    settings: TrainingSettings,
    env: TrainVecEnv,
    path: Path,
) -> BaseAlgorithm:
    """The algorithm of a checkpoint. Raises ConfigError when it is of another training."""
    check_same(content["about"], about, path)
    size = int(np.prod(env.observation_space.shape))
    algorithm = make_algorithm(settings, env, about["seed"], (np.zeros(size), np.ones(size)))
    try:
        resume(content, algorithm, env)
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = shortened(str(error), 120)
        raise ConfigError(
            f"{path}: does not hold what a training needs ({reason}); train anew."
        ) from None
    return algorithm


def check_same(old: dict[str, Any], new: dict[str, Any], path: Path) -> None:
    """Raises ConfigError unless a checkpoint is of the settings and seed of a training.

    Args:
        old: seed and settings that the checkpoint is of.
        new: those of the training.
        path: of the checkpoint.
    """
    if not isinstance(old, dict) or not isinstance(old.get("settings"), dict) or "seed" not in old:
        raise ConfigError(f"{path}: does not say of which training it is; train anew.")
    for key, value in new["settings"].items():
        if old["settings"].get(key) != value:
            raise ConfigError(
                f"{path}: was trained with {key} {old['settings'].get(key)!r}, not {value!r}; "
                "resume it with the same settings, or train anew in another folder."
            )
    if old["seed"] != new["seed"]:
        raise ConfigError(f"{path}: is of seed {old['seed']}, not {new['seed']}; name that one.")


def evaluate(
    algorithm: BaseAlgorithm | Actor,
    settings: TrainingSettings,
    world: str,
    episodes: int,
    model: SimulatorModel | None = None,
) -> Outcomes:
    """Episodes of the evaluation protocol in a world, with the policy of an algorithm."""
    env = BridgeVectorEnv(
        episodes, model or open_model(settings.robot), world, settings.task,
        settings.task_options, settings.max_episode_steps, randomisation=settings.randomisation,
    )  # fmt: skip
    return drive_worlds(env, act_of(algorithm), range(FIRST_SEED, FIRST_SEED + episodes))
