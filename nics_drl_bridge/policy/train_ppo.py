"""Proximal policy optimisation (Schulman and others 2017) with the loss of Stable-Baselines3.

Networks of linear layers and ReLU, whose gradients are computed without autograd.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch.distributions import Categorical, Distribution, Independent, Normal

from nics_drl_bridge.policy.train_algorithms import Actor, layers_of
from nics_drl_bridge.policy.training_settings import PpoSettings

VALUE_WEIGHT, GRADIENT_LIMIT = 0.5, 0.5  # of the loss, and of the norm of its gradient
ADAM_EPSILON = 1e-5


class Rollout(NamedTuple):
    """R transitions, T steps of N worlds, step after step."""

    seen: torch.Tensor  # (R, O) normalised observations
    actions: torch.Tensor  # (R, C), or (R,) discrete
    log_probs: torch.Tensor  # (R,) of the actions when they were drawn
    advantages: torch.Tensor  # (R,)
    returns: torch.Tensor  # (R,) targets of the critic


class Layers:
    """Linear layers with ReLU in between, and their gradients without autograd.

    With arrays that are used again it takes half of autograd's time, for layers of 128 as of 64.
    """

    def __init__(self, layers: torch.nn.Sequential) -> None:
        self._linear: list[Any] = [one for one in layers if isinstance(one, torch.nn.Linear)]
        self._kept: list[torch.Tensor] = []
        self._rows: list[torch.Tensor] = []

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Outputs (n, C) for inputs (n, O), which hold until the next call."""
        if not self._kept or len(self._kept[0]) < len(rows):
            self._kept = [rows.new_empty(len(rows), one.out_features) for one in self._linear]
            self._back = [torch.empty_like(each) for each in self._kept[:-1]]
        self._rows = [rows]
        for layer, kept in zip(self._linear, self._kept, strict=True):
            out = kept[: len(rows)]
            torch.addmm(layer.bias, self._rows[-1], layer.weight.t(), out=out)
            if layer is not self._linear[-1]:
                out.relu_()
            self._rows.append(out)
        return self._rows[-1]

    def backward(self, gradient: torch.Tensor) -> None:
        """Writes the gradients of weights and biases, by that of the outputs (n, C)."""
        for k in range(len(self._linear) - 1, -1, -1):
            layer, rows = self._linear[k], self._rows[k]
            torch.mm(gradient.t(), rows, out=layer.weight.grad)
            torch.sum(gradient, 0, out=layer.bias.grad)
            if k:
                ahead = self._back[k - 1][: len(rows)]
                torch.mm(gradient, layer.weight, out=ahead)
                gradient = torch.ops.aten.threshold_backward.grad_input(
                    ahead, rows, 0.0, grad_input=ahead
                )


class Networks(torch.nn.Module):
    """Actor and critic of normalised observations, and the spread of continuous actions."""

    def __init__(self, actor: Actor, hidden: tuple[int, ...], log_std: float) -> None:
        super().__init__()
        self.actor = actor
        self.critic = layers_of([actor.normaliser.features_dim, *hidden, 1], 1.0, torch.nn.ReLU)
        outputs = actor.layers[-1].out_features
        self.log_std = torch.nn.Parameter(torch.full((0 if actor.discrete else outputs,), log_std))

    def distribution(self, raw: torch.Tensor) -> Distribution:
        """Distribution of the actions, by the outputs of the actor (n, C)."""
        if self.actor.discrete:
            return Categorical(logits=raw, validate_args=False)
        each = Normal(raw, self.log_std.exp(), validate_args=False)
        return Independent(each, 1, validate_args=False)


def flattened(networks: Networks) -> torch.nn.Parameter:
    """One vector of all weights, of which those of the networks become views; gradients likewise.

    An optimiser goes through one vector in a fifth of the time that it takes for many arrays.
    """
    every = list(networks.parameters())
    flat = torch.nn.Parameter(torch.nn.utils.parameters_to_vector(every).detach())
    flat.grad = torch.zeros_like(flat)
    sizes = [one.numel() for one in every]
    parts = zip(every, flat.detach().split(sizes), flat.grad.split(sizes), strict=True)
    for parameter, values, gradient in parts:
        parameter.data, parameter.grad = values.view_as(parameter), gradient.view_as(parameter)
    return flat


