"""Policy files as LEAPP bundles, Isaac's deployment format: a network and a YAML file.

Bundles are written without the package `leapp`, which is needed only to run them. The single node
has separate inputs for scan, goal and velocities, and outputs action and command; a state is fed
back.
"""

import base64
import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import safetensors.numpy
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.files import (
    hash_bytes,
    write_bytes,
    write_text,
    write_whole_folder,
)
from nics_drl_bridge.policy.file import onnx_graph
from nics_drl_bridge.policy.file.contract import Contract, StateEntry
from nics_drl_bridge.policy.file.policy_file import PolicyFile

NODE = "policy"
CONFIG_VERSION = "1.3"  # version of the format
SIGN = "system information:"  # in the YAML file of every bundle
OURS = "leapp/"  # prefix of the nodes and weights that an export adds
TAKEN = "nics_drl_bridge_observation"  # metadata key: the input that an export replaces
SECTORS = "state/lidar/sectors"
BEAMS = "state/lidar/beams"
Data = dict[str, Any]


class Piece(NamedTuple):
    """An input of a bundle, and its elements of the observation."""

    name: str
    width: int
    kept: tuple[int, ...]
    facts: Data

    @property
    def is_whole(self) -> bool:
        """True if the observation has all of its elements."""
        return len(self.kept) == self.width

    @property
    def row(self) -> str:
        """Name of its kept elements in the graph."""
        return self.name if self.is_whole else f"{OURS}{self.name}"


def export_bundle(policy: PolicyFile, folder: str | Path) -> Path:
    """Writes a policy file as a bundle; returns its YAML file. Errors: see `write_whole_folder`."""
    if policy.contract.foreign is not None:
        reason = "is a foreign policy, whose network alone is not enough to drive."
        raise PolicyError(str(policy.path), "foreign", reason)
    content = policy.path.read_bytes()
    place = Path(folder)
    marker = f"{place.resolve().name}.yaml"
    model = onnx.load_model_from_string(content)
    pieces = _list_pieces(policy)
    _split_observation(model, pieces)
    made = model.SerializeToString(deterministic=True)
    if restore_policy(model) != content:
        reason = "was not written by `export_policy`, so it could not be restored."
        raise PolicyError(str(policy.path), "file", reason)
    network = f"{NODE}.onnx"
    start_values = f"{place.resolve().name}_initial_values.safetensors"
    names = {marker, network, start_values}
    with write_whole_folder(place, marker, names.__contains__, SIGN) as temporary:
        write_bytes(temporary / network, made)
        state = policy.contract.state
        if state is not None:
            write_bytes(temporary / start_values, _serialize_start(state))
        write_text(
            temporary / marker, dump_yaml(_describe_bundle(policy, pieces, made, place))
        )
    return place / marker


def _serialize_start(state: StateEntry) -> bytes:
    start = np.full((1, state.size), state.start, np.float32)
    return bytes(safetensors.numpy.save({f"{NODE}/{onnx_graph.STATE_IN}": start}))


def _list_pieces(policy: PolicyFile) -> list[Piece]:
    """Returns the inputs of a bundle, in the order of the observation."""
    contract = policy.contract
    seen: Data = {"kind": BEAMS, "lidar": contract.lidar.model_dump(mode="json")}
    if contract.scan is not None:
        seen = {"kind": SECTORS, "scan": contract.scan.model_dump(mode="json")}
    seen["unit"] = "fraction of range_max; 1 free, 0 too close or unknown"
    scan = _make_whole_piece("scan", contract.observation.scan_parts, seen)
    low = contract.observation.rest_low
    high = contract.observation.rest_high
    if contract.task.name != "navigation":
        limits = [list(pair) for pair in zip(low, high, strict=True)]
        facts = {"kind": f"state/task/{contract.task.name}", "limits": limits}
        return [scan, _make_whole_piece("rest", len(low), facts)]
    sensors = [
        _make_whole_piece(
            sensor.name,
            sensor.parts,
            {"kind": f"state/{sensor.kind}", "sensor": sensor.model_dump(mode="json")},
        )
        for sensor in contract.sensors
    ]
    return [scan, *GOAL_AND_TWIST, *sensors]


def _make_whole_piece(name: str, width: int, facts: Data) -> Piece:
    """Returns an input whose elements are all in the observation."""
    return Piece(name, width, tuple(range(width)), facts)


def _make_piece(
    name: str, kind: str, kept: tuple[int, ...], elements: list[str], unit: str
) -> Piece:
    """Returns an input of three elements, of which the observation has those that are kept."""
    facts = {"kind": kind, "element_names": [elements], "unit": unit}
    return Piece(name, 3, kept, facts)


AXES = ["x", "y", "z"]
GOAL_AND_TWIST = (
    _make_piece(
        "goal",
        "command/goal/polar",
        (0, 1, 2),
        ["goal.distance", "goal.cosine", "goal.sine"],
        "m",
    ),
    _make_piece("linear_velocity", "state/body/linear_velocity", (0, 1), AXES, "m/s"),
    _make_piece("angular_velocity", "state/body/angular_velocity", (2,), AXES, "rad/s"),
)


