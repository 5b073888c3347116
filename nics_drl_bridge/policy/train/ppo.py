"""The lean engine: PPO that collects on one core while it learns on another.

Proximal policy optimisation (Schulman and others 2017) with the loss of
Stable-Baselines3. The data are collected with weights that are one update old. PPO's
ratio accounts for this, because it uses the probabilities at the time of drawing.
Collecting and learning synchronise after each rollout, so results do not depend on
which of them is faster. If collecting finishes first, actor and critic learn on one
core each for the rest of the update.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.policy.train.learner import Learner, Rollout
from nics_drl_bridge.policy.train.networks import (
    ACTION_GAIN,
    VALUE_GAIN,
    Actor,
    ActorCritic,
)
from nics_drl_bridge.policy.train.normaliser import Normaliser
from nics_drl_bridge.policy.train.progress import RECENT, TrainingLog, Watch
from nics_drl_bridge.policy.train.settings import LEAST_RATE, TrainingSettings
from nics_drl_bridge.policy.train.worlds import COLLISION, SUCCESS, TrainingWorlds
from nics_drl_bridge.threads import one_blas_thread, run_parts

Ended = list[tuple[bool, bool]]  # (success, collision) of ended episodes


class Collector:
    """Steps the worlds with a copy of the networks."""

    def __init__(
        self,
        worlds: TrainingWorlds,
        networks: ActorCritic,
        normaliser: Normaliser,
        steps: int,
        rng: np.random.Generator,
    ) -> None:
        self.worlds = worlds
        self.networks = networks.copy()
        self.normaliser = normaliser
        self.steps = steps
        self.rng = rng
        shape = (worlds.num_envs, *worlds.observation_space.shape)
        self.last_observations: Singles = np.zeros(shape, np.float32)

    def collect(self) -> tuple[Rollout, Ended]:
        """Steps all worlds through a rollout."""
        count = self.worlds.num_envs
        space = self.worlds.action_space
        networks = self.networks
        observations = np.empty(
            (self.steps + 1, *self.last_observations.shape), np.float32
        )
        rewards = np.zeros((self.steps, count), np.float32)
        ended = np.zeros((self.steps, count), np.float32)
        actions = []
        log_probs = []
        outcomes: Ended = []
        truncated = [np.zeros(0, np.int64)]
        final = [self.last_observations[:0]]
        for t in range(self.steps):
            observations[t] = self.normaliser(self.last_observations)
            raw = networks.actor(observations[t])
            chosen = networks.draw(raw, self.rng)
            actions.append(chosen)
            log_probs.append(networks.compute_log_probs(raw, chosen))
            if isinstance(space, gymnasium.spaces.Box):
                chosen = np.clip(chosen, space.low, space.high)
            step = self.worlds.step(chosen)
            self.last_observations = step.observations
            rewards[t] = step.rewards
            ended[t] = step.ended
            endings = step.endings
            flags = endings.get_flag(SUCCESS), endings.get_flag(COLLISION)
            outcomes += zip(*(flag.tolist() for flag in flags), strict=True)
            cut = endings.truncated
            truncated.append(t * count + endings.worlds[cut])
            final.append(self.normaliser(endings.observations[cut]))
        observations[self.steps] = self.normaliser(self.last_observations)
        rollout = Rollout(
            observations,
            np.stack(actions),
            np.stack(log_probs),
            rewards,
            ended,
            np.concatenate(truncated),
            np.concatenate(final),
        )
        return rollout, outcomes


class LeanPpo:
    """A training with PPO; `statistics` are mean and deviation (O,)."""

    def __init__(
        self,
        settings: TrainingSettings,
        worlds: TrainingWorlds,
        seed: int,
        statistics: tuple[Array, Array],
    ) -> None:
        self._total = settings.steps
        self._ppo = settings.ppo
        networks = ActorCritic(
            gymnasium.spaces.flatdim(worlds.observation_space),
            gymnasium.spaces.flatdim(worlds.action_space),
            settings.hidden,
            isinstance(worlds.action_space, gymnasium.spaces.Discrete),
        )
        parts = np.random.SeedSequence(seed).spawn(3)
        initial, collecting, learning = map(np.random.default_rng, parts)
        networks.actor.initialise(ACTION_GAIN, initial)
        networks.critic.initialise(VALUE_GAIN, initial)
        networks.log_std[:] = self._ppo.log_std
        self.networks = networks
        normaliser = Normaliser.of(worlds.observation_space, *statistics)
        self.algorithm = Actor(normaliser, networks.actor, networks.is_discrete)
        self.act = self.algorithm.act
        self.collector = Collector(
            worlds, networks, normaliser, self._ppo.rollout, collecting
        )
        self.learner = Learner(networks, self._ppo, learning)
        self.steps = 0  # number of steps learnt from, over all worlds
        self._rollout: Rollout | None = None  # the next rollout to learn from
        self._successes: deque[bool] = deque(maxlen=RECENT)

    @property
    def greatest_weight(self) -> float:
        """Largest magnitude of a weight; NaN if one is not a number."""
        return float(np.abs(self.networks.weights).max())

    @one_blas_thread
    def learn(self, watch: Watch, log: TrainingLog) -> None:
        """Learns until all steps are done, or the watch ends the training."""
        watch.begin(self.steps)
        if self._rollout is None:
            self.collector.last_observations = self.collector.worlds.reset()
            self._store_rollout(watch, *self.collector.collect())
        while self._rollout is not None:
            watch.keep(self.steps)
            if watch.ends(self.steps, self.act, log):
                watch.report(self.steps, self._successes, log)
                log.dump(self.steps)
                return
            loss = self._advance(self._rollout, watch)
            if watch.report(self.steps, self._successes, log):
                log.record("train/loss", loss)
                log.dump(self.steps)

    def _advance(self, rollout: Rollout, watch: Watch) -> float:
        """Learns from a rollout while the next one is collected."""
        left = 1.0 - self.steps / self._total
        rate = self._ppo.learning_rate * max(left, LEAST_RATE)
        self.steps += self._ppo.rollout * self.collector.worlds.num_envs
        self.collector.networks.weights[:] = self.networks.weights
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
            self._store_rollout(watch, *part)
        return float(loss)

    def _collect(self) -> tuple[Rollout, Ended]:
        try:
            return self.collector.collect()
        finally:
            self.learner.core_is_free.set()

    def _store_rollout(self, watch: Watch, rollout: Rollout, ended: Ended) -> None:
        self._rollout = rollout
        self._successes.extend(success for success, _ in ended)
        watch.collisions.extend(collision for _, collision in ended)

    def state(self) -> dict[str, Any]:
        """Returns everything that changes, for a checkpoint."""
        optimiser = self.learner.optimiser
        normaliser = self.algorithm.normaliser
        return {
            "weights": self.networks.weights,
            "optimiser": {
                "steps": optimiser.steps,
                "mean": optimiser.mean,
                "square": optimiser.square,
            },
            "normaliser": {"mean": normaliser.mean, "std": normaliser.std},
            "steps": self.steps,
            "recent": list(self._successes),
            "last": self.collector.last_observations,
            "rollout": self._rollout and self._rollout._asdict(),
            "random": [
                part.rng.bit_generator.state for part in (self.collector, self.learner)
            ],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from the state of another training made with the same arguments."""
        _restore_array(self.networks.weights, state["weights"])
        optimiser = self.learner.optimiser
        optimiser.steps = state["optimiser"]["steps"]
        _restore_array(optimiser.mean, state["optimiser"]["mean"])
        _restore_array(optimiser.square, state["optimiser"]["square"])
        normaliser = self.algorithm.normaliser
        _restore_array(normaliser.mean, state["normaliser"]["mean"])
        _restore_array(normaliser.std, state["normaliser"]["std"])
        self.steps = state["steps"]
        rollout = state["rollout"]
        if rollout:
            self._check_actions(rollout["actions"])
        self._rollout = rollout and Rollout(**rollout)
        self._successes.extend(state["recent"])
        _restore_array(self.collector.last_observations, state["last"])
        collecting, learning = state["random"]
        self.collector.rng.bit_generator.state = collecting
        self.learner.rng.bit_generator.state = learning

    def _check_actions(self, actions: AnyArray) -> None:
        """Raises ValueError unless saved actions have the shape and the indices of this training.

        The compiled gradients index memory by them without a check.
        """
        count = self.networks.actor.widths[-1]
        shape: tuple[int, ...] = (self.collector.steps, self.collector.worlds.num_envs)
        if not self.networks.is_discrete:
            shape = (*shape, count)
        if actions.shape != shape:
            raise ValueError(f"the actions are of shape {actions.shape}, not {shape}")
        is_index = (actions >= 0) & (actions < count)
        if self.networks.is_discrete and not is_index.all():
            raise ValueError(f"the index of an action is not from 0 to {count - 1}")


def _restore_array(target: AnyArray, saved: AnyArray) -> None:
    """Copies a saved array. Raises ValueError unless it has the target's type and shape."""
    if saved.dtype != target.dtype or saved.shape != target.shape:
        raise ValueError(f"an array is {saved.dtype} of shape {saved.shape}")
    target[:] = saved
