"""The lean engine: PPO that drives the worlds on one core while it learns on another.

The rollout that is learnt from is one update older than the weights. PPO's ratio accounts for that,
as a rollout holds the probabilities with which its actions were drawn. The two meet after each
rollout, so that the bits do not depend on which of them is faster.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from nics_drl_bridge.policy.train_algorithms import LEAST_RATE, RECENT, Actor, check_serves
from nics_drl_bridge.policy.train_checkpoint import Watch
from nics_drl_bridge.policy.train_ppo import Learner, Networks, Rollout, advantages_of, drawn
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import PpoSettings, TrainingSettings
from nics_drl_bridge.threads import run_parts

Array = NDArray[np.float64]
Ended = list[tuple[bool, bool]]  # success and collision of episodes


class Collector:
    """Drives the worlds with a copy of the networks."""

    def __init__(self, env: TrainVecEnv, networks: Networks, ppo: PpoSettings, seed: int) -> None:
        self.env, self.networks, self.ppo = env, copy.deepcopy(networks), ppo
        self.generator = torch.Generator().manual_seed(seed)
        self.last = np.zeros((env.num_envs, *env.observation_space.shape), np.float32)

    def collect(self) -> tuple[Rollout, Ended]:
        """Drives all worlds for the steps of a rollout."""
        with torch.no_grad():
            return self._collect()

    def _collect(self) -> tuple[Rollout, Ended]:
        steps, worlds, ppo = self.ppo.rollout, self.env.num_envs, self.ppo
        networks, see = self.networks, self.networks.actor.normaliser
        seen = torch.empty(steps + 1, worlds, self.last.shape[1])
        rewards, done, log_probs = torch.zeros(3, steps, worlds)
        actions, ended, cut, final = [], [], [], []
        for t in range(steps):
            seen[t] = see(torch.from_numpy(self.last))
            distribution = networks.distribution(networks.actor.layers(seen[t]))
            actions.append(drawn(distribution, self.generator))
            log_probs[t] = distribution.log_prob(actions[t])
            self.last, reward, over, infos = self.env.step(self._bounded(actions[t].numpy()))
            rewards[t], done[t] = torch.from_numpy(reward), torch.from_numpy(over)
            for n in np.flatnonzero(over):
                one = infos[n]
                ended.append((one.get("is_success", False), one.get("collision", False)))
                if one["TimeLimit.truncated"]:
                    cut.append(t * worlds + int(n))
                    final.append(one["terminal_observation"])
        seen[steps] = see(torch.from_numpy(self.last))
        values = networks.critic(seen).squeeze(-1)
        if cut:  # what would have come after the time limit
            after = networks.critic(see(torch.from_numpy(np.stack(final)))).squeeze(-1)
            rewards.view(-1)[cut] += ppo.discount * after
        gains = advantages_of(rewards, values, done, ppo.discount, ppo.gae_lambda)
        parts = seen[:-1], torch.stack(actions), log_probs, gains, gains + values[:-1]
        return Rollout(*(each.flatten(0, 1) for each in parts)), ended

    def _bounded(self, actions: NDArray[Any]) -> NDArray[Any]:
        space = self.env.action_space
        if isinstance(space, gymnasium.spaces.Box):
            return np.asarray(np.clip(actions, space.low, space.high))
        return actions


class LeanPpo:
    """A training with PPO; `normaliser` is mean and deviation (O,). See `check_serves`."""

    def __init__(
        self, settings: TrainingSettings, env: TrainVecEnv, seed: int,
        normaliser: tuple[Array, Array],
    ) -> None:  # fmt: skip
        check_serves(settings, env)
        torch.set_num_threads(settings.threads)
        torch.manual_seed(seed)
        self._total, self._ppo, hidden = settings.steps, settings.ppo, settings.hidden
        spaces = env.observation_space, env.action_space
        actor = Actor(*spaces, hidden, normaliser, torch.nn.ReLU)
        self.networks = Networks(actor, hidden, self._ppo.log_std)
        seeds = np.random.SeedSequence(seed).generate_state(2)
        self.collector = Collector(env, self.networks, self._ppo, int(seeds[0]))
        self.learner = Learner(self.networks, self._ppo, int(seeds[1]))
        self.policy = actor
        self.steps = 0  # of all worlds together, learnt from so far
        self._rollout: Rollout | None = None  # the next one to learn from
        self._successes: deque[bool] = deque(maxlen=RECENT)

    def learn(self, watch: Watch, logger: Logger) -> None:
        """Learns until all steps are done."""
        watch.begin(self.steps)
        if self._rollout is None:
            self.collector.last = self.collector.env.reset()
            self._take(watch, *self.collector.collect())
        while self._rollout:
            watch.keep(self.steps)
            loss = self._advance(self._rollout, watch)
            if watch.report(self.steps, self._successes, logger):
                logger.record("train/loss", loss)
                logger.dump(self.steps)

    def _advance(self, rollout: Rollout, watch: Watch) -> float:
        """Learns from a rollout, with the next one collected meanwhile."""
        rate = self._ppo.learning_rate * max(1.0 - self.steps / self._total, LEAST_RATE)
        learn = partial(self.learner.learn, rollout, rate)
        self.steps += len(rollout.seen)
        self.collector.networks.load_state_dict(self.networks.state_dict())
        jobs: list[Callable[[], Any]] = [learn, self.collector.collect]
        loss, *collected = run_parts(lambda job: job(), jobs[: 1 + (self.steps < self._total)])
        self._rollout = None
        for one in collected:
            self._take(watch, *one)
        return float(loss)

    def _take(self, watch: Watch, rollout: Rollout, ended: Ended) -> None:
        self._rollout = rollout
        self._successes.extend(success for success, _ in ended)
        watch.collisions.extend(collision for _, collision in ended)

    def state(self) -> dict[str, Any]:
        """All that changes, for a checkpoint."""
        return {
            "weights": self.networks.state_dict(),
            "optimiser": self.learner.optimiser.state_dict(),
            "steps": self.steps,
            "recent": list(self._successes),
            "last": torch.from_numpy(self.collector.last),
            "rollout": self._rollout and self._rollout._asdict(),
            "random": [part.generator.get_state() for part in (self.collector, self.learner)],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues with the state of another, made with the same arguments."""
        self.networks.load_state_dict(state["weights"])
        self.learner.optimiser.load_state_dict(state["optimiser"])
        self.steps, rollout = state["steps"], state["rollout"]
        self._rollout = rollout and Rollout(**rollout)
        self._successes.extend(state["recent"])
        self.collector.last = state["last"].numpy()
        generators = self.collector.generator, self.learner.generator
        for generator, random in zip(generators, state["random"], strict=True):
            generator.set_state(random)
