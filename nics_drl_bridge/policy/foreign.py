"""Foreign policies: turns a network with a mapping, or a LEAPP bundle, into a policy file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from nics_drl_bridge.config import parse_yaml, read_text, validate
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.sectors import layout_of
from nics_drl_bridge.policy import leapp_bundle, onnx_graph, policy_file, rehearsal
from nics_drl_bridge.policy.contract import (
    MAPPINGS,
    SUFFIX,
    Rows,
    contract_of,
    golden_observations,
)
from nics_drl_bridge.policy.foreign_graph import Composer, Network
from nics_drl_bridge.policy.foreign_mapping import ForeignPolicy
from nics_drl_bridge.policy.onnx_session import GraphNeeds, open_session, run_session


@dataclass(frozen=True)
class Order:
    """A foreign policy: its mapping, its network, and the file that names them."""

    mapping: ForeignPolicy
    network: Network
    path: Path
    sha256: str  # hash of the network's files


def load_any(
    path: str | Path, model: SimulatorModel | None = None
) -> policy_file.PolicyFile:
    """Loads a policy file, see `load_policy`, or builds one from a foreign policy's YAML file.

    `model` is the robot to drive; None uses the robot that the mapping names. Raises ConfigError
    for a wrong mapping, PolicyError for a network that does not fit it.
    """
    if str(path).endswith(MAPPINGS):
        return policy_file.policy_of(
            _content(_ordered(Path(path), model), model), Path(path)
        )
    return policy_file.load_policy(path)


def import_policy(source: str | Path, model: SimulatorModel | None = None) -> bytes:
    """Converts a LEAPP bundle or a mapping to a policy file; restores our own exports exactly.

    Raises ConfigError, or PolicyError, which says what can't be expressed.
    """
    path = leapp_bundle.description_of(Path(source))
    if path is None:
        return _content(_ordered(Path(source), model), model)
    bundle = leapp_bundle.read_bundle(path)
    ours = bundle.ours
    if ours is not None:
        return ours
    if model is None:
        raise ConfigError(
            f"{path}: a foreign bundle names no robot; name one with --robot."
        )
    mapping = validate(leapp_bundle.mapping_of(bundle, model), ForeignPolicy, str(path))
    return _content(Order(mapping, bundle.network, path, bundle.sha256), model)


def _ordered(path: Path, model: SimulatorModel | None) -> Order:
    data = parse_yaml(read_text(path), str(path))
    if data.get("kind") != "foreign policy":
        reason = "is not the mapping of a foreign policy (`kind: foreign policy`)"
        raise ConfigError(f"{path}: {reason}.")
    mapping = validate(data, ForeignPolicy, str(path))
    file = path.parent / mapping.network
    if file.is_dir() or file.suffix in MAPPINGS:
        description = leapp_bundle.description_of(file)
        if description is not None:
            made = leapp_bundle.read_bundle(description)
            return Order(mapping, made.network, path, made.sha256)
    if file.suffix != SUFFIX:
        needed = f"must be an {SUFFIX} file or a LEAPP bundle"
        raise PolicyError(str(path), "network", f"{needed}, not {mapping.network!r}.")
    content = onnx_graph.read_network(file, str(path), "network")
    rehearsal.rehearse("network", content, str(file))
    network = onnx_graph.parsed(content, str(file))
    onnx_graph.check_graph(network, str(file))
    return Order(mapping, Network(network), path, hash_bytes(content))


def _content(order: Order, model: SimulatorModel | None) -> bytes:
    mapping = order.mapping
    source = str(order.path)
    if model is None:
        if mapping.robot is None:
            fix = "add `robot:`, or name one with --model or --robot."
            raise ConfigError(f"{source}: names no robot; {fix}")
        model = open_model(mapping.robot)
    period = model.control_period
    if abs((mapping.control_period or period) - period) > policy_file.PERIOD_TOLERANCE:
        reason = f"is {mapping.control_period:g} s, but the robot's is {period:g} s"
        raise PolicyError(
            source, "control_period", f"{reason}; use a model with that period."
        )
    try:
        task = Navigation(
            model.robot, model.lidar, scan=layout_of(mapping.scan, model.lidar)
        )
    except ConfigError as error:
        raise ConfigError(f"{source}: key 'scan': {error}") from None
    graph, size = Composer(order.network, mapping, task, source).compose()
    state = (size, 0.0) if size else None
    commands = len(model.robot.command)
    digest = onnx_graph.graph_hash(graph)
    size_of_observation = task.observation_space.shape[0]
    needs = GraphNeeds(size_of_observation, commands, False, 1, digest, state)
    golden = _golden(graph, golden_observations(task), needs, source)
    provenance = {"network": mapping.network, "network_sha256": order.sha256}
    text = contract_of(task, model, golden, digest, provenance, state, batch=1)
    onnx.helper.set_model_props(graph, {onnx_graph.KEY: text})
    content = onnx_graph.sealed(graph.SerializeToString(deterministic=True))
    rehearsal.remember(content)  # the same graph, with a contract
    return content


def _golden(graph: Any, seen: Rows, needs: GraphNeeds, source: str) -> dict[str, Rows]:
    content = graph.SerializeToString()
    # The composed graph is as untrusted as the network in it.
    rehearsal.rehearse_policy(content, needs, seen, source)
    onnx_graph.check_shapes(graph, source, needs.most_rows)
    action, command = run_session(open_session(content, source), needs, seen, source)
    if not (np.isfinite(action).all() and np.isfinite(command).all()):
        reason = (
            "returns NaN or inf for ordinary observations; check scaling and weights."
        )
        raise PolicyError(source, "network", reason)
    return {"observations": seen, "actions": action, "commands": command}
