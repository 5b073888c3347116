"""Training with RLlib's PPO on a Ray cluster or on this machine, with distributed worlds."""

import copy
import functools
import logging
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.ppo import PPO, PPOConfig
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.ray.networks import TorchActor, make_layers
from nics_drl_bridge.extras.sb3.layers import to_tensors
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array
from nics_drl_bridge.policy.train import run as train
from nics_drl_bridge.policy.train.checkpoint import read_checkpoint, write_content
from nics_drl_bridge.policy.train.normaliser import observe_statistics
from nics_drl_bridge.policy.train.progress import RECENT, Progress, Tell, TrainingLog
from nics_drl_bridge.policy.train.settings import (
    LEAST_RATE,
    TrainingSettings,
    check_serves,
)
from nics_drl_bridge.policy.train.worlds import COLLISION as TOLD_COLLISION
from nics_drl_bridge.policy.train.worlds import SUCCESS as TOLD_SUCCESS
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

FORMAT = "nics_drl_bridge/ray_checkpoint/2"
# loss parameters, as in Stable-Baselines3
VALUE_WEIGHT = 0.5
GRADIENT_LIMIT = 0.5
SILENCE_S = 600.0  # a run ends after this time without a step; it can be resumed
TRIED_S = 5.0  # timeout for connecting to an address [s]
# time that a rollout waits for a lost env runner [s]; later rollouts try again
PROBE_S = 1.0
ENDED, SUCCESS, COLLISION, STEPPING = "ended", "success", "collision", "stepping_s"
"""Names of a runner's metrics: numbers of episodes, and time in the simulator [s]."""


