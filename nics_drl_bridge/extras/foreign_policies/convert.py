"""Makes policy files of foreign policies: a network with a mapping, or a LEAPP bundle."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from nics_drl_bridge.config import parse_yaml, read_text, validate
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.extras.foreign_policies import leapp_import
from nics_drl_bridge.extras.foreign_policies.adapter import Adapter, measure_part
from nics_drl_bridge.extras.foreign_policies.mapping import ForeignPolicy
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.lidar.sectors import layout_of
from nics_drl_bridge.policy.file import onnx_graph, rehearsal
from nics_drl_bridge.policy.file.contract import (
    MAPPINGS,
    SUFFIX,
    Contract,
    draw_golden_observations,
    make_contract,
)
from nics_drl_bridge.policy.file.onnx_session import open_session, run_in_turn
from nics_drl_bridge.policy.file.policy_file import PERIOD_TOLERANCE, Run


@dataclass(frozen=True)
class ForeignNetwork:
    """A foreign network with its mapping, and the file that names them."""

    mapping: ForeignPolicy
    model: Any  # onnx.ModelProto
    path: Path
    sha256: str  # hash of the network's files


def adapt(contract: Contract, session: Any, source: str) -> Run:
    """Returns what runs the foreign network of a policy file. Raises PolicyError."""
    try:
        mapping = validate(contract.foreign or {}, ForeignPolicy, source)
    except ConfigError as error:
        raise PolicyError(source, f"foreign.{error.key}", error.reason) from None
    scan = contract.scan or contract.lidar
    parts = contract.observation.scan_parts
    adapter = Adapter(mapping, contract.robot, parts, scan.range_max, session, source)
    size = 0 if contract.state is None else contract.state.size
    if adapter.state_size != size:
        reason = f"is {size}, but the mapping needs {adapter.state_size}."
        raise PolicyError(source, "state.size", reason)
    return adapter.run


def import_policy(source: str | Path, model: SimulatorModel | None = None) -> bytes:
    """Converts a LEAPP bundle or a mapping to a policy file; restores our own exports exactly.

    `model` is the robot; None: the one that the mapping names. Raises ConfigError, or PolicyError,
    which says what can't be expressed.
    """
    path = leapp_import.find_description(Path(source))
    if path is None:
        return _convert(_read_mapping(Path(source)), model)
    bundle = leapp_import.read_bundle(path)
    ours = bundle.ours
    if ours is not None:
        return ours
    if model is None:
        raise ConfigError(
            f"{path}: a foreign bundle names no robot; name one with --robot."
        )
    data = leapp_import.derive_mapping(bundle, model)
    return _convert(_join(validate(data, ForeignPolicy, str(path)), bundle), model)


def _join(mapping: ForeignPolicy, bundle: leapp_import.Bundle) -> ForeignNetwork:
    """Adds the states of a bundle to a mapping, whose own entries take precedence."""
    states = {**bundle.states, **mapping.states}
    mapping = mapping.model_copy(update={"states": states})
    return ForeignNetwork(mapping, bundle.network, bundle.path, bundle.sha256)


def _read_mapping(path: Path) -> ForeignNetwork:
    data = parse_yaml(read_text(path), str(path))
    if data.get("kind") != "foreign policy":
        reason = "is not the mapping of a foreign policy (`kind: foreign policy`)"
        raise ConfigError(f"{path}: {reason}.")
    mapping = validate(data, ForeignPolicy, str(path))
    file = path.parent / mapping.network
    if file.is_dir() or file.suffix in MAPPINGS:
        description = leapp_import.find_description(file)
        if description is not None:
            return _join(mapping, leapp_import.read_bundle(description))
    if file.suffix != SUFFIX:
        needed = f"must be an {SUFFIX} file or a LEAPP bundle"
        raise PolicyError(str(path), "network", f"{needed}, not {mapping.network!r}.")
    content = onnx_graph.read_network(file, str(path), "network")
    rehearsal.rehearse(content, str(file), runs=False)
    network = onnx_graph.parse(content, str(file))
    return ForeignNetwork(mapping, network, path, hash_bytes(content))


def _convert(foreign: ForeignNetwork, model: SimulatorModel | None) -> bytes:
    """Returns a policy file: the network, and its mapping in the contract."""
    mapping = foreign.mapping
    source = str(foreign.path)
    if model is None:
        if mapping.robot is None:
            fix = "add `robot:`, or name one with --model or --robot."
            raise ConfigError(f"{source}: names no robot; {fix}")
        model = open_model(mapping.robot)
    period = model.control_period
    trained = mapping.control_period or period
    if abs(trained - period) > PERIOD_TOLERANCE:
        reason = f"is {trained:g} s, but the robot's is {period:g} s"
        fix = "use a model with that period."
        raise PolicyError(source, "control_period", f"{reason}; {fix}")
    task = _make_task(mapping, model, source)
    network = _fix_shapes(foreign.model, mapping, task.scan_parts)
    del network.metadata_props[:]
    content = network.SerializeToString(deterministic=True)
    rehearsal.rehearse(content, source)
    session = open_session(content, source)
    adapter = Adapter(
        mapping, task.robot, task.scan_parts, task.sight.range_max, session, source
    )
    size = adapter.state_size
    text = make_contract(
        task,
        model,
        _record_golden_pairs(adapter, task, source),
        onnx_graph.hash_graph(network),
        {"network": mapping.network, "network_sha256": foreign.sha256},
        (size, 0.0) if size else None,
        foreign=mapping.model_dump(mode="json"),
    )
    onnx.helper.set_model_props(network, {onnx_graph.KEY: text})
    content = onnx_graph.add_seal(network.SerializeToString(deterministic=True))
    rehearsal.remember(content)  # the same graph, with a contract
    return content


def _make_task(
    mapping: ForeignPolicy, model: SimulatorModel, source: str
) -> Navigation:
    """Returns the task with the scan that a network sees. Raises ConfigError."""
    try:
        scan = layout_of(mapping.scan, model.lidar)
        return Navigation(model.robot, model.lidar, scan=scan)
    except ConfigError as error:
        raise ConfigError(f"{source}: key 'scan': {error}") from None


def _record_golden_pairs(
    adapter: Adapter, task: Navigation, source: str
) -> dict[str, Any]:
    """Returns observations, and what the network makes of them. Raises PolicyError for NaN."""
    seen = draw_golden_observations(task)
    start = np.zeros(adapter.state_size, np.float32)
    action, command = run_in_turn(adapter.run, seen, start)
    if not (np.isfinite(action).all() and np.isfinite(command).all()):
        reason = (
            "returns NaN or inf for ordinary observations; check scaling and weights."
        )
        raise PolicyError(source, "network", reason)
    return {"observations": seen, "actions": action, "commands": command}


def _fix_shapes(model: Any, mapping: ForeignPolicy, scan_parts: int) -> Any:
    """Fixes the shapes to one observation: an open first dimension is 1, another fits the parts."""
    fixed = onnx.ModelProto()
    fixed.CopyFrom(model)
    outputs = {
        value.name: math.prod(
            size.dim_value or 1 for size in value.type.tensor_type.shape.dim
        )
        for value in model.graph.output
    }
    for value in onnx_graph.list_inputs(fixed):
        dimensions = list(value.type.tensor_type.shape.dim)
        if dimensions and not dimensions[0].dim_value:
            dimensions[0].dim_value = 1
        size = 1
        if value.name in mapping.inputs:
            parts = mapping.inputs[value.name].parts
            size = sum(measure_part(part, scan_parts, outputs) for part in parts)
        known = math.prod(d.dim_value for d in dimensions if d.dim_value)
        for dimension in dimensions:
            if not dimension.dim_value:
                dimension.dim_value = max(size // known, 1)
                known *= dimension.dim_value
    return fixed
