"""Checks a policy file's graph before any of it runs: size, form, operators, amount of work."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from onnx import TensorProto

from nics_drl_bridge.errors import PolicyError, shorten
from nics_drl_bridge.files import hash_bytes

KEY = "nics_drl_bridge"  # key of the metadata entry with the contract
SEAL = "sha256"  # key of the metadata entry at the file's end: the checksum of everything before it
SIZE_LIMIT = 32 * 2**20
# maximum number of fields in all messages; each weight array counts as one
MOST_PARTS = 50_000
MOST_NESTED = 16  # maximum nesting of messages; an exported graph needs six levels
# maximum size of packed integers in one field, such as a shape [bytes]
MOST_PACKED = 2**20
MOST_NODES = 1000  # maximum number of nodes; an exported network has a few dozen
MOST_DIMENSIONS = 8  # maximum number of dimensions of an array of weights
# maximum size of the contract [bytes], mostly golden observations
CONTRACT_LIMIT = 4 * 2**20
MOST_NUMBERS = 1_000_000  # maximum size of all nodes' outputs for one observation
# maximum number of multiplications, or of numbers read and written, per observation
MOST_WORK = 20_000_000
# maximum size of all nodes' outputs in one run: 256 MB of float32
MOST_AT_ONCE = 64 * MOST_NUMBERS
# number of observations for which sizes are computed; equals the number of golden ones
ROWS = 16
# maximum length of an integer array that may be a shape, an axis or an index
SMALL = 1024
GREATEST_SETTING = 65_536  # maximum size, stride, padding or dilation of a kernel
# maximum number of axes that all nodes together may add; each slows inference
MOST_AXES = 256
INPUT = "observation"
ACTION = "action"
COMMAND = "command"
# additional input and output of a policy with a state
STATE_IN = "state_in"
STATE_OUT = "state_out"
# recurrent operators over sequences whose length the graph fixes
RECURRENT = frozenset({"GRU", "LSTM", "RNN"})
OPERATORS = RECURRENT | frozenset(
    {
        "Abs",
        "Add",
        "ArgMax",
        "Atan",
        "AveragePool",
        "BatchNormalization",
        "Cast",
        "Clip",
        "Concat",
        "Constant",
        "Conv",
        "Cos",
        "Div",
        "Elu",
        "Erf",
        "Exp",
        "Flatten",
        "Gather",
        "Gelu",
        "Gemm",
        "GlobalAveragePool",
        "HardSigmoid",
        "HardSwish",
        "Identity",
        "LayerNormalization",
        "LeakyRelu",
        "Log",
        "LogSoftmax",
        "MatMul",
        "Max",
        "MaxPool",
        "Min",
        "Mish",
        "Mul",
        "Neg",
        "Pow",
        "PRelu",
        "ReduceMax",
        "ReduceMean",
        "ReduceMin",
        "ReduceSum",
        "Reciprocal",
        "Relu",
        "Reshape",
        "Selu",
        "Shape",
        "Sigmoid",
        "Sign",
        "Sin",
        "Slice",
        "Softmax",
        "Softplus",
        "Softsign",
        "Split",
        "Sqrt",
        "Squeeze",
        "Sub",
        "Tanh",
        "Transpose",
        "Unsqueeze",
    }
)
"""Operators of networks: no loops, branches, random numbers or data-dependent sizes."""
FLOATS = frozenset({TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.FLOAT16})
INTEGERS = frozenset({TensorProto.INT64, TensorProto.INT32})
# types whose size in memory equals their size in the file
NUMBERS = FLOATS | INTEGERS | {TensorProto.BOOL}
# For integers, division by zero, or of the minimum by -1, crashes the process.
DIVIDING = frozenset({"Div", "ReduceMean"})
OTHER_FORMATS = (
    (b"PK", "a zip archive, written by Stable-Baselines3 and torch"),
    (b"\x80", "a pickle"),
    (b"\x93NUMPY", "a numpy array"),
    (b"\x89HDF", "an HDF5 file"),
    (b"\x1f\x8b", "a gzip file"),
)
"""First bytes of training frameworks' files, which are never opened here."""
# protobuf wire types
_VARINT = 0
_BYTES = 2
_FIXED = {1: 8, 5: 4}  # fixed-size wire types and their sizes [bytes]
_LONGEST_VARINT = 10
Shape = tuple[int, ...]
Fault = tuple[str, str]  # faulty field and the reason