@dataclass(frozen=True)
class Rollout:
    """T steps of N worlds."""

    # (T + 1, N, O) observations; after an episode, the first of the next one
    observations: NDArray[np.float32]
    actions: NDArray[Any]  # (T, N, ...)
    logits: NDArray[np.float32]  # (T, N, ...) parameters of the action distribution
    logp: NDArray[np.float32]  # (T, N) log probabilities of the actions
    rewards: NDArray[np.float32]  # (T, N)
    final: dict[tuple[int, int], tuple[NDArray[np.float32], bool]]
    """(t, n) -> last observation (O,) of the episode that ended in step t of world n, and True if
    the time limit truncated it."""

    def episodes(self) -> Iterator[SingleAgentEpisode]:
        """Yields the (parts of) episodes in the rollout, world by world."""
        steps, worlds = self.rewards.shape
        cuts: list[list[int]] = [[] for _ in range(worlds)]
        for t, n in sorted(self.final):
            cuts[n].append(t + 1)
        for n, ends in enumerate(cuts):
            for begin, end in zip([0, *ends], [*ends, steps], strict=True):
                if begin < end:
                    yield self._piece(n, begin, end)

    def _piece(self, n: int, begin: int, end: int) -> SingleAgentEpisode:
        last, out_of_time = self.final.get(
            (end - 1, n), (self.observations[end, n], None)
        )
        rows = slice(begin, end)
        return SingleAgentEpisode(
            observations=[*self.observations[rows, n], last],
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
    """Steps its share of a training's worlds; `_build_algorithm` makes its `env_config`."""

    def make_env(self) -> None:
        """Makes the worlds of this runner; each runner draws different episodes."""
        chosen = self.config.env_config
        torch.set_num_threads(chosen["threads"])
        # Copy, because arrays shared by Ray are read-only and would need kernels of their own.
        make = copy.deepcopy(ray.get(chosen["make"]))
        self.env: TrainingWorlds = make(self.worker_index - 1, self.num_workers)
        self.num_envs = self.env.num_envs
        rng = np.random.default_rng([*chosen["seed"], self.worker_index])
        self.env.seed(int(rng.integers(train.SEEDS)))
        self._last = self.env.reset()

    def get_spaces(self) -> dict[str, Any]:
        """Returns the observation and action spaces under RLlib's names."""
        pair = self.config.observation_space, self.config.action_space
        return dict.fromkeys(
            (INPUT_ENV_SPACES, INPUT_ENV_SINGLE_SPACES, DEFAULT_MODULE_ID), pair
        )

    def _sample(self, **kwargs: Any) -> list[SingleAgentEpisode]:
        """Runs one rollout, whose length is fixed, whatever RLlib requests."""
        steps = int(self.config.env_config["rollout"])
        busy = self.env.stepping_s
        *arrays, finals = zip(*(self._step(t) for t in range(steps)), strict=True)
        observations, actions, logits, logp, rewards = (
            np.stack(column) for column in arrays
        )
        final = {place: end for column in finals for place, end in column.items()}
        whole = np.concatenate([observations, self._last[None]])
        ended = len(final)
        count = steps * self.num_envs
        self.metrics.log_value(ENDED, ended, reduce="sum")
        self.metrics.log_value(STEPPING, self.env.stepping_s - busy, reduce="sum")
        self._log_env_steps(self._metrics_num_env_steps_sampled, count)
        self._increase_sampled_metrics(count, ended)
        return list(Rollout(whole, actions, logits, logp, rewards, final).episodes())

    def _step(self, t: int) -> tuple[Any, ...]:
        observations = self._last
        out = self.module.forward_exploration(
            {Columns.OBS: torch.as_tensor(observations)}
        )
        logits = out[Columns.ACTION_DIST_INPUTS]
        distribution = self.module.get_exploration_action_dist_cls().from_logits(logits)
        chosen = distribution.sample()
        logp = distribution.logp(chosen).numpy()
        actions = chosen.numpy()
        space = self.env.action_space
        bounded = actions
        if isinstance(space, gymnasium.spaces.Box):
            bounded = np.clip(actions, space.low, space.high)
        step = self.env.step(bounded)
        self._last = step.observations
        endings = step.endings
        for name, metric in ((TOLD_SUCCESS, SUCCESS), (TOLD_COLLISION, COLLISION)):
            count = int(endings.get_flag(name).sum())
            self.metrics.log_value(metric, count, reduce="sum")
        final = {
            (t, int(n)): (endings.observations[k], bool(endings.truncated[k]))
            for k, n in enumerate(endings.worlds)
        }
        return observations, actions, logits.numpy(), logp, step.rewards, final


Batch = dict[str, Any]


class ActorCritic(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """Actor and a similar critic; `model_config` has `hidden`, `normaliser` and `log_std`."""

    def setup(self) -> None:
        """Builds the layers."""
        chosen = self.model_config
        space = self.observation_space
        hidden = list(chosen["hidden"])
        normaliser = chosen["normaliser"]
        self.actor = TorchActor(space, self.action_space, hidden, normaliser)
        self.critic = make_layers([int(space.shape[0]), *hidden, 1], 1.0)
        if not self.actor.discrete:
            log_std = torch.full(self.action_space.shape, float(chosen["log_std"]))
            self.log_std = torch.nn.Parameter(log_std)

    def get_non_inference_attributes(self) -> list[str]:
        """Returns the names of attributes that env runners do not need."""
        return ["critic"]

    def _forward(self, batch: Batch, **kwargs: Any) -> Batch:
        raw = self.actor(batch[Columns.OBS])
        if not self.actor.discrete:
            raw = torch.cat([raw, self.log_std.expand_as(raw)], dim=-1)
        return {Columns.ACTION_DIST_INPUTS: raw}

    def compute_values(self, batch: Batch, embeddings: Any = None) -> torch.Tensor:
        """Returns the values (n,) of observations (n, O)."""
        values: torch.Tensor = self.critic(self.actor.normaliser(batch[Columns.OBS]))
        return values.squeeze(-1)


@contextmanager
def learner(
    address: str | None, env_runners: int | None, worlds: int
) -> Iterator[Callable[..., train.Trained]]:
    """Connects to a cluster, see `connect`; yields the function that trains one policy on it."""
    with connect(address, env_runners, worlds) as runners:
        yield functools.partial(train_on_ray, runners=runners)


@contextmanager
def connect(address: str | None, runners: int | None, worlds: int) -> Iterator[int]:
    """Connects to `auto`, `HOST:PORT` or, for None, a new local cluster.

    Yields the number of env runners. Raises ConfigError.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # A lost worker is not an error here, and Ray's messages about it would break the progress bar.
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
    logging.getLogger("ray.rllib").setLevel(logging.CRITICAL)
    local = {"include_dashboard": False} if address is None else {}
    try:
        if address not in (None, "auto"):  # check first: Ray would try for minutes
            host, _, port = str(address).rpartition(":")
            socket.create_connection((host, int(port)), TRIED_S).close()
        ray.init(
            address or "local", log_to_driver=False, logging_level="ERROR", **local
        )
    except (OSError, OverflowError, ValueError, RuntimeError) as error:
        first = str(error).strip().partition("\n")[0].rstrip(".")
        fix = "start one on the first machine with 'ray start --head', and name its HOST:PORT."
        raise ConfigError(
            f"--address {address}: no Ray cluster answers ({first}); {fix}"
        ) from None
    try:
        yield _count_runners(
            runners, int(ray.cluster_resources().get("CPU", 0)), worlds
        )
    finally:
        ray.shutdown()


def _count_runners(runners: int | None, cpus: int, worlds: int) -> int:
    if runners is None:
        return max(1, min(cpus, worlds))
    if runners > cpus:
        fix = "each env runner takes one; add machines with 'ray start', or ask for fewer."
        raise ConfigError(
            f"--env-runners {runners}: the cluster has {cpus} CPUs, and {fix}"
        )
    if runners > worlds:
        fix = "give them more, or ask for fewer."
        raise ConfigError(
            f"--env-runners {runners}: the settings have {worlds} worlds; {fix}"
        )
    return runners


def train_on_ray(
    model: SimulatorModel,
    worlds: train.Worlds,
    settings: TrainingSettings,
    seed: int,
    folder: Path,
    tell: Tell = lambda _: None,
    resumed: bool = False,
    runners: int = 1,
) -> train.Trained:
    """Trains like `policy.train.run.train`, on the connected cluster.

    Raises ConfigError, also if no runner answers.
    """
    if settings.algorithm != "ppo":
        algorithm_name = settings.algorithm
        raise ConfigError(
            f"--engine ray learns with ppo, not {algorithm_name!r}; leave it out."
        )
    if settings.stop is not None:
        raise ConfigError(
            "--engine ray does not stop early; leave out --engine, or stop."
        )
    begin = time.perf_counter()
    path = folder / train.CHECKPOINT
    about: dict[str, Any] = {"seed": seed, "settings": settings.model_dump(mode="json")}
    content = read_checkpoint(path, FORMAT) if resumed else None
    if content is not None:
        train.check_same(content["about"], about, path)
    done = 0 if content is None else content["steps"]
    algorithm = _build_algorithm(model, worlds, settings, seed, done, runners)
    try:
        learning = Learning(algorithm, settings, seed, path, runners)
        if content is not None:
            learning.resume(content)
        learning.run(tell, about)
        actor = learning.module.actor.eval().cpu()
    finally:
        algorithm.stop()
    return train.Trained(
        actor,
        actor.act,
        learning.steps,
        time.perf_counter() - begin,
        learning.stepping_s,
    )


@dataclass
class Learning:
    """A training in progress; `path` is its checkpoint, `runners` the number of env runners."""

    algorithm: PPO
    settings: TrainingSettings
    seed: int
    path: Path
    runners: int
    steps: int = 0
    stepping_s: float = 0.0  # time in the simulator, averaged over env runners [s]
    recent: deque[tuple[int, int, int]] = field(default_factory=deque)
    """Per rollout, for the latest ones: ended episodes, successes, collisions."""

    @property
    def learner(self) -> Any:
        """RLlib's learner, which runs in this process."""
        results = self.algorithm.learner_group.foreach_learner(lambda one: one)
        return results.result_or_errors[0].get()

    @property
    def module(self) -> ActorCritic:
        """The network in training."""
        network: ActorCritic = self.learner.module[DEFAULT_MODULE_ID].unwrapped()
        return network

    def run(self, tell: Tell, about: dict[str, Any]) -> None:
        """Learns until all steps are done; saves checkpoints."""
        log = TrainingLog(self.path.parent)
        begin = heard = time.perf_counter()
        first = saved = self.steps
        every = self.settings.checkpoint_every
        while self.steps < self.settings.steps:
            before = self.steps
            self._take(self.algorithm.train())
            now = time.perf_counter()
            if self.steps == before:
                self._check_silence(now - heard, about)
                continue
            heard = now
            progress = self._progress(first, now - begin)
            tell(progress)
            for name in ("success", "collision", "steps_per_s", "env_share"):
                log.record(f"rollout/{name}", getattr(progress, name))
            log.dump(self.steps)
            if self.steps // every > saved // every:
                self.save(about)
                saved = self.steps
        self.save(about)
        log.close()

    def _take(self, result: Mapping[str, Any]) -> None:
        metrics = result.get(ENV_RUNNER_RESULTS, {})
        self.steps += int(metrics.get(NUM_ENV_STEPS_SAMPLED, 0))
        self.stepping_s += float(metrics.get(STEPPING, 0.0)) / self.runners
        ended, success, collision = (
            int(metrics.get(n, 0)) for n in (ENDED, SUCCESS, COLLISION)
        )
        self.recent.append((ended, success, collision))
        while sum(one[0] for one in self.recent) - self.recent[0][0] >= RECENT:
            self.recent.popleft()

    def _check_silence(self, silent_s: float, about: dict[str, Any]) -> None:
        if silent_s > SILENCE_S:
            self.save(about)
            fix = f"look at 'ray status', and go on from {self.path} with --resume."
            raise ConfigError(f"no env runner has answered for {silent_s:.0f} s; {fix}")

    def _progress(self, first: int, taken: float) -> Progress:
        ended, *counts = np.sum(list(self.recent), axis=0)
        success, collision = (float(n / ended) if ended else np.nan for n in counts)
        speed = (self.steps - first) / taken
        busy = self.stepping_s / taken
        return Progress(
            self.seed, self.steps, self.settings.steps, success, collision, speed, busy
        )

    def save(self, about: dict[str, Any]) -> None:
        """Saves the network and the optimiser."""
        content = {"format": FORMAT, "about": about, "steps": self.steps}
        optimiser = self.learner.get_optimizer().state_dict()
        states = {"network": self.module.state_dict(), "optimiser": optimiser}
        write_content(self.path, content | states)

    def resume(self, content: dict[str, Any]) -> None:
        """Continues with a checkpoint's network and optimiser; the worlds start afresh."""
        self.steps = int(content["steps"])
        self.module.load_state_dict(to_tensors(content["network"]))
        optimiser = to_tensors(content["optimiser"])
        self.learner.get_optimizer().load_state_dict(optimiser)
        self.algorithm.env_runner_group.sync_weights(
            from_worker_or_learner_group=self.algorithm.learner_group,
            inference_only=True,
        )


def _build_algorithm(
    model: SimulatorModel,
    worlds: train.Worlds,
    settings: TrainingSettings,
    seed: int,
    done: int,
    runners: int,
) -> PPO:
    torch.set_num_threads(settings.threads)
    rng = np.random.default_rng(seed)
    env = train.make_training_worlds(model, worlds, settings)
    check_serves(settings, env.envs[0])
    env.seed(int(rng.integers(train.SEEDS)))
    normaliser = observe_statistics(env, rng)
    spaces = env.observation_space, env.action_space
    env.close()
    make = ray.put(functools.partial(select_worlds, model, worlds, settings))
    env_config = {"make": make, "seed": (seed, done), "threads": settings.threads}
    env_config["rollout"] = settings.ppo.rollout
    config = _make_config(settings, seed, done, normaliser, spaces).env_runners(
        env_runner_cls=WorldsRunner,
        num_env_runners=runners,
        rollout_fragment_length="auto",
        sample_timeout_s=SILENCE_S,
    )
    algorithm = config.environment(env_config=env_config).build_algo()
    Path(algorithm.logdir).rmdir()  # RLlib creates it and leaves it empty
    return algorithm


def select_worlds(
    model: SimulatorModel,
    worlds: train.Worlds,
    settings: TrainingSettings,
    runner: int,
    runners: int,
) -> TrainingWorlds:
    """Makes the worlds of env runner number `runner`: every `runners`-th."""
    names = [name for name, count in settings.worlds.items() for _ in range(count)]
    counts = dict(Counter(names[runner::runners]))
    return train.make_training_worlds(
        model, worlds, settings.model_copy(update={"worlds": counts})
    )


def _make_config(
    settings: TrainingSettings,
    seed: int,
    done: int,
    normaliser: tuple[Array, Array],
    spaces: tuple[gymnasium.Space[Any], gymnasium.Space[Any]],
) -> PPOConfig:
    chosen = settings.ppo
    left = max(settings.steps - done, 1)
    rate = chosen.learning_rate
    now = rate * max(1.0 - done / settings.steps, LEAST_RATE)
    network = {
        "hidden": settings.hidden,
        "normaliser": normaliser,
        "log_std": chosen.log_std,
    }
    return (
        PPOConfig()
        .framework("torch")
        .environment(observation_space=spaces[0], action_space=spaces[1])
        .rl_module(
            rl_module_spec=RLModuleSpec(module_class=ActorCritic, model_config=network)
        )
        .learners(num_learners=0)
        .training(
            lr=[[0, now], [left, rate * LEAST_RATE]],
            train_batch_size_per_learner=chosen.rollout * settings.num_envs,
            minibatch_size=chosen.batch,
            num_epochs=chosen.epochs,
            gamma=chosen.discount,
            lambda_=chosen.gae_lambda,
            clip_param=chosen.clip,
            entropy_coeff=chosen.entropy,
            vf_loss_coeff=VALUE_WEIGHT,
            vf_clip_param=np.inf,
            use_kl_loss=False,
            grad_clip=GRADIENT_LIMIT,
            grad_clip_by="global_norm",
        )
        .fault_tolerance(
            restart_failed_env_runners=True,
            delay_between_env_runner_restarts_s=PROBE_S,
            env_runner_health_probe_timeout_s=PROBE_S,
        )
        .debugging(seed=seed, log_level="ERROR")
    )
