"""Exports a trained network to a policy file: normaliser, network and commands in one graph."""

import io
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import extensions
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.file.contract import (
    GOLDEN,
    SUFFIX,
    Rows,
    draw_golden_observations,
    make_contract,
)

with extensions.require_modules("the export of a policy"):
    import onnx
    import torch

    from nics_drl_bridge.policy.file import onnx_graph, policy_file, rehearsal
    from nics_drl_bridge.policy.file.onnx_session import (
        check_network,
        open_session,
        run_in_turn,
        run_rows,
    )

Normaliser = tuple[ArrayLike, ArrayLike, float]
OPSET = 17


class Deployed(torch.nn.Module):  # type: ignore[misc]
    """Graph of a policy file, with the normaliser, clipping and scaling that SB3's recipe omits."""

    def __init__(
        self, actor: torch.nn.Module, task: Task, normaliser: Normaliser | None
    ) -> None:
        super().__init__()
        self.actor = actor
        self.discrete = task.actions == "discrete"
        self.limit = None if normaliser is None else float(normaliser[2])
        if normaliser is not None:
            self.register_buffer("mean", _make_vector(normaliser[0]))
            self.register_buffer("std", _make_vector(normaliser[1]))
        if self.discrete:
            self.register_buffer("commands", _make_vector(task.discrete_commands))
        else:
            self.register_buffer("low", _make_vector(task.command_limits[0]))
            self.register_buffer("high", _make_vector(task.command_limits[1]))

    @property
    def state(self) -> tuple[int, float] | None:
        """Size and start value of the actor's state; None without a state."""
        size = getattr(self.actor, "state_size", 0)
        start = getattr(self.actor, "state_start", 0.0)
        return (int(size), float(start)) if size else None

    def forward(
        self, observation: torch.Tensor, *state: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Maps observations (n, O) to actions (n, C) in [-1, 1] or (n,), and SI commands (n, C).

        An actor with a state also takes the state (n, S) and returns the next one.
        """
        seen = observation
        if self.limit is not None:
            seen = torch.clamp((seen - self.mean) / self.std, -self.limit, self.limit)
        raw, *following = self.actor(seen, *state) if state else (self.actor(seen),)
        if self.discrete:
            action = torch.argmax(raw, dim=1)
            return action, self.commands[action], *following
        action = torch.clamp(raw, -1.0, 1.0)
        command = self.low + (action + 1.0) / 2.0 * (self.high - self.low)
        return (
            action,
            torch.minimum(torch.maximum(command, self.low), self.high),
            *following,
        )


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


def export_policy(
    model: Any,
    task: Task,
    simulator_model: SimulatorModel,
    path: str | Path,
    normaliser: Normaliser | None = None,
    provenance: Mapping[str, Any] | None = None,
    max_episode_steps: int | None = None,
) -> policy_file.PolicyFile:
    """Exports a trained model as a policy file, and loads it as a robot does.

    The normaliser is mean (O,), deviation (O,) and limit, or None. Raises ConfigError if the model
    can't be exported, PolicyError if the file does not reproduce its outputs.
    """
    file = Path(path)
    if file.suffix != SUFFIX:
        raise ConfigError(
            f"{file}: a policy file's name ends with {SUFFIX!r}; change it."
        )
    deployed = Deployed(find_actor(model), task, normaliser)
    deployed.eval().cpu()
    graph = _export_graph(deployed, task)
    golden = _make_golden(deployed, graph, draw_golden_observations(task), str(file))
    text = make_contract(
        task,
        simulator_model,
        golden,
        onnx_graph.hash_graph(graph),
        provenance or {},
        deployed.state,
        max_episode_steps=max_episode_steps,
    )
    onnx.helper.set_model_props(graph, {onnx_graph.KEY: text})
    data = onnx_graph.add_seal(graph.SerializeToString(deterministic=True))
    check_network(
        data, str(file), runs=True
    )  # not in another process, because this one made the network
    rehearsal.remember(data)
    policy = policy_file.policy_of(data, file)
    write_bytes(file, data)
    return policy


def _make_golden(
    deployed: Deployed, graph: Any, seen: Rows, source: str
) -> dict[str, Rows]:
    session = open_session(graph.SerializeToString(), source)

    def compute(*tensors: Rows) -> list[Rows]:
        with torch.no_grad():
            return [part.numpy() for part in deployed(*map(torch.as_tensor, tensors))]

    start = None if deployed.state is None else np.full(*deployed.state, np.float32)
    out = run_in_turn(partial(run_rows, session, source), seen, start)
    wanted = run_in_turn(compute, seen, start)
    for name, ours, theirs in zip(("actions", "commands"), out, wanted, strict=True):
        error = float(np.abs(ours - theirs).max())
        if not error <= policy_file.GOLDEN_TOLERANCE:
            raise PolicyError(
                source,
                f"golden.{name}",
                f"onnxruntime and torch differ by {error:.3g}; the model can't be exported.",
            )
    action = np.asarray(out[0], np.float32).reshape(GOLDEN, -1)
    return {"observations": seen, "actions": action, "commands": out[1]}


def _export_graph(deployed: Deployed, task: Task) -> Any:
    inputs = [onnx_graph.INPUT]
    outputs = [onnx_graph.ACTION, onnx_graph.COMMAND]
    examples = [torch.zeros(1, task.observation_space.shape[0])]
    buffer = io.BytesIO()
    if deployed.state is not None:
        examples.append(torch.zeros(1, deployed.state[0]))
        inputs = [*inputs, onnx_graph.STATE_IN]
        outputs = [*outputs, onnx_graph.STATE_OUT]
    with warnings.catch_warnings():
        # This exporter is deprecated; the new one takes several times as long.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            deployed,
            tuple(examples),
            buffer,
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamic_axes={name: {0: "n"} for name in (*inputs, *outputs)},
            dynamo=False,
        )
    return onnx.load_model_from_string(buffer.getvalue())


def _make_vector(values: ArrayLike) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values, np.float32))