def drawn(distribution: Distribution, generator: torch.Generator) -> torch.Tensor:
    """Draws an action from each of the distributions."""
    if isinstance(distribution, Categorical):
        return torch.multinomial(distribution.probs, 1, generator=generator).squeeze(-1)
    return torch.normal(distribution.mean, distribution.stddev, generator=generator)


def advantages_of(
    rewards: torch.Tensor, values: torch.Tensor, done: torch.Tensor, discount: float, decay: float
) -> torch.Tensor:
    """Generalised advantage estimates (T, N) (Schulman and others 2016); `decay` is lambda.

    They follow from rewards (T, N), values (T + 1, N), and ends of episodes (T, N), which are 1.
    """
    going = 1.0 - done
    errors = rewards + discount * going * values[1:] - values[:-1]
    factors = discount * decay * going
    for t in range(len(errors) - 2, -1, -1):
        errors[t] += factors[t] * errors[t + 1]
    return errors


def loss_of(
    networks: Networks, raw: torch.Tensor, values: torch.Tensor, batch: Rollout, ppo: PpoSettings
) -> torch.Tensor:
    """The loss of PPO with clipped ratios, as in Stable-Baselines3.

    `raw` (n, C) are the outputs of the actor, `values` (n, 1) those of the critic.
    """
    gains = batch.advantages
    gains = (gains - gains.mean()) / (gains.std() + 1e-8)
    distribution = networks.distribution(raw)
    ratio = torch.exp(distribution.log_prob(batch.actions) - batch.log_probs)
    bounded = ratio.clamp(1.0 - ppo.clip, 1.0 + ppo.clip)
    policy = -torch.min(gains * ratio, gains * bounded).mean()
    value = torch.nn.functional.mse_loss(values.squeeze(-1), batch.returns)
    loss = policy + VALUE_WEIGHT * value
    return loss - ppo.entropy * distribution.entropy().mean() if ppo.entropy else loss


class Learner:
    """Moves the weights by gradients of the loss."""

    def __init__(self, networks: Networks, ppo: PpoSettings, seed: int) -> None:
        self.networks, self.ppo = networks, ppo
        self.generator = torch.Generator().manual_seed(seed)
        self._all = flattened(networks)
        self.optimiser = torch.optim.Adam([self._all], eps=ADAM_EPSILON, fused=True)
        self._parts = [Layers(layers) for layers in (networks.actor.layers, networks.critic)]

    def learn(self, rollout: Rollout, rate: float) -> float:
        """Learns from a rollout with a learning rate; returns the loss of the last batch."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        for _ in range(self.ppo.epochs):
            order = torch.randperm(len(rollout.seen), generator=self.generator)
            for rows in order.split(self.ppo.batch):
                loss = self.differentiate(Rollout(*(each[rows] for each in rollout)))
                torch.nn.utils.clip_grad_norm_(self._all, GRADIENT_LIMIT)
                self.optimiser.step()
        return float(loss)

    def differentiate(self, batch: Rollout) -> torch.Tensor:
        """Sets the gradients of all weights for a batch; returns the loss."""
        with torch.no_grad():
            outputs = [part.forward(batch.seen) for part in self._parts]
        raw, values = (each.detach().requires_grad_() for each in outputs)
        loss = loss_of(self.networks, raw, values, batch, self.ppo)
        wanted = raw, values, self.networks.log_std
        *gradients, spread = torch.autograd.grad(loss, wanted, materialize_grads=True)
        with torch.no_grad():
            self.networks.log_std.grad.copy_(spread)
            for part, gradient in zip(self._parts, gradients, strict=True):
                part.backward(gradient)
        return loss.detach()