def parse(data: bytes, source: str) -> Any:
    """Parses and checks a policy file's ModelProto. Raises PolicyError if it must not be run."""
    model = parsed(data, source)
    metadata(model, source)
    check_graph(model, source)
    return model


def parsed(data: bytes, source: str) -> Any:
    """Parses any ModelProto and checks only its form. Raises PolicyError."""
    _check_form(data, source)
    try:
        model = onnx.load_model_from_string(data)
        if not model.HasField("graph"):
            raise ValueError
    except (DecodeError, ValueError, TypeError):
        raise _no_policy(source, "is not an ONNX model, or is truncated") from None
    return model


def _check_form(data: bytes, source: str) -> None:
    """Raises PolicyError for another format, or for bytes that fail `check_wire`."""
    for start, kind in OTHER_FORMATS:
        if data.startswith(start):
            reason = f"is {kind}, which is not a policy; export the policy with `export_policy`."
            raise PolicyError(source, "file", reason)
    try:
        check_wire(data)
    except WireError as error:
        raise _no_policy(source, str(error)) from None


def _no_policy(source: str, what: str) -> PolicyError:
    return PolicyError(source, "file", f"{what}; export or copy it again.")


def metadata_in(data: bytes, source: str) -> str:
    """Returns the text of the contract in a file, without parsing the rest. Raises PolicyError."""
    _check_form(data, source)
    bare = onnx.ModelProto()
    field = onnx.ModelProto.DESCRIPTOR.fields_by_name["metadata_props"]
    view = memoryview(data)
    start = 0
    has_graph = False
    while start < len(data):
        key, start = _varint(view, start, len(data))
        size, start = _size_of(view, start, len(data), key & 7)
        number = key >> 3
        end = start + size
        if key & 7 == _BYTES and number == field.number:
            try:
                bare.metadata_props.add().ParseFromString(bytes(view[start:end]))
            except DecodeError:
                raise _no_policy(
                    source, "is not an ONNX model, or is truncated"
                ) from None
        has_graph |= number == onnx.ModelProto.GRAPH_FIELD_NUMBER
        start = end
    if not has_graph:
        raise _no_policy(source, "is not an ONNX model, or is truncated")
    return metadata(bare, source)


def metadata(model: Any, source: str) -> str:
    """Returns the text of the contract. Raises PolicyError unless the model has exactly one."""
    contracts = [entry.value for entry in model.metadata_props if entry.key == KEY]
    if len(contracts) != 1:
        reason = f"has {len(contracts)} contracts; only files of `export_policy` are policies."
        raise PolicyError(source, "metadata", reason)
    if len(contracts[0]) > CONTRACT_LIMIT:
        reason = (
            f"has {len(contracts[0])} characters, more than {CONTRACT_LIMIT}; not read."
        )
        raise PolicyError(source, "metadata", reason)
    return str(contracts[0])


def graph_hash(model: Any) -> str:
    """Returns the SHA-256 of a model without its metadata."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.metadata_props[:]
    return hash_bytes(bare.SerializeToString(deterministic=True))


def sealed(data: bytes) -> bytes:
    """Appends a model's checksum as a metadata entry; serialised messages may be concatenated."""
    end = onnx.ModelProto()
    entry = end.metadata_props.add()
    entry.key, entry.value = SEAL, hash_bytes(data)
    return data + bytes(end.SerializeToString(deterministic=True))


def check_seal(data: bytes, source: str) -> None:
    """Raises PolicyError unless a file is bit-identical to the one that was written."""
    size = len(sealed(b""))
    if data != sealed(data[:-size]):
        reason = "does not match the file, which was changed or damaged; copy or export it again."
        raise PolicyError(source, SEAL, reason)


class WireError(ValueError):
    """Bytes that are not a message, or whose message would be too large once parsed."""


