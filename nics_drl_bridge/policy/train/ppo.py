"""The lean engine: PPO that collects on one core while it learns on another.

Proximal policy optimisation (Schulman and others 2017) with the loss of
Stable-Baselines3. The data are collected with weights that are one update old. PPO's
ratio accounts for this, because it uses the probabilities at the time of drawing.
Collecting and learning synchronise after each rollout, so results do not depend on
which of them is faster. If collecting finishes first, actor and critic learn on one
core each for the rest of the update.
"""

from __future__ import annotations

import copy
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from stable_baselines3.common.logger import Logger

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.policy.train import algorithms, kernels
from nics_drl_bridge.policy.train.adam import Adam
from nics_drl_bridge.policy.train.kernels import LOG_NORM, Net, Transitions
from nics_drl_bridge.policy.train.progress import RECENT, Watch
from nics_drl_bridge.policy.train.settings import PpoSettings, TrainingSettings
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv
from nics_drl_bridge.threads import one_blas_thread, run_parts

Ended = list[tuple[bool, bool]]  # (success, collision) of ended episodes
VALUE_WEIGHT = 0.5  # of the value loss


class Rollout(NamedTuple):
    """A rollout as collected: T steps of N worlds."""

    observations: torch.Tensor  # (T + 1, N, O) normalised observations
    actions: torch.Tensor  # (T, N, C), or (T, N) discrete
    log_probs: torch.Tensor  # (T, N) of the actions when they were drawn
    rewards: torch.Tensor  # (T, N)
    dones: torch.Tensor  # (T, N) 1 at ends of episodes
    truncated: torch.Tensor  # (K,) indices t N + n of the truncated episodes
    final_observations: torch.Tensor  # (K, O) the last ones of these episodes


