"""PPO and SAC of Stable-Baselines3, and the network layers that all engines share."""

from __future__ import annotations

import itertools
import json
from collections import deque
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Mask, Singles
from nics_drl_bridge.policy.evaluation import Act
from nics_drl_bridge.policy.train.checkpoint import tensors
from nics_drl_bridge.policy.train.progress import RECENT, Watch
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv

LEAST_RATE = 0.02  # final fraction of PPO's learning rate
LEAST_STD = 0.05
LIMIT = 5.0
NEAR = 0.1  # fraction of the range that is mapped to one half, see `bend`
# minimum deviation as a fraction of the span of an observation, or of its mean if smaller
LEAST_SHARE = 0.25
OBSERVED_STEPS = 32
OBSERVED_WORLDS = 256
GAIN = 2.0**0.5
# initial gain of an actor's last layer: all actions start near zero
ACTION_GAIN = 0.01
# rollouts or episodes between two TensorBoard entries
LOG_EVERY = {
    "ppo": 1,
    "sac": 1000,
}
COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_current_progress_remaining",
)
LAST = ("_last_obs", "_last_episode_starts")
REPLAYED = (
    "observations",
    "next_observations",
    "actions",
    "rewards",
    "dones",
    "timeouts",
)


def check_serves(settings: TrainingSettings, env: BridgeVectorEnv) -> None:
    """Raises ConfigError if the algorithm does not suit task and settings, or for a team's task."""
    if env.robots > 1:
        raise ConfigError(
            f"task {settings.task!r}: has {env.robots} robots; train a single-robot task, or use "
            "your own learner (docs/environments.md)."
        )
    continuous = isinstance(env.single_action_space, gymnasium.spaces.Box)
    if settings.algorithm == "sac" and not continuous:
        raise ConfigError("algorithm 'sac' needs continuous actions; use 'ppo'.")
    size = settings.ppo.rollout * settings.num_envs
    if settings.algorithm == "ppo" and settings.ppo.batch > size:
        raise ConfigError(
            f"ppo.batch {settings.ppo.batch}: exceeds the {size} transitions of a rollout; lower "
            "it, or raise ppo.rollout or worlds."
        )


def make_act(algorithm: BaseAlgorithm | Actor) -> Act:
    """Returns the deterministic policy of an algorithm, without exploration noise."""

    def act(observations: Singles) -> AnyArray:
        seen = torch.as_tensor(observations)
        with torch.no_grad():
            if isinstance(algorithm, Actor):
                return np.asarray(algorithm.best(seen).numpy())
            policy: Any = algorithm.policy
            return np.asarray(policy._predict(seen, deterministic=True).numpy())

    return act