def check_wire(data: bytes) -> None:
    """Raises WireError unless the bytes are a ModelProto with few fields and little nesting."""
    view = memoryview(data)
    parts = 0
    ahead: list[tuple[int, int, Any, int]] = [
        (0, len(data), onnx.ModelProto.DESCRIPTOR, 1)
    ]
    while ahead:
        start, end, kind, depth = ahead.pop()
        if depth > MOST_NESTED:
            raise WireError(f"is nested more than {MOST_NESTED} levels deep")
        while start < end:
            parts += 1
            if parts > MOST_PARTS:
                raise WireError(f"has more than {MOST_PARTS} fields")
            key, start = _varint(view, start, end)
            size, start = _size_of(view, start, end, key & 7)
            begin = start
            start = start + size
            if start > end:
                raise WireError("is truncated")
            field = kind.fields_by_number.get(key >> 3)
            if field is None or key & 7 != _BYTES:
                continue
            if field.message_type is not None:
                ahead.append((begin, start, field.message_type, depth + 1))
            elif size > MOST_PACKED and field.type in (
                field.TYPE_INT64,
                field.TYPE_UINT64,
                field.TYPE_INT32,
                field.TYPE_UINT32,
                field.TYPE_ENUM,
            ):
                # Variable-length numbers take more memory once parsed.
                raise WireError(
                    f"has {size} bytes of {field.name!r}, which are not weights"
                )


def _size_of(view: memoryview, start: int, end: int, wire: int) -> tuple[int, int]:
    if wire == _BYTES:
        return _varint(view, start, end)
    if wire == _VARINT:
        return _varint(view, start, end)[1] - start, start
    if wire not in _FIXED:
        raise WireError("is not an ONNX model")
    return _FIXED[wire], start


def _varint(view: memoryview, start: int, end: int) -> tuple[int, int]:
    value = 0
    for k in range(min(_LONGEST_VARINT, end - start)):
        value |= (view[start + k] & 0x7F) << (7 * k)
        if view[start + k] < 0x80:
            return value, start + k + 1
    raise WireError("is not an ONNX model, or is truncated")


def check_graph(model: Any, source: str) -> None:
    """Raises PolicyError for a graph that is not self-contained or uses a forbidden operator."""
    for field, reason in itertools.chain(
        _graph_faults(model), _weight_faults(model.graph)
    ):
        raise PolicyError(source, field, reason)
    try:
        onnx.checker.check_model(model)
    except (onnx.checker.ValidationError, ValueError) as error:
        reason = f"is not a valid ONNX graph ({quote(error)})."
        raise PolicyError(source, "graph", reason) from None


def quote(error: Exception) -> str:
    """Returns the message of a library's error as one short line."""
    return shorten(str(error), 120)


def _graph_faults(model: Any) -> Iterator[Fault]:
    graph = model.graph
    if len(graph.node) > MOST_NODES:
        reason = f"has {len(graph.node)} operators, more than {MOST_NODES}; not run."
        yield "graph.node", reason
    for tensor in _tensors(graph):
        name = f"weights.{tensor.name}"
        if tensor.data_type not in NUMBERS or len(tensor.dims) > MOST_DIMENSIONS:
            reason = f"is not a numeric array of at most {MOST_DIMENSIONS} dimensions; not run."
            yield name, reason
        location = next(
            (entry.value for entry in tensor.external_data if entry.key), ""
        )
        if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
            fix = "export with `external_data=False`, or `onnx.save(onnx.load(FILE), FILE)`"
            yield (
                name,
                f"refers to another file ({location!r}); a policy contains its weights: {fix}.",
            )
    if (
        len(model.functions)
        or len(model.training_info)
        or len(graph.sparse_initializer)
    ):
        yield "graph", "contains functions, training or sparse weights; remove them."
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            reason = (
                f"the operator {name} is not one of a feed-forward network; not run."
            )
            yield "graph.node", reason
        for a in node.attribute:
            if a.HasField("g") or len(a.graphs):
                yield "graph.node", f"{node.op_type} contains a subgraph."
            if a.HasField("sparse_tensor") or len(a.sparse_tensors):
                yield "graph.node", f"{node.op_type} contains sparse weights."
    yield from _setting_faults(graph)


def _weight_faults(graph: Any) -> Iterator[Fault]:
    for tensor in _tensors(graph):
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except (ValueError, TypeError, KeyError, RuntimeError):
            yield f"weights.{tensor.name}", "is damaged; export the policy again."
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"weights.{tensor.name}", "contains NaN or inf; train again."
    for attribute in _attributes(graph):
        if not all(map(math.isfinite, [attribute.f, *attribute.floats])):
            yield f"graph.node.{attribute.name}", "is NaN or inf."


def _attributes(graph: Any) -> Iterator[Any]:
    return itertools.chain.from_iterable(node.attribute for node in graph.node)


def _tensors(graph: Any) -> Iterator[Any]:
    yield from graph.initializer
    for attribute in _attributes(graph):
        if attribute.HasField("t"):
            yield attribute.t
        yield from attribute.tensors


