"""Reads LEAPP bundles, ours and foreign: joins their networks, and derives their mapping."""

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import onnx
import safetensors.numpy
from pydantic import BaseModel, ConfigDict, Field
from safetensors import SafetensorError

from nics_drl_bridge.config import parse_yaml, read_text, validate
from nics_drl_bridge.errors import PolicyError, suggest
from nics_drl_bridge.extras.foreign_policies.leapp_export import (
    BEAMS,
    SECTORS,
    Data,
    restore_policy,
)
from nics_drl_bridge.extras.foreign_policies.mapping import ForeignState
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.file import onnx_graph, rehearsal

ZERO = "constant"  # quantity for components that a planar robot does not have
LINEAR = {"x": "velocity.forward", "y": "velocity.left", "z": ZERO}
ANGULAR = {"x": ZERO, "y": ZERO, "z": "velocity.turn"}
BOTH = {f"linear.{k}": v for k, v in LINEAR.items()}
BOTH |= {f"angular.{k}": v for k, v in ANGULAR.items()}
GOAL = {
    f"goal.{name}": f"goal.{name}"
    for name in ("distance", "bearing", "cosine", "sine", "x", "y")
}
INPUT_MEANINGS = {  # kind -> name of an element -> quantity; unnamed elements are in this order
    "state/body/linear_velocity": LINEAR,
    "state/body/angular_velocity": ANGULAR,
    "state/body/velocity": BOTH,
    "command/goal/polar": GOAL,
    "command/goal": GOAL,
    "command/body/pose": {"x": "goal.x", "y": "goal.y", "z": ZERO},
}
OUTPUT_MEANINGS = {  # the same for outputs
    "target/body/linear_velocity": LINEAR,
    "target/body/angular_velocity": ANGULAR,
    "target/body/velocity": BOTH,
}
MAPPING = "describe it in your own mapping (docs/foreign_policies.md)"


class Open(BaseModel):
    """Base of the entries of a bundle; unknown keys are allowed."""

    model_config = ConfigDict(extra="allow", frozen=True)


class Tensor(Open):
    """An input or output of a node."""

    name: str
    shape: Any = None
    kind: str | None = None
    element_names: Any = None

    @property
    def names(self) -> list[str]:
        """Names of the elements; empty if there are none."""
        names = self.element_names
        while isinstance(names, list) and names and isinstance(names[-1], list):
            names = names[-1]
        return [str(name) for name in names] if isinstance(names, list) else []


class Parameters(Open):
    """The network of a node."""

    model_path: str
    sha256sum: str
    backend: str


class Node(Open):
    """A network with its inputs and outputs."""

    inputs: list[Tensor]
    outputs: list[Tensor]
    parameters: Parameters


class Pipeline(Open):
    """Connections of nodes, as `node/output: [node/input]`, and the external inputs and outputs."""

    inputs: dict[str, list[str]]
    outputs: dict[str, list[str]]
    data_flow: dict[str, list[str]] = Field(default_factory=dict)
    feedback_flow: dict[str, list[str]] = Field(default_factory=dict)
    initial_values: str | None = None
    configs: dict[str, Any] = Field(default_factory=dict)


class Description(Open):
    """The YAML file of a bundle."""

    models: dict[str, Node] = Field(min_length=1)
    pipeline: Pipeline


class Bundle(NamedTuple):
    """A bundle as read; inputs and outputs are named with their node only if ambiguous."""

    path: Path  # the YAML file
    pipeline: Pipeline
    inputs: dict[str, Tensor]  # entries of the external inputs
    outputs: dict[str, Tensor]
    states: dict[str, ForeignState]  # that the bundle feeds back, by input
    network: Any  # all networks joined into one onnx.ModelProto
    sha256: str  # hash of all networks together
    ours: bytes | None  # the policy file exported as this bundle; None if it is foreign


def find_description(place: Path) -> Path | None:
    """Returns the YAML file of a bundle, given that file or its folder; None for other YAML files.

    Raises PolicyError unless a folder has exactly one, ConfigError if the file can't be read.
    """
    if place.is_file() and place.suffix not in (".yaml", ".yml"):
        reason = "is not a YAML file; give a LEAPP bundle, or the mapping of a foreign policy."
        raise PolicyError(str(place), "file", reason)
    files = sorted(place.glob("*.yaml")) if place.is_dir() else [place]
    descriptions = [
        file for file in files if "models" in parse_yaml(read_text(file), str(file))
    ]
    if place.is_dir() and len(descriptions) != 1:
        reason = f"contains {len(descriptions)} bundle descriptions; give the path of a YAML file."
        raise PolicyError(str(place), "file", reason)
    return descriptions[0] if descriptions else None