class Normaliser(BaseFeaturesExtractor):
    """First layer of actor and critic: (bent - mean) / std (O,), clamped to +-5; not trained.

    Only observations from 0 to 1 are bent, see `bend`, because small fractions of a range matter
    most.
    """

    mean: torch.Tensor
    std: torch.Tensor
    shares: torch.Tensor  # (O,) 1 for observations from 0 to 1, else 0

    def __init__(self, space: gymnasium.spaces.Box, mean: Array, std: Array) -> None:
        super().__init__(space, features_dim=int(np.prod(space.shape)))
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("std", torch.as_tensor(std, dtype=torch.float32))
        self.register_buffer("shares", torch.as_tensor(find_shares(space)))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalises observations (N, O)."""
        return torch.clamp(
            (bend(observations, self.shares) - self.mean) / self.std, -LIMIT, LIMIT
        )


def find_shares(space: gymnasium.spaces.Box) -> Singles:
    """Returns 1 for the observations (O,) of a space that lie between 0 and 1, else 0."""
    shares: Mask = (space.low == 0.0) & (space.high == 1.0)
    return shares.astype(np.float32)


def bend(observations: Any, shares: Any) -> Any:
    """Maps fractions x to (1 + k) x / (k + x), also from 0 to 1; k = `NEAR` maps to about 1/2.

    Observations are (N, O); `shares` (O,) is 1 for those to bend, and 0 for the others.
    """
    grown = 1.0 + NEAR * shares
    least = 1.0 + (NEAR - 1.0) * shares
    return observations * grown / (observations * shares + least)


def observe_statistics(env: VecEnv, rng: np.random.Generator) -> tuple[Array, Array]:
    """Returns mean and standard deviation (O,) of bent observations under random actions.

    The deviation is at least 0.05 and at least a quarter of the span or the mean, whichever is
    smaller.
    """
    some = slice(None, None, max(1, env.num_envs // OBSERVED_WORLDS))
    seen = [np.array(env.reset()[some])]
    for k in range(OBSERVED_STEPS):
        if k % 8 == 0:  # otherwise a robot with inertia would hardly move
            space: Any = env.action_space
            if isinstance(space, gymnasium.spaces.Discrete):
                actions: AnyArray = rng.integers(space.n, size=env.num_envs)
            else:
                actions = rng.uniform(-1.0, 1.0, (env.num_envs, *space.shape)).astype(
                    np.float32
                )
        seen.append(np.array(env.step(actions)[0][some]))
    rows = np.concatenate(seen).reshape(-1, seen[0].shape[-1]).astype(np.float64)
    rows = bend(rows, find_shares(env.observation_space))
    mean = rows.mean(axis=0)
    # Later observations may vary more than those near the starts.
    span = np.minimum(
        env.observation_space.high - env.observation_space.low, np.abs(mean)
    )
    return mean, np.maximum(rows.std(axis=0), np.maximum(LEAST_STD, LEAST_SHARE * span))


class Actor(torch.nn.Module):
    """Maps observations (n, O) to raw actions (n, C), or to logits (n, A) of discrete ones."""

    def __init__(
        self,
        observations: gymnasium.spaces.Box,
        actions: gymnasium.spaces.Box | gymnasium.spaces.Discrete,
        hidden: Sequence[int],
        normaliser: tuple[Array, Array],
        activation: type[torch.nn.Module] = torch.nn.Tanh,
    ) -> None:
        super().__init__()
        self.discrete = isinstance(actions, gymnasium.spaces.Discrete)
        count = gymnasium.spaces.flatdim(actions)
        self.normaliser = Normaliser(observations, *normaliser)
        widths = [self.normaliser.features_dim, *hidden, count]
        self.layers = make_layers(widths, ACTION_GAIN, activation)

    def forward(self, observations: torch.Tensor) -> Any:
        """Returns parameters of the action distribution: the mode if continuous, else logits."""
        return self.layers(self.normaliser(observations))

    def best(self, observations: torch.Tensor) -> torch.Tensor:
        """Returns the most likely actions (n, C), or (n,) if discrete."""
        raw = self(observations)
        return raw.argmax(dim=1) if self.discrete else raw


def make_layers(
    widths: Sequence[int],
    gain: float,
    activation: type[torch.nn.Module] = torch.nn.Tanh,
) -> torch.nn.Sequential:
    """Returns linear layers, initialised as in Stable-Baselines3, the last one with `gain`."""
    layers: list[torch.nn.Module] = []
    for ins, outs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(ins, outs), activation()]
    del layers[-1]
    for layer in layers[::2]:
        torch.nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else GAIN)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(*layers)


class Sb3Training:
    """A training with a Stable-Baselines3 algorithm; `normaliser` is mean and deviation (O,).

    Raises: see `check_serves`.
    """

    def __init__(
        self,
        settings: TrainingSettings,
        env: TrainVecEnv,
        seed: int,
        normaliser: tuple[Array, Array],
    ) -> None:
        check_serves(settings, env.envs[0])
        torch.set_num_threads(settings.threads)
        self._total = settings.steps
        self._log_every = LOG_EVERY[settings.algorithm]
        shared: dict[str, Any] = {
            "seed": seed,
            "device": "cpu",
            "stats_window_size": RECENT,
        }
        network: dict[str, Any] = {
            "net_arch": list(settings.hidden),
            "features_extractor_class": Normaliser,
            "features_extractor_kwargs": {"mean": normaliser[0], "std": normaliser[1]},
        }
        if settings.algorithm == "sac":
            sac = settings.sac
            self.policy: BaseAlgorithm = SAC(
                "MlpPolicy",
                env,
                sac.learning_rate,
                buffer_size=sac.buffer,
                learning_starts=sac.begin_after,
                batch_size=sac.batch,
                tau=sac.soft_update,
                gamma=sac.discount,
                train_freq=1,
                gradient_steps=sac.updates,
                policy_kwargs=network,
                **shared,
            )
        else:
            ppo = settings.ppo
            network |= {"log_std_init": ppo.log_std, "activation_fn": torch.nn.Tanh}
            self.policy = PPO(
                "MlpPolicy",
                env,
                lambda remaining: ppo.learning_rate * max(remaining, LEAST_RATE),
                n_steps=ppo.rollout,
                batch_size=ppo.batch,
                n_epochs=ppo.epochs,
                gamma=ppo.discount,
                gae_lambda=ppo.gae_lambda,
                clip_range=ppo.clip,
                ent_coef=ppo.entropy,
                policy_kwargs=network,
                **shared,
            )
        self.networks = self.policy.policy

    @property
    def steps(self) -> int:
        """Environment steps done, over all worlds."""
        return int(self.policy.num_timesteps)

    def learn(self, watch: Watch, logger: Logger) -> None:
        """Learns until all steps are done."""
        self.policy.set_logger(logger)
        left = self._total - self.steps
        companion = Companion(watch, make_act(self.policy))
        self.policy.learn(left, companion, self._log_every, reset_num_timesteps=False)

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""
        algorithm = self.policy
        replay: dict[str, Any] = {}
        if isinstance(algorithm, OffPolicyAlgorithm):
            buffer: Any = algorithm.replay_buffer
            rows = {name: getattr(buffer, name)[: buffer.size()] for name in REPLAYED}
            replay = {"pos": buffer.pos, "full": buffer.full, **tensors(rows)}
        shared = np.random.get_state(legacy=False)  # noqa: NPY002 - the library uses it
        drawn = algorithm.action_space.np_random.bit_generator.state
        return {
            "parameters": algorithm.get_parameters(),
            "variables": {  # not in the networks: SAC's temperature
                name: getattr(algorithm, name).detach().clone()
                for name in algorithm._get_torch_save_params()[1]
            },
            "counters": {name: getattr(algorithm, name) for name in COUNTERS},
            "recent": list(algorithm.ep_success_buffer or ()),
            "last": tensors({name: getattr(algorithm, name) for name in LAST}),
            "replay": replay,
            "random": {
                "torch": torch.get_rng_state(),
                "numpy": json.dumps(shared, default=lambda array: array.tolist()),
                "actions": json.dumps(drawn),
            },
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from the state of another training made with the same arguments."""
        algorithm = self.policy
        algorithm.set_parameters(state["parameters"], exact_match=True)
        for name, value in state["variables"].items():
            getattr(algorithm, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(algorithm, name, value)
        size = algorithm._stats_window_size
        algorithm.ep_success_buffer = deque(state["recent"], maxlen=size)
        algorithm.ep_info_buffer = deque(maxlen=size)
        for name, value in state["last"].items():
            setattr(algorithm, name, value.numpy().copy())
        if isinstance(algorithm, OffPolicyAlgorithm):
            buffer: Any = algorithm.replay_buffer
            replay = state["replay"]
            buffer.pos = replay["pos"]
            buffer.full = replay["full"]
            for name in REPLAYED:
                getattr(buffer, name)[: buffer.size()] = replay[name].numpy()
        random = state["random"]
        set_random_seed(0)
        torch.set_rng_state(random["torch"])
        shared = json.loads(random["numpy"])
        shared["state"]["key"] = np.array(shared["state"]["key"], np.uint32)
        np.random.set_state(shared)  # noqa: NPY002 - as above
        drawn = json.loads(random["actions"])
        algorithm.action_space.np_random.bit_generator.state = drawn


class Companion(BaseCallback):
    """Callback that makes Stable-Baselines3 call a watch in each step and rollout."""

    def __init__(self, watch: Watch, act: Act) -> None:
        super().__init__()
        self._watch = watch
        self._act = act
        self._ends = False

    def _on_training_start(self) -> None:
        self._watch.begin(self.num_timesteps)

    def _on_rollout_start(self) -> None:
        steps = self.model.num_timesteps
        self._watch.keep(steps)
        self._ends = self._watch.ends(steps, self._act, self.logger)

    def _on_step(self) -> bool:
        for n in np.flatnonzero(self.locals["dones"]):
            self._watch.collisions.append(
                bool(self.locals["infos"][n].get("collision", False))
            )
        # Stable-Baselines3 can't stop before the first step of a rollout.
        if self._ends:
            self._on_rollout_end()
        return not self._ends

    def _on_rollout_end(self) -> None:
        self._watch.report(
            self.num_timesteps, self.model.ep_success_buffer or (), self.logger
        )
