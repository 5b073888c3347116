"""An env runner of RLlib that steps many worlds at once, and the network that it runs.

RLlib's own iterates over its worlds in Python in every step, which takes many times longer than
the simulator. This one keeps arrays, and cuts them into episodes at the end.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from nics_drl_bridge.policy.train import SEEDS
from nics_drl_bridge.policy.train_algorithms import Actor, layers_of
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv

ENDED, SUCCESS, COLLISION, STEPPING = "ended", "success", "collision", "stepping_s"
"""Names of a runner's metrics: numbers of episodes, and time in the simulator [s]."""


@dataclass(frozen=True)
class Rollout:
    """T steps of N worlds."""

    seen: NDArray[np.float32]  # (T + 1, N, O); after an episode, the first of the next one
    actions: NDArray[Any]  # (T, N, ...)
    logits: NDArray[np.float32]  # (T, N, ...) parameters of the distribution of actions
    logp: NDArray[np.float32]  # (T, N) log probabilities of the actions
    rewards: NDArray[np.float32]  # (T, N)
    final: dict[tuple[int, int], tuple[NDArray[np.float32], bool]]
    """(t, n) -> last observation (O,) of the episode that ended in step t of world n, and True if
    it only ran out of time."""

    def episodes(self) -> Iterator[SingleAgentEpisode]:
        """Yields the pieces of episodes in the roll-out, each of one world."""
        steps, worlds = self.rewards.shape
        cuts: list[list[int]] = [[] for _ in range(worlds)]
        for t, n in sorted(self.final):
            cuts[n].append(t + 1)
        for n, ends in enumerate(cuts):
            begins = [0, *ends]
            for begin, end in zip(begins, [*ends, steps], strict=True):
                if begin < end:
                    yield self._piece(n, begin, end)

    def _piece(self, n: int, begin: int, end: int) -> SingleAgentEpisode:
        last, out_of_time = self.final.get((end - 1, n), (self.seen[end, n], None))
        rows = slice(begin, end)
        return SingleAgentEpisode(
            observations=[*self.seen[rows, n], last],
            actions=list(self.actions[rows, n]),
            rewards=list(self.rewards[rows, n]),
            terminated=out_of_time is False,
            truncated=out_of_time is True,
            extra_model_outputs={
                Columns.ACTION_DIST_INPUTS: list(self.logits[rows, n]),
                Columns.ACTION_LOGP: list(self.logp[rows, n]),
            },
            len_lookback_buffer=0,
        ).to_numpy()


class WorldsRunner(SingleAgentEnvRunner):
    """Steps its share of the worlds of a training.

    `env_config` contains `make` (a reference to a function of runner and number of runners that
    makes a TrainVecEnv), `rollout` (T), `seed` (two numbers) and `threads`.
    """

    def make_env(self) -> None:
        """Makes the worlds of this runner; each runner draws different episodes."""
        chosen = self.config.env_config
        torch.set_num_threads(chosen["threads"])
        # Arrays shared by Ray are read-only; the kernels would be compiled again for them.
        make = copy.deepcopy(ray.get(chosen["make"]))
        self.env: TrainVecEnv = make(self.worker_index - 1, self.num_workers)
        self.num_envs = self.env.num_envs
        rng = np.random.default_rng([*chosen["seed"], self.worker_index])
        self.env.seed(int(rng.integers(SEEDS)))
        self._seen = self.env.reset()

    def get_spaces(self) -> dict[str, Any]:
        """Spaces of observations and actions, as RLlib names them."""
        pair = self.config.observation_space, self.config.action_space
        return dict.fromkeys((INPUT_ENV_SPACES, INPUT_ENV_SINGLE_SPACES, DEFAULT_MODULE_ID), pair)

    def _sample(self, **kwargs: Any) -> list[SingleAgentEpisode]:
        """Runs one roll-out; its length is fixed, whatever RLlib requests."""
        steps, busy = int(self.config.env_config["rollout"]), self.env.stepping_s
        parts = [self._step(t) for t in range(steps)]
        *arrays, finals = zip(*parts, strict=True)
        seen, actions, logits, logp, rewards = (np.stack(one) for one in arrays)
        final = {place: end for one in finals for place, end in one.items()}
        whole = np.concatenate([seen, self._seen[None]])
        ended, count = len(final), steps * self.num_envs
        self.metrics.log_value(ENDED, ended, reduce="sum")
        self.metrics.log_value(STEPPING, self.env.stepping_s - busy, reduce="sum")
        self._log_env_steps(self._metrics_num_env_steps_sampled, count)
        self._increase_sampled_metrics(count, ended)
        return list(Rollout(whole, actions, logits, logp, rewards, final).episodes())

    def _step(self, t: int) -> tuple[Any, ...]:
        """Steps every world once; returns a row of `Rollout`."""
        seen = self._seen
        out = self.module.forward_exploration({Columns.OBS: torch.as_tensor(seen)})
        logits = out[Columns.ACTION_DIST_INPUTS]
        distribution = self.module.get_exploration_action_dist_cls().from_logits(logits)
        chosen = distribution.sample()
        logp, actions = distribution.logp(chosen).numpy(), chosen.numpy()
        space, bounded = self.env.action_space, actions
        if isinstance(space, gymnasium.spaces.Box):
            bounded = np.clip(actions, space.low, space.high)
        self._seen, rewards, done, infos = self.env.step(bounded)
        final = {}
        for n in np.flatnonzero(done):
            info = infos[n]
            for name, metric in (("is_success", SUCCESS), ("collision", COLLISION)):
                self.metrics.log_value(metric, int(info.get(name, False)), reduce="sum")
            final[t, int(n)] = info["terminal_observation"], info["TimeLimit.truncated"]
        return seen, actions, logits.numpy(), logp, rewards, final


Batch = dict[str, Any]


class ActorCritic(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """`Actor` and a critic of the same widths, as a module of RLlib.

    `model_config` contains `hidden`, `normaliser` and `log_std`, see `Actor` and `PpoSettings`.
    """

    def setup(self) -> None:
        """Builds the layers."""
        chosen, size = self.model_config, int(self.observation_space.shape[0])
        hidden, normaliser = list(chosen["hidden"]), chosen["normaliser"]
        self.actor = Actor(self.observation_space, self.action_space, hidden, normaliser)
        self.critic = layers_of([size, *hidden, 1], 1.0)
        if not self.actor.discrete:
            spread = torch.full(self.action_space.shape, float(chosen["log_std"]))
            self.log_std = torch.nn.Parameter(spread)

    def get_non_inference_attributes(self) -> list[str]:
        """Names of the attributes that env runners do not need."""
        return ["critic"]

    def _forward(self, batch: Batch, **kwargs: Any) -> Batch:
        raw = self.actor(batch[Columns.OBS])
        if not self.actor.discrete:
            raw = torch.cat([raw, self.log_std.expand_as(raw)], dim=-1)
        return {Columns.ACTION_DIST_INPUTS: raw}

    def compute_values(self, batch: Batch, embeddings: Any = None) -> torch.Tensor:
        """Values (n,) of observations (n, O)."""
        values: torch.Tensor = self.critic(self.actor.normaliser(batch[Columns.OBS]))
        return values.squeeze(-1)
