"""Memory and work that a policy's graph takes, determined before it runs.

Shapes come from onnx's strict inference on a copy without weights; the counting is done here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import onnx

from nics_drl_bridge.errors import PolicyError

MOST_NUMBERS = 1_000_000
"""Maximum output of all nodes together for one observation."""
MOST_WORK = 20_000_000
"""Maximum number of multiplications, or of numbers read and written, for one observation."""
MOST_AT_ONCE = 64 * MOST_NUMBERS
"""Maximum output of all nodes together in one run, so at most 256 MB of float32."""
ROWS = 16
"""Observations for which the sizes are computed, as many as there are golden ones."""
SMALL = 1024
"""Maximum length of an integer array that may be a shape, an axis or an index."""
GREATEST_SETTING = 65_536
"""Maximum size, stride, padding or dilation of a kernel."""
MOST_AXES = 256
"""Axes that all nodes together may add to their arrays; each makes inference longer."""
FLOATS = frozenset({onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.FLOAT16})
DIVIDING = frozenset({"Div", "ReduceMean"})
"""On integers, division by zero, or of the minimum by -1, ends the process."""
Shape = tuple[int, ...]
Cost = tuple[int, int]


def rows_at_once(model: Any, source: str) -> int:
    """Number of observations that a graph may be given in one run.

    Args:
        model: the ModelProto, with known operators only.
        source: the file's name.

    Raises:
        PolicyError: a size is unknown, or is more than any policy needs.
    """
    _check_settings(model.graph, source)
    _check_axes(model.graph, source)
    _check_whole_numbers(model, source)
    numbers, work = _costs(model, ROWS, source)
    if max(numbers / MOST_NUMBERS, work / MOST_WORK) > ROWS:
        reason = (
            f"needs {numbers / ROWS:.3g} numbers and {work / ROWS:.3g} multiplications for an "
            f"observation, where a policy has {MOST_NUMBERS:.0e} and {MOST_WORK:.0e}; not run."
        )
        raise PolicyError(source, "graph", reason)
    more_numbers, more_work = _costs(model, 2 * ROWS, source)
    if more_numbers > 2 * numbers or more_work > 2 * work:
        reason = "grows faster than the number of its observations; not run."
        raise PolicyError(source, "graph", reason)
    return max(1, ROWS * MOST_AT_ONCE // max(numbers, 1))


def _check_settings(graph: Any, source: str) -> None:
    for node in graph.node:
        for attribute in node.attribute:
            wide = any(abs(n) > GREATEST_SETTING for n in attribute.ints)
            if wide and node.op_type != "Slice":
                reason = f"of {node.op_type} is beyond {GREATEST_SETTING}; not run."
                raise PolicyError(source, f"graph.node.{attribute.name}", reason)


def _check_axes(graph: Any, source: str) -> None:
    """Refuses arrays of thousands of dimensions, for which inference itself takes too long."""
    lengths = {tensor.name: math.prod(tensor.dims) for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            given = (max(len(a.ints), math.prod(a.t.dims)) for a in node.attribute)
            lengths.update(dict.fromkeys(node.output, max(given, default=0)))
    added = 0
    for node in graph.node:
        if node.op_type in ("Reshape", "Unsqueeze"):
            told = [lengths.get(name, 1) for name in node.input[1:2]]
            added += max(told + [len(a.ints) for a in node.attribute], default=0)
    if added > MOST_AXES:
        reason = f"reshapes to {added} dimensions in all, a policy to {MOST_AXES}; not run."
        raise PolicyError(source, "graph.node", reason)


def _check_whole_numbers(model: Any, source: str) -> None:
    """Refuses integers that are divided, or that grow while shapes are inferred."""
    told = _inferred(_without_weights(model, ROWS), source, values=False)
    kinds = {tensor.name: tensor.data_type for tensor in told.initializer}
    sizes = {}
    for value in (*told.input, *told.value_info, *told.output):
        tensor = value.type.tensor_type
        kinds[value.name] = tensor.elem_type
        sizes[value.name] = math.prod(d.dim_value for d in tensor.shape.dim)
    for node in model.graph.node:
        if node.op_type in DIVIDING and kinds.get(node.input[0]) not in FLOATS:
            reason = f"{node.op_type} of whole numbers may end the process; use float32."
            raise PolicyError(source, "graph.node", reason)
        if node.op_type in ("Concat", "Gather") and kinds.get(node.output[0]) not in FLOATS:
            size = sizes.get(node.output[0], 0)
            if size > SMALL * ROWS:
                reason = f"{node.op_type} of {size} whole numbers is no shape and no index; not run"
                raise PolicyError(source, "graph.node", f"{reason}.")


def _costs(model: Any, rows: int, source: str) -> Cost:
    """Output and work of all nodes for `rows` observations."""
    shapes = _shapes(model, rows, source)
    numbers = work = 0
    for node in model.graph.node:
        given, made = _known(node.input, shapes), _known(node.output, shapes)
        if given is None or made is None:
            reason = f"the size of what {node.op_type} gives can't be told before it runs."
            raise PolicyError(source, "graph.node", reason)
        more = _buffer(node, given, made)
        numbers += sum(map(math.prod, made)) + more
        work += _work(node, given, made) + more
    return numbers, work


def _known(names: Any, shapes: Mapping[str, Shape]) -> list[Shape] | None:
    """Shapes of a node's tensors, except omitted ones; None if one is unknown."""
    found = [shapes.get(name) for name in names if name]
    return None if None in found else [shape for shape in found if shape is not None]