def check_ends(
    model: Any, widths: dict[str, int | None], source: str, batch: int | None
) -> None:
    """Raises PolicyError unless inputs and outputs have these widths; None means integers (n,).

    Their first dimension is the number of observations, `batch`; None: any number.
    """
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [end for end in model.graph.input if end.name not in weights]
    if STATE_IN not in widths and STATE_IN in [end.name for end in inputs]:
        reason = "is missing, although the graph needs one; export the policy again."
        raise PolicyError(source, "state", reason)
    for kind, ends, order in (
        ("inputs", inputs, [INPUT, STATE_IN]),
        ("outputs", model.graph.output, [ACTION, COMMAND, STATE_OUT]),
    ):
        names = [name for name in order if name in widths]
        if [end.name for end in ends] != names:
            reason = f"are {[end.name for end in ends]}, not {names}; export the policy again."
            raise PolicyError(source, f"graph.{kind}", reason)
    for end in (*inputs, *model.graph.output):
        tensor = end.type.tensor_type
        width = widths[end.name]
        kind = TensorProto.INT64 if width is None else TensorProto.FLOAT
        sizes = [
            d.dim_value if d.HasField("dim_value") else None for d in tensor.shape.dim
        ]
        wanted = [batch] if width is None else [batch, width]
        if tensor.elem_type != kind or sizes != wanted:
            name = TensorProto.DataType.Name(tensor.elem_type)
            reason = (
                f"is {name} of shape {sizes}, but {wanted} is needed; export again."
            )
            raise PolicyError(source, f"graph.{end.name}", reason)