def _split_observation(model: Any, pieces: Sequence[Piece]) -> None:
    """Replaces the observation input of a graph by separate inputs and a concatenation."""
    graph = model.graph
    observation, *others = graph.input
    model.metadata_props.add(
        key=TAKEN, value=base64.b64encode(observation.SerializeToString()).decode()
    )
    inputs = []
    nodes = []
    weights = []
    for piece in pieces:
        entry = onnx.ValueInfoProto()
        entry.CopyFrom(observation)
        entry.name = piece.name
        entry.type.tensor_type.shape.dim[1].dim_value = piece.width
        inputs.append(entry)
        if not piece.is_whole:
            places = f"{piece.row}_places"
            kept = np.array(piece.kept, np.int64)
            weights.append(onnx.numpy_helper.from_array(kept, places))
            ends = [piece.name, places], [piece.row]
            nodes.append(onnx.helper.make_node("Gather", *ends, axis=1))
    rows = [piece.row for piece in pieces]
    nodes.append(onnx.helper.make_node("Concat", rows, [onnx_graph.INPUT], axis=1))
    _replace_all(graph.input, [*inputs, *others])
    _replace_all(graph.node, [*nodes, *graph.node])
    _replace_all(graph.initializer, [*weights, *graph.initializer])


def _replace_all(entries: Any, new: list[Any]) -> None:
    """Replaces the entries of a repeated field."""
    del entries[:]
    entries.extend(new)


def restore_policy(model: Any) -> bytes | None:
    """Restores the exact policy file from an exported ModelProto; None if we did not export it.

    The seal in the file itself shows whether it is intact.
    """
    entries = [entry for entry in model.metadata_props if entry.key == TAKEN]
    if len(entries) != 1:
        return None
    observation = onnx.ValueInfoProto()
    try:
        observation.ParseFromString(base64.b64decode(entries[0].value))
    except (ValueError, DecodeError):
        return None
    ours = onnx.ModelProto()
    ours.CopyFrom(model)
    ours.metadata_props.remove(entries[0])
    graph = ours.graph
    joins = [k for k, node in enumerate(graph.node) if onnx_graph.INPUT in node.output]
    if joins:
        del graph.node[: joins[0] + 1]
    weights = [w for w in graph.initializer if not w.name.startswith(OURS)]
    states = [end for end in graph.input if end.name == onnx_graph.STATE_IN]
    _replace_all(graph.initializer, weights)
    _replace_all(graph.input, [observation, *states])
    return bytes(ours.SerializeToString(deterministic=True))


def _describe_bundle(
    policy: PolicyFile, pieces: Iterable[Piece], made: bytes, place: Path
) -> Data:
    contract = policy.contract
    inputs = [
        _describe_tensor(piece.name, [1, piece.width], **piece.facts)
        for piece in pieces
    ]
    outputs = _describe_outputs(contract)
    pipeline = _describe_pipeline(contract, pieces)
    state = contract.state
    if state is not None:
        pipeline["initial_values"] = (
            f"{place.resolve().name}_initial_values.safetensors"
        )
        inputs.append(_describe_tensor(onnx_graph.STATE_IN, [1, state.size]))
        outputs.append(_describe_tensor(onnx_graph.STATE_OUT, [1, state.size]))
    md5 = hashlib.md5(made, usedforsecurity=False).hexdigest()
    parameters = {
        "model_path": f"{NODE}.onnx",
        "md5sum": md5,
        "sha256sum": hash_bytes(made),
        "backend": "onnx",
    }
    node = {"inputs": inputs, "outputs": outputs, "parameters": parameters}
    system = {"leapp config version": CONFIG_VERSION, "made by": onnx_graph.KEY}
    return {"models": {NODE: node}, "pipeline": pipeline, "system information": system}


def _describe_pipeline(contract: Contract, pieces: Iterable[Piece]) -> Data:
    pipeline: Data = {
        "configs": {
            "frequency": 1.0 / contract.control_period,
            "control_period": contract.control_period,
            "robot": contract.robot.name,
            "task": contract.task.name,
        },
        "data_flow": {},
        "feedback_flow": {},
        "inputs": {NODE: [piece.name for piece in pieces]},
        "outputs": {NODE: [onnx_graph.ACTION, onnx_graph.COMMAND]},
    }
    if contract.state is not None:
        source = f"{NODE}/{onnx_graph.STATE_OUT}"
        target = f"{NODE}/{onnx_graph.STATE_IN}"
        pipeline["feedback_flow"] = {source: [target]}
        pipeline["configs"]["longest_gap"] = contract.state.longest_gap
    return pipeline


def _describe_outputs(contract: Contract) -> list[Data]:
    """Describes the action, and the resulting command in the robot's units."""
    commands = contract.robot.command
    limits = [[command.min, command.max] for command in commands]
    discrete = contract.actions == "discrete"
    size = len(commands)
    of_twist = all(command.is_twist for command in commands)
    names = [str(command.cmd_vel) if of_twist else command.name for command in commands]
    return [
        _describe_tensor(
            onnx_graph.ACTION,
            [1] if discrete else [1, size],
            dtype="int64" if discrete else "float32",
            kind="target/action",
            **({} if discrete else {"limits": [[-1.0, 1.0] for _ in commands]}),
        ),
        _describe_tensor(
            onnx_graph.COMMAND,
            [1, size],
            kind="target/body/velocity" if of_twist else "target/command",
            element_names=[names],
            units=[command.unit for command in commands],
            limits=limits,
        ),
    ]


def _describe_tensor(
    name: str, shape: list[int], dtype: str = "float32", **facts: Any
) -> Data:
    return {"name": name, "dtype": dtype, "shape": shape, "type": "tensor", **facts}
