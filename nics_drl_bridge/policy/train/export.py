"""Exports a trained network to a policy file: normaliser, network and commands in one graph."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

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
from nics_drl_bridge.policy.train.networks import Actor

with extensions.require_modules("the export of a policy"):
    import onnx

    from nics_drl_bridge.policy.file import onnx_graph, policy_file, rehearsal
    from nics_drl_bridge.policy.file.onnx_session import (
        check_network,
        open_session,
        run_in_turn,
        run_rows,
    )
    from nics_drl_bridge.policy.train import network_graph
    from nics_drl_bridge.policy.train.network_graph import RawNetwork, Standardisation


def export_policy(
    model: Any,
    task: Task,
    simulator_model: SimulatorModel,
    path: str | Path,
    normaliser: Standardisation | None = None,
    provenance: Mapping[str, Any] | None = None,
    max_episode_steps: int | None = None,
) -> policy_file.PolicyFile:
    """Exports a trained model as a policy file, and loads it as a robot does.

    The model is the `Actor` of a training here, or a PPO, A2C or SAC of Stable-Baselines3, or a
    torch module, see `extras.sb3.export.find_actor`; these may have a normaliser: mean (O,),
    deviation (O,) and limit. Raises ConfigError if the model can't be exported, PolicyError if the
    file does not reproduce its outputs.
    """
    file = Path(path)
    if file.suffix != SUFFIX:
        raise ConfigError(
            f"{file}: a policy file's name ends with {SUFFIX!r}; change it."
        )
    network = _make_raw_network(model, task, normaliser)
    graph = network.onnx_model
    network_graph.add_commands(graph, task)
    golden = _make_golden(network, task, str(file))
    text = make_contract(
        task,
        simulator_model,
        golden,
        onnx_graph.hash_graph(graph),
        provenance or {},
        network.state,
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


def _make_raw_network(
    model: Any, task: Task, normaliser: Standardisation | None
) -> RawNetwork:
    if isinstance(model, Actor):
        if normaliser is not None:
            raise ConfigError(
                "the actor of a training has a normaliser of its own; leave `normaliser` out."
            )
        return network_graph.make_raw_network(model)
    adapter = extensions.load("adapters", "torch")
    inputs = task.observation_space.shape[0]
    return cast(RawNetwork, adapter.make_raw_network(model, inputs, normaliser))


def _make_golden(network: RawNetwork, task: Task, source: str) -> dict[str, Rows]:
    """Returns golden pairs of the graph. Raises PolicyError if the network's own differ."""
    seen = draw_golden_observations(task)
    session = open_session(network.onnx_model.SerializeToString(), source)
    state = network.state
    start = None if state is None else np.full(*state, np.float32)

    def compute(*rows: Rows) -> list[Any]:
        raw, *states = network.compute(*rows)
        return [*network_graph.compute_commands(raw, task), *states]

    out = run_in_turn(partial(run_rows, session, source), seen, start)
    wanted = run_in_turn(compute, seen, start)
    for name, ours, theirs in zip(("actions", "commands"), out, wanted, strict=True):
        error = float(np.abs(ours - theirs).max())
        if not error <= policy_file.GOLDEN_TOLERANCE:
            raise PolicyError(
                source,
                f"golden.{name}",
                f"onnxruntime and the network differ by {error:.3g}; the model can't be exported.",
            )
    action = np.asarray(out[0], np.float32).reshape(GOLDEN, -1)
    return {"observations": seen, "actions": action, "commands": out[1]}
