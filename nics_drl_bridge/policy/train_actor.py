"""The part of a network that acts, as a module of its own: normaliser and hidden layers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from nics_drl_bridge.policy.train_normaliser import Normaliser

Array = NDArray[np.float64]
GAIN = 2.0**0.5
ACTION_GAIN = 0.01
"""Of the last layer of an actor at the start: all its actions are near zero."""


class Actor(torch.nn.Module):
    """From observations (n, O) to raw actions (n, C), or to logits (n, A) of discrete ones.

    Args:
        observations: space of one observation, Box (O,).
        actions: space of one action.
        hidden: widths of the hidden layers.
        normaliser: mean and standard deviation (O,) of the observations.
    """

    def __init__(
        self,
        observations: gymnasium.spaces.Box,
        actions: gymnasium.spaces.Box | gymnasium.spaces.Discrete,
        hidden: Sequence[int],
        normaliser: tuple[Array, Array],
    ) -> None:
        super().__init__()
        if isinstance(actions, gymnasium.spaces.Discrete):
            self.discrete, count = True, int(actions.n)
        else:
            self.discrete, count = False, int(np.prod(actions.shape))
        self.normaliser = Normaliser(observations, *normaliser)
        self.layers = layers_of([self.normaliser.features_dim, *hidden, count], ACTION_GAIN)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """What the distribution of actions is made of; its mode, where they are continuous."""
        raw: torch.Tensor = self.layers(self.normaliser(observations))
        return raw

    def best(self, observations: torch.Tensor) -> torch.Tensor:
        """The most likely actions (n, C), or (n,) discrete."""
        raw = self(observations)
        return raw.argmax(dim=1) if self.discrete else raw


def layers_of(widths: Sequence[int], gain: float) -> torch.nn.Sequential:
    """Linear layers with tanh between them, orthogonal at the start, as Stable-Baselines3 has them.

    Args:
        widths: of input, hidden layers and output.
        gain: of the last layer.
    """
    layers: list[torch.nn.Module] = []
    for ins, outs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(ins, outs), torch.nn.Tanh()]
    del layers[-1]
    for layer in layers[::2]:
        torch.nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else GAIN)
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(*layers)
