"""Networks of PyTorch as ONNX graphs."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
import onnx
import torch

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.file import onnx_graph
from nics_drl_bridge.policy.file.contract import Rows
from nics_drl_bridge.policy.train.network_graph import (
    OPSET,
    RAW,
    RawNetwork,
    Standardisation,
)


class Standardised(torch.nn.Module):
    """An actor behind a standardisation: mean (O,), deviation (O,) and limit, or None."""

    def __init__(
        self, actor: torch.nn.Module, standardisation: Standardisation | None
    ) -> None:
        super().__init__()
        self.actor = actor
        mean, std, limit = standardisation or (0.0, 1.0, 0.0)
        self.register_buffer("mean", torch.as_tensor(np.asarray(mean, np.float32)))
        self.register_buffer("std", torch.as_tensor(np.asarray(std, np.float32)))
        self.limit = float(limit)
        self.is_standardised = standardisation is not None

    @property
    def state(self) -> tuple[int, float] | None:
        """Size and start value of the actor's state; None without a state."""
        size = getattr(self.actor, "state_size", 0)
        start = getattr(self.actor, "state_start", 0.0)
        return (int(size), float(start)) if size else None

    def forward(self, observation: torch.Tensor, *state: torch.Tensor) -> Any:
        """Maps observations (n, O) to raw actions (n, C), or logits of discrete ones.

        An actor with a state also takes the state (n, S) and returns the next one.
        """
        seen = observation
        if self.is_standardised:
            seen = torch.clamp((seen - self.mean) / self.std, -self.limit, self.limit)
        return self.actor(seen, *state)


def make_raw_network(
    model: Any, inputs: int, standardisation: Standardisation | None
) -> RawNetwork:
    """Exports the actor of a model, see `find_actor`, on `inputs` observations."""
    module = Standardised(find_actor(model), standardisation).eval().cpu()

    def compute(*rows: Rows) -> list[Rows]:
        with torch.no_grad():
            outputs = module(*map(torch.as_tensor, rows))
        parts = outputs if module.state is not None else (outputs,)
        return [part.numpy() for part in parts]

    return RawNetwork(_export_graph(module, inputs), compute, module.state)


def find_actor(model: Any) -> torch.nn.Module:
    """Returns the actor of a PPO, A2C or SAC, or a module like `Actor`. Raises ConfigError.

    A module with a state takes it (n, S) after the observations, and also returns the next one. Its
    attribute `state_size` is S; `state_start` is the initial value of each element, 0 by default.
    """
    policy = getattr(model, "policy", model)
    if hasattr(policy, "action_net") and hasattr(policy, "mlp_extractor"):
        latent = policy.mlp_extractor.policy_net
        return torch.nn.Sequential(
            policy.pi_features_extractor, latent, policy.action_net
        )
    if hasattr(policy, "actor") and hasattr(policy.actor, "latent_pi"):
        actor = policy.actor  # the mode is the tanh of the mean
        parts = actor.features_extractor, actor.latent_pi, actor.mu, torch.nn.Tanh()
        return torch.nn.Sequential(*parts)
    if isinstance(policy, torch.nn.Module):
        return policy
    raise ConfigError(
        f"a {type(model).__name__} can't be exported; give a PPO, A2C or SAC, or a torch module."
    )


def _export_graph(module: Standardised, count: int) -> Any:
    inputs = [onnx_graph.INPUT]
    outputs = [RAW]
    examples = [torch.zeros(1, count)]
    if module.state is not None:
        examples.append(torch.zeros(1, module.state[0]))
        inputs.append(onnx_graph.STATE_IN)
        outputs.append(onnx_graph.STATE_OUT)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # This exporter is deprecated; the new one takes several times as long.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(examples),
            buffer,
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamic_axes={name: {0: "n"} for name in (*inputs, *outputs)},
            dynamo=False,
        )
    return onnx.load_model_from_string(buffer.getvalue())
