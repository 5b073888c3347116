"""Learning of the lean engine: advantages and gradient steps from a rollout."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.lidar.arrays import AnyArray, Integers, Singles
from nics_drl_bridge.policy.train import kernels
from nics_drl_bridge.policy.train.adam import Adam
from nics_drl_bridge.policy.train.kernels import Net, Transitions
from nics_drl_bridge.policy.train.networks import ActorCritic, Network
from nics_drl_bridge.policy.train.settings import PpoSettings
from nics_drl_bridge.threads import run_parts

VALUE_WEIGHT = 0.5  # of the value loss


class Rollout(NamedTuple):
    """A rollout as collected: T steps of N worlds."""

    observations: Singles  # (T + 1, N, O) normalised observations
    actions: AnyArray  # (T, N, C), or (T, N) discrete
    log_probs: Singles  # (T, N) of the actions when they were drawn
    rewards: Singles  # (T, N)
    ended: Singles  # (T, N) 1 at ends of episodes
    truncated: Integers  # (K,) indices t N + n of the truncated episodes
    final_observations: Singles  # (K, O) the last ones of these episodes


def make_net(network: Network, gradients: Singles, rows: int) -> Net:
    """Returns a network for the kernels, with its gradients (W,) and memory for `rows`."""
    widths = np.array(network.widths)
    size = rows * max(network.widths)
    layer_outputs = np.empty((len(widths) - 1, size), np.float32)
    output_gradients = np.empty((2, size), np.float32)
    return Net(network.weights, gradients, widths, layer_outputs, output_gradients)


def estimate_advantages(
    rewards: Singles, values: Singles, ended: Singles, discount: float, decay: float
) -> Singles:
    """Returns generalised advantage estimates (T, N) (Schulman and others 2016).

    Inputs are rewards (T, N), values (T + 1, N), and `ended` (T, N), which is 1 at the ends of
    episodes; `decay` is lambda.
    """
    going = 1.0 - ended
    errors = rewards + discount * going * values[1:] - values[:-1]
    factors = discount * decay * going
    for t in range(len(errors) - 2, -1, -1):
        errors[t] += factors[t] * errors[t + 1]
    return errors


class Learner:
    """Updates the weights by gradients of the loss."""

    def __init__(
        self, networks: ActorCritic, ppo: PpoSettings, rng: np.random.Generator
    ) -> None:
        self.networks = networks
        self.ppo = ppo
        self.rng = rng
        self.optimiser = Adam(networks.weights, np.zeros_like(networks.weights))
        gradients = networks.split(self.optimiser.gradients)
        self.log_std_gradient = gradients.log_std
        self._actor = make_net(networks.actor, gradients.actor, ppo.batch)
        self._critic = make_net(networks.critic, gradients.critic, ppo.batch)
        self.core_is_free = threading.Event()  # set when the collecting thread is done

    def compute_transitions(self, rollout: Rollout) -> Transitions:
        """Computes advantages and returns of a rollout, with the current critic."""
        critic = self.networks.critic
        ppo = self.ppo
        width = rollout.observations.shape[-1]
        rows = rollout.observations.reshape(-1, width)
        values = critic(rows).reshape(rollout.observations.shape[:-1])
        rewards = rollout.rewards.copy()
        # Bootstrap where a time limit truncated the episode.
        final_values = critic(rollout.final_observations)[:, 0]
        rewards.reshape(-1)[rollout.truncated] += (
            np.float32(ppo.discount) * final_values
        )
        advantages = estimate_advantages(
            rewards, values, rollout.ended, ppo.discount, ppo.gae_lambda
        )
        count = advantages.size
        return Transitions(
            rows[:count],
            rollout.actions.reshape(count, -1).astype(np.float32),
            rollout.log_probs.reshape(count),
            advantages.reshape(count).astype(np.float32),
            (advantages + values[:-1]).reshape(count).astype(np.float32),
        )

    def learn(self, transitions: Transitions, rate: float) -> float:
        """Takes a gradient step on each batch; returns the loss of the last one."""
        count = len(transitions.observations)
        for _ in range(self.ppo.epochs):
            order = self.rng.permutation(count)
            for begin in range(0, count, self.ppo.batch):  # the last may be smaller
                rows = order[begin : begin + self.ppo.batch]
                # `take` releases the interpreter lock for the collecting thread
                batch = [field.take(rows, axis=0) for field in transitions]
                loss = self.compute_gradients(Transitions(*batch))
                self.optimiser.step(rate)
        return loss

    def compute_gradients(self, batch: Transitions) -> float:
        """Sets the gradients of all weights for a batch; returns the loss."""
        jobs: list[Callable[[], Any]] = [
            partial(
                kernels.compute_actor_gradients,
                self._actor,
                batch,
                self.networks.log_std,
                self.log_std_gradient,
                np.float32(self.ppo.clip),
                np.float32(self.ppo.entropy),
            ),
            partial(
                kernels.compute_critic_gradients,
                self._critic,
                batch,
                np.float32(VALUE_WEIGHT),
            ),
        ]
        if self.core_is_free.is_set():
            losses = run_parts(lambda job: job(), jobs)
        else:
            losses = [job() for job in jobs]
        return float(sum(losses))


def warm_up() -> None:
    """Compiles the kernels of all learners."""
    networks = ActorCritic(inputs=2, outputs=1, hidden=(2,), is_discrete=False)
    learner = Learner(networks, PpoSettings(), np.random.default_rng(0))
    rows = np.ones((3, 2), np.float32)
    column = rows[:, :1].copy()
    values = column[:, 0].copy()
    learner.compute_gradients(Transitions(rows, column, values, values, values))
