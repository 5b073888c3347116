"""Networks of the lean engine as arrays: linear layers with ReLU in between.

Shapes: n observations, O elements of an observation, C outputs of the actor, W weights.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.policy.train.kernels import LOG_NORM
from nics_drl_bridge.policy.train.normaliser import Normaliser

# gains of the initial weights, as in Stable-Baselines3
HIDDEN_GAIN = 2.0**0.5
ACTION_GAIN = 0.01  # of an actor's last layer: all actions start near zero
VALUE_GAIN = 1.0  # of a critic's last layer


class Layer(NamedTuple):
    """A linear layer; both arrays are views of the network's weights."""

    matrix: Singles  # (outs, ins)
    bias: Singles  # (outs,)


class Network:
    """Linear layers with ReLU in between.

    Their weights (W,) are in one vector, layer after layer: the matrix (outs, ins), then the
    biases (outs,). `widths` is the number of inputs, then the number of outputs of each layer.
    """

    def __init__(self, weights: Singles, widths: Sequence[int]) -> None:
        self.weights = weights
        self.widths = tuple(widths)
        self.layers: list[Layer] = []
        begin = 0
        for ins, outs in itertools.pairwise(widths):
            middle = begin + ins * outs
            end = middle + outs
            matrix = weights[begin:middle].reshape(outs, ins)
            self.layers.append(Layer(matrix, weights[middle:end]))
            begin = end

    def __call__(self, rows: Singles) -> Singles:
        """Maps inputs (n, O) to outputs (n, C)."""
        *hidden, last = self.layers
        for layer in hidden:
            rows = np.maximum(rows @ layer.matrix.T + layer.bias, np.float32(0.0))
        outputs: Singles = rows @ last.matrix.T + last.bias
        return outputs

    def initialise(self, gain: float, rng: np.random.Generator) -> None:
        """Draws orthogonal matrices, the last one with `gain`; all biases become zero."""
        for layer in self.layers:
            is_last = layer is self.layers[-1]
            factor = gain if is_last else HIDDEN_GAIN
            layer.matrix[:] = factor * draw_orthogonal(layer.matrix.shape, rng)
            layer.bias[:] = 0.0


def count_weights(widths: Sequence[int]) -> int:
    """Returns the number of weights W of a network."""
    return sum((ins + 1) * outs for ins, outs in itertools.pairwise(widths))


def draw_orthogonal(shape: tuple[int, ...], rng: np.random.Generator) -> AnyArray:
    """Draws a matrix with orthonormal rows or columns (Saxe and others 2014)."""
    tall = (max(shape), min(shape))
    columns, triangle = np.linalg.qr(rng.standard_normal(tall))
    columns *= np.sign(np.diag(triangle))  # or the draws would not be uniform
    return columns if columns.shape == shape else columns.T


class Parts(NamedTuple):
    """Views of the parts of a vector (W,) of weights, or of their gradients."""

    actor: Singles
    critic: Singles
    log_std: Singles  # (C,) log deviation of continuous actions; empty if discrete


class ActorCritic:
    """Actor and critic on normalised observations, and the deviation of continuous actions.

    `weights` (W,) holds all of them, see `split`.
    """

    def __init__(
        self, inputs: int, outputs: int, hidden: Sequence[int], is_discrete: bool
    ) -> None:
        actor_widths = (inputs, *hidden, outputs)
        critic_widths = (inputs, *hidden, 1)
        self._sizes = (
            count_weights(actor_widths),
            count_weights(critic_widths),
            0 if is_discrete else outputs,
        )
        self.weights: Singles = np.zeros(sum(self._sizes), np.float32)
        parts = self.split(self.weights)
        self.actor = Network(parts.actor, actor_widths)
        self.critic = Network(parts.critic, critic_widths)
        self.log_std = parts.log_std
        self.is_discrete = is_discrete

    def split(self, vector: Singles) -> Parts:
        """Returns the parts of a vector (W,) that is laid out like `weights`."""
        return Parts(*np.split(vector, np.cumsum(self._sizes)[:-1]))

    def copy(self) -> ActorCritic:
        """Returns networks with the same, but independent weights."""
        inputs, *hidden, outputs = self.actor.widths
        other = ActorCritic(inputs, outputs, hidden, self.is_discrete)
        other.weights[:] = self.weights
        return other

    def draw(self, raw: Singles, rng: np.random.Generator) -> AnyArray:
        """Draws actions (n, C), or indices (n,), given the outputs (n, C) of the actor."""
        if not np.isfinite(raw).all():
            raise ValueError("the actor's outputs are not finite")
        if self.is_discrete:
            # the maximum of logits with Gumbel noise has their probabilities
            chosen: AnyArray = (raw + rng.gumbel(size=raw.shape)).argmax(axis=1)
            return chosen
        noise = rng.standard_normal(raw.shape, np.float32)
        return raw + np.exp(self.log_std) * noise

    def compute_log_probs(self, raw: Singles, actions: AnyArray) -> Singles:
        """Returns the log probability or log density (n,) of actions (n, C) or (n,)."""
        if self.is_discrete:
            shifted = raw - raw.max(axis=1, keepdims=True)
            log_sums = np.log(np.exp(shifted).sum(axis=1))
            chosen: Singles = shifted[np.arange(len(raw)), actions] - log_sums
            return chosen
        deviations = (actions - raw) * np.exp(-self.log_std)
        constant = (self.log_std + LOG_NORM).sum()
        densities: Singles = -0.5 * np.square(deviations).sum(axis=1) - constant
        return densities


@dataclass(frozen=True)
class Actor:
    """A trained policy without exploration noise, on observations as the task gives them."""

    normaliser: Normaliser
    network: Network
    is_discrete: bool

    def __call__(self, observations: Singles) -> Singles:
        """Maps observations (n, O) to raw actions (n, C), or to logits of discrete ones."""
        return self.network(self.normaliser(observations))

    def act(self, observations: Singles) -> AnyArray:
        """Returns the most likely actions (n, C), or (n,) if discrete."""
        raw = self(observations)
        return raw.argmax(axis=1) if self.is_discrete else raw
