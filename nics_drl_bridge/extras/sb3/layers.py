"""What the engines that learn with PyTorch share."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.train.normaliser import LIMIT, bend, find_shares


class NormaliserLayer(BaseFeaturesExtractor):
    """`Normaliser` as the first layer of actor and critic."""

    mean: torch.Tensor
    std: torch.Tensor
    shares: torch.Tensor  # (O,) 1 for observations from 0 to 1, else 0

    def __init__(self, space: gymnasium.spaces.Box, mean: Array, std: Array) -> None:
        super().__init__(space, features_dim=int(np.prod(space.shape)))
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("std", torch.as_tensor(std, dtype=torch.float32))
        self.register_buffer("shares", torch.as_tensor(find_shares(space)))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalises observations (n, O)."""
        normalised = (bend(observations, self.shares) - self.mean) / self.std
        return torch.clamp(normalised, -LIMIT, LIMIT)


def to_tensors(content: Any) -> Any:
    """Converts all arrays in nested dicts and lists to tensors."""
    if isinstance(content, np.ndarray):
        return torch.from_numpy(content)
    if isinstance(content, dict):
        return {name: to_tensors(part) for name, part in content.items()}
    if isinstance(content, list):
        return [to_tensors(part) for part in content]
    return content