def rows_at_once(model: Any, source: str, batch: int | None = None) -> int:
    """Computes the number of observations per run, at most `batch`.

    Raises PolicyError if a size is unknown or far too large.
    """
    rows = batch or ROWS
    faults = itertools.chain(
        _setting_faults(model.graph), _integer_faults(model, rows, source)
    )
    for field, reason in faults:
        raise PolicyError(source, field, reason)
    numbers, work = _costs(model, rows, source)
    if max(numbers / MOST_NUMBERS, work / MOST_WORK) > rows:
        needs = (
            f"needs {numbers / rows:.3g} numbers and {work / rows:.3g} multiplications"
        )
        limits = (
            f"per observation; a policy may have {MOST_NUMBERS:.0e} and {MOST_WORK:.0e}"
        )
        raise PolicyError(source, "graph", f"{needs} {limits}; not run.")
    if batch is not None:
        return batch
    more_numbers, more_work = _costs(model, 2 * ROWS, source)
    if more_numbers > 2 * numbers or more_work > 2 * work:
        reason = "grows faster than the number of observations; not run."
        raise PolicyError(source, "graph", reason)
    return max(1, ROWS * MOST_AT_ONCE // max(numbers, 1))


def _setting_faults(graph: Any) -> Iterator[Fault]:
    """Yields huge kernels and arrays of thousands of dimensions, which slow inference down."""
    lengths = {tensor.name: math.prod(tensor.dims) for tensor in graph.initializer}
    for node in graph.node:
        for attribute in node.attribute:
            if node.op_type != "Slice" and any(
                abs(n) > GREATEST_SETTING for n in attribute.ints
            ):
                reason = f"of {node.op_type} exceeds {GREATEST_SETTING}; not run."
                yield f"graph.node.{attribute.name}", reason
        if node.op_type == "Constant":
            sizes = (max(len(a.ints), math.prod(a.t.dims)) for a in node.attribute)
            lengths.update(dict.fromkeys(node.output, max(sizes, default=0)))
    added = 0
    for node in graph.node:
        if node.op_type in ("Reshape", "Unsqueeze"):
            named = [lengths.get(name, 1) for name in node.input[1:2]]
            added += max(named + [len(a.ints) for a in node.attribute], default=0)
    if added > MOST_AXES:
        reason = (
            f"reshapes to {added} dimensions, more than {MOST_AXES} in total; not run."
        )
        yield "graph.node", reason


def _integer_faults(model: Any, rows: int, source: str) -> Iterator[Fault]:
    """Yields integers that are divided, or that grow during shape inference."""
    kinds, shapes = _sizes(model, rows, source, values=False)
    for node in model.graph.node:
        if node.op_type in DIVIDING and kinds.get(node.input[0]) not in FLOATS:
            yield (
                "graph.node",
                f"{node.op_type} of integers may crash the process; use float32.",
            )
        if (
            node.op_type in ("Concat", "Gather")
            and kinds.get(node.output[0]) not in FLOATS
        ):
            size = math.prod(shapes.get(node.output[0], (0,)))
            if size > SMALL * rows:
                reason = (
                    f"of {size} integers is too large for a shape or an index; not run."
                )
                yield "graph.node", f"{node.op_type} {reason}"


def _costs(model: Any, rows: int, source: str) -> tuple[int, int]:
    _, shapes = _sizes(model, rows, source, values=True)
    numbers = work = 0
    for node in model.graph.node:
        try:
            # omitted optional inputs have an empty name
            inputs = [shapes[name] for name in node.input if name]
            outputs = [shapes[name] for name in node.output if name]
        except KeyError:
            reason = f"the output size of {node.op_type} can't be known before it runs."
            raise PolicyError(source, "graph.node", reason) from None
        buffer, multiplied = _work(node, inputs, outputs)
        numbers += sum(map(math.prod, outputs)) + buffer
        work += sum(map(math.prod, (*inputs, *outputs))) + multiplied + buffer
    return numbers, work


def _work(node: Any, inputs: list[Shape], outputs: list[Shape]) -> tuple[int, int]:
    """Counts the numbers that the runtime allocates besides the output, and multiplications."""
    settings = {attribute.name: attribute for attribute in node.attribute}
    if node.op_type in ("MatMul", "Gemm"):
        turned = (
            node.op_type == "Gemm" and "transA" in settings and settings["transA"].i
        )
        return 0, math.prod(outputs[0]) * (inputs[0][0] if turned else inputs[0][-1])
    if node.op_type == "Conv":
        groups = int(settings["group"].i) if "group" in settings else 1
        kernel = math.prod(inputs[1][1:])
        return math.prod(outputs[0][2:]) * kernel * max(groups, 1), math.prod(
            outputs[0]
        ) * kernel
    # Inputs: a sequence (T, n, I), weights (D, G H, I) and (D, G H, H).
    if node.op_type in RECURRENT:
        steps = math.prod(inputs[0][:2])
        return steps * math.prod(inputs[1][:2]), steps * sum(
            map(math.prod, inputs[1:3])
        )
    if "kernel_shape" in settings:  # pooling
        return 0, math.prod(outputs[0]) * int(math.prod(settings["kernel_shape"].ints))
    return 0, 0


def _sizes(
    model: Any, rows: int, source: str, values: bool
) -> tuple[dict[str, int], dict[str, Shape]]:
    """Returns types and known shapes of all tensors for `rows` observations.

    `values` also uses the values of integers.
    """
    bare = _without_weights(model, rows)
    try:
        graph = onnx.shape_inference.infer_shapes(
            bare, strict_mode=True, data_prop=values
        ).graph
    except Exception as error:  # noqa: BLE001 - a damaged graph raises anything
        raise PolicyError(
            source, "graph", f"its shapes are inconsistent ({quote(error)})."
        ) from None
    kinds = {tensor.name: tensor.data_type for tensor in graph.initializer}
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    for value in (*graph.input, *graph.value_info, *graph.output):
        tensor = value.type.tensor_type
        kinds[value.name] = tensor.elem_type
        if tensor.HasField("shape") and all(
            d.HasField("dim_value") for d in tensor.shape.dim
        ):
            shapes[value.name] = tuple(d.dim_value for d in tensor.shape.dim)
    return kinds, {
        name: shape for name, shape in shapes.items() if min(shape, default=0) >= 0
    }


def _without_weights(model: Any, rows: int) -> Any:
    """Returns the graph for `rows` observations, with weights and constants as inputs."""
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
    for value in (end for end in model.graph.input if end.name not in held):
        graph.input.append(value)
        graph.input[-1].type.tensor_type.shape.dim[0].dim_value = rows
    for value in model.graph.output:  # infer output shapes instead of trusting them
        kind = value.type.tensor_type.elem_type
        graph.output.append(onnx.helper.make_tensor_value_info(value.name, kind, None))
    return bare


def _add_tensor(graph: Any, tensor: Any, name: str) -> None:
    """Adds small integer arrays, which may be shapes, with their values; others only by shape."""
    if math.prod(tensor.dims) <= SMALL and tensor.data_type in INTEGERS:
        graph.initializer.append(tensor)
        graph.initializer[-1].name = name
        return
    info = onnx.helper.make_tensor_value_info(name, tensor.data_type, list(tensor.dims))
    graph.input.append(info)
