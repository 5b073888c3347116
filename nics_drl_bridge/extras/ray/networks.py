"""The actor of RLlib's learner, and its layers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch

from nics_drl_bridge.extras.sb3.layers import NormaliserLayer
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.lidar.arrays import AnyArray, Singles
from nics_drl_bridge.policy.train.networks import ACTION_GAIN, HIDDEN_GAIN


class TorchActor(torch.nn.Module):
    """Maps observations (n, O) to raw actions (n, C), or to logits (n, A) of discrete ones."""

    def __init__(
        self,
        observations: gymnasium.spaces.Box,
        actions: gymnasium.spaces.Box | gymnasium.spaces.Discrete,
        hidden: Sequence[int],
        normaliser: tuple[Array, Array],
    ) -> None:
        super().__init__()
        self.discrete = isinstance(actions, gymnasium.spaces.Discrete)
        count = gymnasium.spaces.flatdim(actions)
        self.normaliser = NormaliserLayer(observations, *normaliser)
        widths = [self.normaliser.features_dim, *hidden, count]
        self.layers = make_layers(widths, ACTION_GAIN)

    def forward(self, observations: torch.Tensor) -> Any:
        """Returns parameters of the action distribution: the mode if continuous, else logits."""
        return self.layers(self.normaliser(observations))

    def act(self, observations: Singles) -> AnyArray:
        """Returns the most likely actions (n, C), or (n,) if discrete."""
        with torch.no_grad():
            raw = self(torch.as_tensor(observations)).numpy()
        return np.asarray(raw.argmax(axis=1) if self.discrete else raw)


def make_layers(widths: Sequence[int], gain: float) -> torch.nn.Sequential:
    """Returns linear layers with tanh in between, initialised as in Stable-Baselines3.

    The last layer has the gain `gain`.
    """
    layers: list[torch.nn.Module] = []
    for ins, outs in itertools.pairwise(widths):
        layers += [torch.nn.Linear(ins, outs), torch.nn.Tanh()]
    del layers[-1]
    for layer in layers[::2]:
        torch.nn.init.orthogonal_(
            layer.weight, gain if layer is layers[-1] else HIDDEN_GAIN
        )
        torch.nn.init.zeros_(layer.bias)
    return torch.nn.Sequential(*layers)