def _read_network(path: Path, parameters: Parameters, place: str) -> Any:
    """Reads and checks the network of a node, an onnx.ModelProto. Raises PolicyError."""
    if parameters.backend != "onnx":
        reason = (
            f"is {parameters.backend!r}, which is not supported; export it with 'onnx'."
        )
        raise PolicyError(str(path), f"{place}.backend", reason)
    data = _read_file(path, parameters.model_path, f"{place}.model_path")
    if hash_bytes(data) != parameters.sha256sum:
        reason = (
            f"does not match {parameters.model_path!r}, which was changed or damaged."
        )
        raise PolicyError(str(path), f"{place}.sha256sum", reason)
    file = str(path.parent / parameters.model_path)
    rehearsal.rehearse(data, file, runs=False)
    return onnx_graph.parse(data, file)


def read_bundle(path: Path) -> Bundle:
    """Reads a bundle and checks its networks. Raises ConfigError or PolicyError."""
    source = str(path)
    description = validate(parse_yaml(read_text(path), source), Description, source)
    pipeline = description.pipeline
    models = {
        name: _read_network(path, node.parameters, f"models.{name}.parameters")
        for name, node in description.models.items()
    }
    digests = [node.parameters.sha256sum for node in description.models.values()]
    names = _name_ends(pipeline)
    starts = {}
    if pipeline.initial_values is not None:
        starts = _read_starts(path, pipeline.initial_values)
    return Bundle(
        path,
        pipeline,
        _find_tensors(description, "inputs", names, source),
        _find_tensors(description, "outputs", names, source),
        {
            names[target]: ForeignState(next=names[out], start=starts.get(target, 0.0))
            for out, targets in pipeline.feedback_flow.items()
            for target in targets
        },
        _join(models, pipeline.data_flow, names, source),
        hash_bytes("".join(digests).encode()),
        restore_policy(next(iter(models.values()))) if len(models) == 1 else None,
    )


def _name_ends(pipeline: Pipeline) -> dict[str, str]:
    """Returns a name for each external or fed back `node/input` and `node/output`.

    It is without the node if it is unambiguous.
    """
    ends = set[str]()
    for names_by_node in (pipeline.inputs, pipeline.outputs):
        for node, names in names_by_node.items():
            ends.update(f"{node}/{name}" for name in names)
    for source, targets in pipeline.feedback_flow.items():
        ends.update((source, *targets))
    shorts = {end: end.partition("/")[2] for end in ends}
    counts = Counter(shorts.values())
    return {end: end if counts[short] > 1 else short for end, short in shorts.items()}


def _find_tensors(
    description: Description, side: str, names: dict[str, str], source: str
) -> dict[str, Tensor]:
    """Finds the entries of the external inputs or outputs, by their names in the network."""
    entries = {}
    for node, ends in getattr(description.pipeline, side).items():
        if node not in description.models:
            reason = f"names no node {node!r}; {suggest(node, description.models)}"
            raise PolicyError(source, f"pipeline.{side}", reason)
        tensors = {
            tensor.name: tensor for tensor in getattr(description.models[node], side)
        }
        for name in ends:
            if name not in tensors:
                reason = f"has no {name!r}; {suggest(name, tensors)}"
                raise PolicyError(source, f"pipeline.{side}.{node}", reason)
            entries[names[f"{node}/{name}"]] = tensors[name]
    return entries


def _read_file(path: Path, name: str, place: str) -> bytes:
    """Reads a file of a bundle, which must lie in the bundle's folder."""
    folder = path.parent.resolve()
    file = (folder / name).resolve()
    if not file.is_relative_to(folder):
        reason = f"{name!r} lies outside the bundle; not opened."
        raise PolicyError(str(path), place, reason)
    return onnx_graph.read_network(file, str(path), place)


def _read_starts(path: Path, name: str) -> dict[str, tuple[float, ...]]:
    """Reads the start of each state, flattened, by `node/input`, from a safetensors file."""
    place = "pipeline.initial_values"
    try:
        arrays = safetensors.numpy.load(_read_file(path, name, place))
    except (SafetensorError, KeyError, TypeError, ValueError):
        reason = f"{name!r} is not a valid safetensors file; export the bundle again."
        raise PolicyError(str(path), place, reason) from None
    return {
        key: tuple(array.astype(float).ravel().tolist())
        for key, array in arrays.items()
    }


