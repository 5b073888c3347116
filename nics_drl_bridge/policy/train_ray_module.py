"""The network that learns on Ray: an actor as the policy file holds it, and a critic."""

from __future__ import annotations

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule

from nics_drl_bridge.policy.train_actor import Actor, layers_of

Batch = dict[str, Any]


class ActorCritic(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """RLlib's form of `Actor` and a critic of the same widths.

    `model_config` holds `hidden`, `normaliser` and `log_std`, see `Actor` and `PpoSettings`.
    """

    def setup(self) -> None:
        """Makes the layers."""
        chosen, size = self.model_config, int(self.observation_space.shape[0])
        hidden, normaliser = list(chosen["hidden"]), chosen["normaliser"]
        self.actor = Actor(self.observation_space, self.action_space, hidden, normaliser)
        self.critic = layers_of([size, *hidden, 1], 1.0)
        if not self.actor.discrete:
            spread = torch.full(self.action_space.shape, float(chosen["log_std"]))
            self.log_std = torch.nn.Parameter(spread)

    def get_non_inference_attributes(self) -> list[str]:
        """What env runners need not have."""
        return ["critic"]

    def _forward(self, batch: Batch, **kwargs: Any) -> Batch:
        raw = self.actor(batch[Columns.OBS])
        if not self.actor.discrete:
            raw = torch.cat([raw, self.log_std.expand_as(raw)], dim=-1)
        return {Columns.ACTION_DIST_INPUTS: raw}

    def compute_values(self, batch: Batch, embeddings: Any = None) -> torch.Tensor:
        """Values (n,) of observations (n, O)."""
        values: torch.Tensor = self.critic(self.actor.normaliser(batch[Columns.OBS]))
        return values.squeeze(-1)