class Networks(torch.nn.Module):
    """Actor and critic on normalised observations, and the deviation of continuous actions."""

    def __init__(
        self, actor: algorithms.Actor, hidden: tuple[int, ...], log_std: float
    ) -> None:
        super().__init__()
        self.actor = actor
        self.critic = algorithms.make_layers(
            [actor.layers[0].in_features, *hidden, 1], 1.0, torch.nn.ReLU
        )
        outputs = actor.layers[-1].out_features
        self.log_std = torch.nn.Parameter(
            torch.full((0 if actor.discrete else outputs,), log_std)
        )

    def draw(self, raw: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Draws actions (n, C) or (n,), given the outputs (n, C) of the actor."""
        if self.actor.discrete:
            return torch.multinomial(raw.softmax(1), 1, generator=generator).squeeze(1)
        return torch.normal(raw, self.log_std.exp().expand_as(raw), generator=generator)

    def log_probs(self, raw: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the log probability or log density (n,) of actions (n, C) or (n,)."""
        if self.actor.discrete:
            return raw.log_softmax(1).gather(1, actions[:, None]).squeeze(1)
        apart = (actions - raw) * torch.exp(-self.log_std)
        return -0.5 * apart.square().sum(1) - (self.log_std + float(LOG_NORM)).sum()


def flatten_weights(networks: Networks) -> tuple[Singles, Singles]:
    """Moves all weights and gradients into one vector each (n,), and returns these.

    The networks' weights and gradients become views of them.
    """
    parameters = list(networks.parameters())
    weights = torch.nn.utils.parameters_to_vector(parameters).detach()
    gradients = torch.zeros_like(weights)
    sizes = [parameter.numel() for parameter in parameters]
    parts = zip(parameters, weights.split(sizes), gradients.split(sizes), strict=True)
    for parameter, values, gradient in parts:
        parameter.data, parameter.grad = (
            values.view_as(parameter),
            gradient.view_as(parameter),
        )
    return weights.numpy(), gradients.numpy()


def make_net(layers: torch.nn.Sequential, rows: int) -> Net:
    """Returns the layers of a `flatten_weights` network for the kernels, with memory for `rows`."""
    parameters = list(layers.parameters())
    whole = (sum(parameter.numel() for parameter in parameters),)
    weights, gradients = (
        first.view(-1).as_strided(whole, (1,)).numpy()
        for first in (parameters[0].detach(), parameters[0].grad)
    )
    widths = np.array(
        [parameters[0].shape[1], *(len(bias) for bias in parameters[1::2])]
    )
    kept, spare = (
        np.empty((k, rows * widths.max()), np.float32) for k in (len(widths) - 1, 2)
    )
    return Net(weights, gradients, widths, kept, spare)


def estimate_advantages(
    rewards: torch.Tensor,
    values: torch.Tensor,
    done: torch.Tensor,
    discount: float,
    decay: float,
) -> torch.Tensor:
    """Returns generalised advantage estimates (T, N) (Schulman and others 2016).

    Inputs are rewards (T, N), values (T + 1, N), and `done` (T, N), which is 1 at the ends of
    episodes; `decay` is lambda.
    """
    going = 1.0 - done
    errors = rewards + discount * going * values[1:] - values[:-1]
    factors = discount * decay * going
    for t in range(len(errors) - 2, -1, -1):
        errors[t] += factors[t] * errors[t + 1]
    return errors


class Learner:
    """Updates the weights by gradients of the loss."""

    def __init__(
        self,
        networks: Networks,
        ppo: PpoSettings,
        seed: int,
    ) -> None:
        self.networks = networks
        self.ppo = ppo
        self.generator = torch.Generator().manual_seed(seed)
        self.optimiser = Adam(*flatten_weights(networks))
        self._nets = [
            make_net(p, ppo.batch) for p in (networks.actor.layers, networks.critic)
        ]
        self.core_is_free = threading.Event()  # set when the collecting thread is done

    def compute_transitions(self, rollout: Rollout) -> Transitions:
        """Computes advantages and returns of a rollout, with the current critic."""
        networks = self.networks
        ppo = self.ppo
        with torch.no_grad():
            values = networks.critic(rollout.observations).squeeze(-1)
            rewards = rollout.rewards.clone()
            # Bootstrap where a time limit truncated the episode.
            final_values = networks.critic(rollout.final_observations).squeeze(-1)
            rewards.view(-1)[rollout.truncated] += ppo.discount * final_values
        advantages = estimate_advantages(
            rewards, values, rollout.dones, ppo.discount, ppo.gae_lambda
        )
        rows = (
            rollout.observations[:-1],
            rollout.actions,
            rollout.log_probs,
            advantages,
            advantages + values[:-1],
        )
        return Transitions(*(field.flatten(0, 1) for field in rows))

    def learn(self, rollout: Transitions, rate: float) -> float:
        """Learns from a rollout at a learning rate; returns the loss of the last batch."""
        for _ in range(self.ppo.epochs):
            order = torch.randperm(len(rollout.observations), generator=self.generator)
            for rows in order.split(self.ppo.batch):  # the last may be smaller
                batch = Transitions(*(field[rows] for field in rollout))
                loss = self.differentiate(batch)
                self.optimiser.step(rate)
        return float(loss)

    def differentiate(self, batch: Transitions) -> torch.Tensor:
        """Sets the gradients of all weights for a batch; returns the loss."""
        columns = batch.actions.float().view(len(batch.observations), -1)
        fields = batch._replace(actions=columns)
        arrays = Transitions(*(field.numpy() for field in fields))
        actor, critic = self._nets
        log_std = self.networks.log_std
        jobs: list[Callable[[], Any]] = [
            partial(
                kernels.compute_actor_gradients,
                actor,
                arrays,
                log_std.detach().numpy(),
                log_std.grad.numpy(),
                np.float32(self.ppo.clip),
                np.float32(self.ppo.entropy),
            ),
            partial(
                kernels.compute_critic_gradients,
                critic,
                arrays,
                np.float32(VALUE_WEIGHT),
            ),
        ]
        free = self.core_is_free.is_set()
        losses = run_parts(lambda job: job(), jobs) if free else [job() for job in jobs]
        return torch.tensor(sum(losses))


class Collector:
    """Steps the worlds with a copy of the networks."""

    def __init__(
        self, env: TrainVecEnv, networks: Networks, ppo: PpoSettings, seed: int
    ) -> None:
        self.env = env
        self.networks = copy.deepcopy(networks)
        self.ppo = ppo
        self.generator = torch.Generator().manual_seed(seed)
        self.last = np.zeros((env.num_envs, *env.observation_space.shape), np.float32)

    def collect(self) -> tuple[Rollout, Ended]:
        """Steps all worlds through a rollout."""
        steps = self.ppo.rollout
        worlds = self.env.num_envs
        networks = self.networks
        space = cast("Any", self.env.action_space)
        observations = torch.empty(steps + 1, worlds, networks.critic[0].in_features)
        rewards, dones = torch.zeros(2, steps, worlds)
        outputs = []
        actions = []
        outcomes = []
        truncated = []
        final = [observations[0, :0]]  # so that `cat` works without any truncation
        with torch.no_grad():
            for t in range(steps):
                observations[t] = self._normalize(self.last)
                outputs.append(networks.actor.layers(observations[t]))
                actions.append(networks.draw(outputs[t], self.generator))
                env_actions = actions[t].numpy()
                if not networks.actor.discrete:
                    env_actions = np.clip(env_actions, space.low, space.high)
                self.last, reward, ended, infos = self.env.step(env_actions)
                rewards[t] = torch.from_numpy(reward)
                dones[t] = torch.from_numpy(ended)
                for n in np.flatnonzero(ended):
                    info = infos[n]
                    outcomes.append(
                        (info.get("is_success", False), info.get("collision", False))
                    )
                    if info["TimeLimit.truncated"]:
                        truncated.append(t * worlds + int(n))
                        last = info["terminal_observation"][None]
                        final.append(self._normalize(last))
            observations[steps] = self._normalize(self.last)
            all_actions = torch.stack(actions)
            log_probs = networks.log_probs(
                torch.cat(outputs), all_actions.flatten(0, 1)
            )
            rollout = Rollout(
                observations,
                all_actions,
                log_probs.view_as(rewards),
                rewards,
                dones,
                torch.tensor(truncated, dtype=torch.int64),
                torch.cat(final),
            )
            return rollout, outcomes

    def _normalize(self, observations: Singles) -> torch.Tensor:
        """Returns normalised observations (n, O) for the networks."""
        normalised: torch.Tensor = self.networks.actor.normaliser(
            torch.from_numpy(observations)
        )
        return normalised


class LeanPpo:
    """A training with PPO; `normaliser` is mean, deviation (O,). Raises: see `check_serves`."""

    def __init__(
        self,
        settings: TrainingSettings,
        env: TrainVecEnv,
        seed: int,
        normaliser: tuple[Array, Array],
    ) -> None:
        algorithms.check_serves(settings, env.envs[0])
        torch.set_num_threads(settings.threads)
        torch.manual_seed(seed)
        self._total = settings.steps
        self._ppo = settings.ppo
        hidden = settings.hidden
        spaces = env.observation_space, env.action_space
        actor = algorithms.Actor(*spaces, hidden, normaliser, torch.nn.ReLU)
        self.networks = Networks(actor, hidden, self._ppo.log_std)
        seeds = np.random.SeedSequence(seed).generate_state(2)
        self.collector = Collector(env, self.networks, self._ppo, int(seeds[0]))
        self.learner = Learner(self.networks, self._ppo, int(seeds[1]))
        self.policy = actor
        self._settings = settings
        self.steps = 0  # number of steps learnt from, over all worlds
        self._rollout: Rollout | None = None  # the next rollout to learn from
        self._successes: deque[bool] = deque(maxlen=RECENT)

    @one_blas_thread
    def learn(self, watch: Watch, logger: Logger) -> None:
        """Learns until all steps are done, or the watch ends the training."""
        watch.begin(self.steps)
        if self._rollout is None:
            self.collector.last = self.collector.env.reset()
            self._take(watch, *self.collector.collect())
        while self._rollout is not None:
            watch.keep(self.steps)
            if watch.ends(self.steps, algorithms.make_act(self.policy), logger):
                watch.report(self.steps, self._successes, logger)
                return
            loss = self._advance(self._rollout, watch)
            if watch.report(self.steps, self._successes, logger):
                logger.record("train/loss", loss)
                logger.dump(self.steps)

    def _advance(self, rollout: Rollout, watch: Watch) -> float:
        """Learns from a rollout while the next one is collected."""
        left = 1.0 - self.steps / self._total
        rate = self._ppo.learning_rate * max(left, algorithms.LEAST_RATE)
        self.steps += self._ppo.rollout * self.collector.env.num_envs
        self.collector.networks.load_state_dict(self.networks.state_dict())
        learner = self.learner
        jobs: list[Callable[[], Any]] = [
            lambda: learner.learn(learner.compute_transitions(rollout), rate)
        ]
        if self.steps < self._total:
            learner.core_is_free.clear()
            jobs.append(self._collect)
        else:
            learner.core_is_free.set()
        loss, *collected = run_parts(lambda job: job(), jobs)
        self._rollout = None
        for part in collected:
            self._take(watch, *part)
        return float(loss)

    def _collect(self) -> tuple[Rollout, Ended]:
        torch.set_num_threads(self._settings.threads)  # a per-thread setting
        try:
            return self.collector.collect()
        finally:
            self.learner.core_is_free.set()

    def _take(self, watch: Watch, rollout: Rollout, ended: Ended) -> None:
        self._rollout = rollout
        self._successes.extend(success for success, _ in ended)
        watch.collisions.extend(collision for _, collision in ended)

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""
        optimiser = self.learner.optimiser
        return {
            "weights": self.networks.state_dict(),
            "optimiser": {
                "steps": optimiser.steps,
                "mean": torch.from_numpy(optimiser.mean),
                "square": torch.from_numpy(optimiser.square),
            },
            "steps": self.steps,
            "recent": list(self._successes),
            "last": torch.from_numpy(self.collector.last),
            "rollout": self._rollout and self._rollout._asdict(),
            "random": [
                part.generator.get_state() for part in (self.collector, self.learner)
            ],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from the state of another training made with the same arguments."""
        self.networks.load_state_dict(state["weights"])
        optimiser = self.learner.optimiser
        optimiser.steps = state["optimiser"]["steps"]
        optimiser.mean[:] = state["optimiser"]["mean"]
        optimiser.square[:] = state["optimiser"]["square"]
        self.steps = state["steps"]
        rollout = state["rollout"]
        self._rollout = rollout and Rollout(**rollout)
        self._successes.extend(state["recent"])
        self.collector.last = state["last"].numpy()
        generators = self.collector.generator, self.learner.generator
        for generator, random in zip(generators, state["random"], strict=True):
            generator.set_state(random)