def _join(
    models: dict[str, Any],
    flow: dict[str, list[str]],
    names: dict[str, str],
    source: str,
) -> Any:
    """Connects all networks, in order; their inputs and outputs get the names of the bundle."""
    joined, *others = (
        onnx.compose.add_prefix(model, f"{name}/") for name, model in models.items()
    )
    for model in others:
        inputs = {end.name for end in model.graph.input}
        pairs = [
            (out, end) for out, ends in flow.items() for end in ends if end in inputs
        ]
        outputs = [end.name for end in (*joined.graph.output, *model.graph.output)]
        try:
            joined = onnx.compose.merge_models(joined, model, pairs, outputs=outputs)
        except (ValueError, onnx.checker.ValidationError) as error:
            reason = f"the networks can't be connected ({onnx_graph.quote(error)})."
            raise PolicyError(source, "pipeline.data_flow", reason) from None
    for value in onnx_graph.list_inputs(joined):
        if value.name not in names:
            reason = f"no earlier node supplies {value.name!r}; connect it."
            raise PolicyError(source, "pipeline.data_flow", reason)
    _rename_ends(joined.graph, names)
    return joined


def _rename_ends(graph: Any, names: Mapping[str, str]) -> None:
    for value in (*graph.input, *graph.output):
        value.name = names.get(value.name, value.name)
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        node.output[:] = [names.get(name, name) for name in node.output]


# The mapping of a foreign bundle, as far as the bundle states it.


def derive_mapping(bundle: Bundle, model: SimulatorModel) -> Data:
    """Derives the `ForeignPolicy` mapping of a bundle from the kinds and names of its elements.

    Raises PolicyError for an input whose meaning is not stated.
    """
    frequency = bundle.pipeline.configs.get("frequency")
    period = None
    if isinstance(frequency, int | float) and frequency > 0:
        period = round(1.0 / frequency, 9)
    data: Data = {
        "kind": "foreign policy",
        "network": bundle.path.name,
        "control_period": period,
        "inputs": {},
        "outputs": {},
    }
    for name, entry in bundle.inputs.items():
        if name in bundle.states:
            continue
        data["inputs"][name] = {"parts": _derive_parts(bundle, name, entry, data)}
    for name, entry in bundle.outputs.items():
        _add_commands(data["outputs"], name, entry, model)
    outputs = data["outputs"].keys()
    commands = {command.name for command in model.robot.command}
    if not outputs >= {"forward", "turn"} and outputs != commands:
        kinds = ", ".join(
            f"{name!r} of kind {entry.kind!r}" for name, entry in bundle.outputs.items()
        )
        reason = f"{kinds}: none is marked as the robot's velocity; {MAPPING}."
        raise PolicyError(str(bundle.path), "pipeline.outputs", reason)
    return data


def _derive_parts(bundle: Bundle, name: str, entry: Tensor, data: Data) -> list[Data]:
    """Returns the parts of an input; for a scan, also sets the layout in `data`, the mapping."""
    kind = entry.kind or ""
    extra = entry.model_extra or {}
    if kind == BEAMS or (kind == SECTORS and isinstance(extra.get("scan"), dict)):
        data["scan"] = extra.get("scan")
        return [{"of": "scan", "divide": _find_scan_divisor(extra)}]
    size = math.prod(entry.shape) if isinstance(entry.shape, list) else 0
    meanings = INPUT_MEANINGS.get(kind, {})
    names = entry.names
    # A pose without names is ambiguous: it may include a heading.
    if not names and len(meanings) == size and "pose" not in kind:
        names = list(meanings)
    if not names or len(names) != size or not all(name in meanings for name in names):
        described = f"kind {entry.kind!r}"
        if names:
            described += f" with elements {names}"
        reason = (
            f"{described} is not a known scan, goal or velocity of a robot; {MAPPING}."
        )
        raise PolicyError(str(bundle.path), f"pipeline.inputs.{name}", reason)
    zero = {"of": ZERO, "value": 0.0}
    return [zero if meanings[n] == ZERO else {"of": meanings[n]} for n in names]


def _find_scan_divisor(extra: Data) -> float:
    """Returns the range that is 1 in a scan; 1 if the scan is in metres."""
    # "share" in bundles of earlier versions
    if not str(extra.get("unit", "")).startswith(("fraction", "share")):
        return 1.0
    layout = extra.get("scan")
    far = (extra.get("lidar") if layout is None else layout) or {}
    return float(far.get("range_max", 1.0))


def _add_commands(
    outputs: Data, name: str, entry: Tensor, model: SimulatorModel
) -> None:
    """Adds the commands among the elements of an output to a mapping's `outputs`."""
    meanings = OUTPUT_MEANINGS.get(entry.kind or "", {})
    size = math.prod(entry.shape or [0])
    names = entry.names or (list(meanings) if len(meanings) == size else [])
    commands = {command.name for command in model.robot.command}
    for index, element in enumerate(names):
        word = meanings.get(element, "").removeprefix("velocity.")
        if entry.kind == "target/command" and element in commands:
            outputs[element] = {"of": name, "index": index}
        elif word == "left" and not model.robot.moves_sideways:
            continue
        elif word and word != ZERO:
            outputs[word] = {"of": name, "index": index}