def _work(node: Any, given: list[Shape], made: list[Shape]) -> int:
    """Multiplications of a node, and numbers that it reads and writes."""
    moved = sum(map(math.prod, (*given, *made)))
    settings = {attribute.name: attribute for attribute in node.attribute}
    if node.op_type in ("MatMul", "Gemm"):
        turned = node.op_type == "Gemm" and "transA" in settings and settings["transA"].i
        return moved + math.prod(made[0]) * (given[0][0] if turned else given[0][-1])
    if node.op_type == "Conv":
        return moved + math.prod(made[0]) * math.prod(given[1][1:])
    if "kernel_shape" in settings:  # of a pool
        return moved + math.prod(made[0]) * int(math.prod(settings["kernel_shape"].ints))
    return moved


def _buffer(node: Any, given: list[Shape], made: list[Shape]) -> int:
    """Numbers that the runtime allocates for a convolution in addition to its output."""
    if node.op_type != "Conv":
        return 0
    groups = int(next((a.i for a in node.attribute if a.name == "group"), 1))
    return int(math.prod(made[0][2:]) * math.prod(given[1][1:]) * max(groups, 1))


def _shapes(model: Any, rows: int, source: str) -> dict[str, Shape]:
    """Shape of every tensor for `rows` observations; unknown ones are missing."""
    told = _inferred(_without_weights(model, rows), source, values=True)
    shapes = {tensor.name: tuple(tensor.dims) for tensor in told.initializer}
    for value in (*told.input, *told.value_info, *told.output):
        dims = value.type.tensor_type.shape.dim
        if value.type.tensor_type.HasField("shape") and all(d.HasField("dim_value") for d in dims):
            shapes[value.name] = tuple(d.dim_value for d in dims)
    return {name: shape for name, shape in shapes.items() if all(size >= 0 for size in shape)}


def _inferred(bare: Any, source: str, values: bool) -> Any:
    """A graph with inferred types and shapes; `values`: infers from integer values too."""
    try:
        return onnx.shape_inference.infer_shapes(bare, strict_mode=True, data_prop=values).graph
    except Exception as error:  # noqa: BLE001 - a damaged graph raises anything
        words = " ".join(str(error).split())[:120]
        raise PolicyError(source, "graph", f"its shapes do not fit ({words}).") from None


def _without_weights(model: Any, rows: int) -> Any:
    """The graph for `rows` observations, with weights and constants as inputs of their shape."""
    bare = onnx.ModelProto(ir_version=model.ir_version, opset_import=model.opset_import)
    graph = bare.graph
    graph.name = "sizes"
    for tensor in model.graph.initializer:
        _add_tensor(graph, tensor, tensor.name)
    for node in model.graph.node:
        tensor = next((a.t for a in node.attribute if a.name == "value"), None)
        if node.op_type == "Constant" and tensor is not None and len(node.output) == 1:
            _add_tensor(graph, tensor, node.output[0])
        else:
            graph.node.append(node)
    held = {tensor.name for tensor in model.graph.initializer}
    for value in (one for one in model.graph.input if one.name not in held):
        graph.input.append(value)
        graph.input[-1].type.tensor_type.shape.dim[0].dim_value = rows
    for value in model.graph.output:  # their shapes are to be inferred, not trusted
        kind = value.type.tensor_type.elem_type
        graph.output.append(onnx.helper.make_tensor_value_info(value.name, kind, None))
    return bare


def _add_tensor(graph: Any, tensor: Any, name: str) -> None:
    """Adds a small integer array, which may be a shape, as it is; of others only the shape."""
    small = math.prod(tensor.dims) <= SMALL
    if small and tensor.data_type in (onnx.TensorProto.INT64, onnx.TensorProto.INT32):
        graph.initializer.append(tensor)
        graph.initializer[-1].name = name
        return
    info = onnx.helper.make_tensor_value_info(name, tensor.data_type, list(tensor.dims))
    graph.input.append(info)
