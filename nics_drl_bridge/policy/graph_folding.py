"""Folds what a foreign network computes from its own array shapes into constants."""

import math
from typing import Any

import numpy as np
from onnx import ValueInfoProto, defs, helper, numpy_helper
from onnx.reference import ReferenceEvaluator
from onnx.shape_inference import infer_node_outputs

from nics_drl_bridge.policy.onnx_graph import INTEGERS

# maximum length of an integer array that may be a shape, an axis or an index
SMALL = 1024
Shape = tuple[int, ...]
FOLDED = (
    "Add",
    "Cast",
    "Concat",
    "Constant",
    "Div",
    "Gather",
    "Identity",
    "Mul",
    "Reshape",
    "Slice",
    "Squeeze",
    "Sub",
    "Unsqueeze",
)
"""Operators on sizes; their cost is bounded by their inputs and outputs, which are small here."""


def fold_shapes(graph: Any, opset: int) -> dict[str, Shape]:
    """Folds known small integers; returns the outputs' shapes, with 0 for unknown sizes."""
    weights = {weight.name: weight for weight in graph.initializer}
    nodes = list(graph.node)
    imports = [helper.make_opsetid("", opset)]
    types = {end.name: end.type for end in graph.input}
    for weight in graph.initializer:
        types[weight.name] = helper.make_tensor_type_proto(
            weight.data_type, weight.dims
        )
    constants = {
        name: weight for name, weight in weights.items() if _is_small(types[name])
    }
    del graph.node[:], graph.initializer[:]
    for node in nodes:
        node.ClearField("domain")  # "" and "ai.onnx" are the same domain
        schema = defs.get_schema(node.op_type, opset)
        input_types = {name: types[name] for name in node.input if name}
        types |= infer_node_outputs(
            schema, node, input_types, constants, opset_imports=imports
        )
        value = _value(node, types, constants, opset)
        if value is None:
            graph.node.append(node)
        else:
            constants[value.name] = value
    used = {end.name for end in graph.output}.union(
        *(node.input for node in graph.node)
    )
    graph.initializer.extend(
        constant for name, constant in (weights | constants).items() if name in used
    )
    return {end.name: _shape(types[end.name]) for end in graph.output}


def _shape(kind: Any) -> Shape:
    tensor = kind.tensor_type
    if tensor.HasField("shape"):
        return tuple(d.dim_value for d in tensor.shape.dim)
    return (0,)


def _is_small(kind: Any) -> bool:
    return (
        kind.tensor_type.elem_type in INTEGERS and 0 < math.prod(_shape(kind)) <= SMALL
    )


def _value(
    node: Any, types: dict[str, Any], constants: dict[str, Any], opset: int
) -> Any:
    """Returns the value, or None if it is not small or is unknown before the network runs."""
    name = node.output[0]
    if node.op_type == "Shape":
        shape = _shape(types[node.input[0]])
        if all(shape):
            ends = {setting.name: setting.i for setting in node.attribute}
            sizes = np.array(shape[ends.get("start", 0) : ends.get("end")], np.int64)
            return numpy_helper.from_array(sizes, name)
    inputs = [constants.get(input_name) for input_name in node.input if input_name]
    if node.op_type not in FOLDED or None in inputs or not _is_small(types[name]):
        return None
    if node.op_type == "Div" and any(
        numpy_helper.to_array(tensor).min() <= 0 for tensor in inputs
    ):
        # Division by zero, or signs for which ONNX and numpy round differently.
        return None
    graph = helper.make_graph([node], "", [], [ValueInfoProto(name=name)], inputs)
    (value,) = ReferenceEvaluator(graph, opsets={"": opset}).run(None, {})
    return numpy_helper.from_array(np.asarray(value), name)
