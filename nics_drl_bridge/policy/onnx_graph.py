"""Checks of the graph of a policy file, before anything of it runs.

Size checks of a policy file's bytes before they are parsed.

Two bytes of a file can become a message of some hundred bytes in memory, and one byte a number of
eight. So the parts are counted in the raw bytes, and only a file with few of them is parsed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.files import sha256

KEY = "nics_drl_bridge"
"""Key of the metadata entry with the contract."""
SEAL = "sha256"
"""Key of the metadata entry at the file's end: the checksum of everything before it."""
SIZE_LIMIT = 32 * 2**20
MOST_NODES = 1000
"""Maximum number of nodes; an exported network has some dozens."""
MOST_DIMENSIONS = 8
"""Maximum number of dimensions of an array of weights."""
NUMBERS = frozenset(
    getattr(onnx.TensorProto, kind)
    for kind in ("FLOAT", "DOUBLE", "FLOAT16", "INT64", "INT32", "BOOL")
)
"""Types of arrays that are as large in memory as in the file."""
CONTRACT_LIMIT = 4 * 2**20
"""Maximum size of the contract [bytes], most of which are golden observations."""
INPUT, ACTION, COMMAND = "observation", "action", "command"
OPERATORS = frozenset({
    "Abs", "Add", "ArgMax", "AveragePool", "Cast", "Clip", "Concat", "Constant", "Conv", "Div",
    "Elu", "Erf", "Exp", "Flatten", "Gather", "Gelu", "Gemm", "GlobalAveragePool", "HardSigmoid",
    "HardSwish", "Identity", "LayerNormalization", "LeakyRelu", "Log", "LogSoftmax", "MatMul",
    "Max", "MaxPool", "Min", "Mish", "Mul", "Neg", "Pow", "PRelu", "ReduceMean", "ReduceSum",
    "Relu", "Reshape", "Selu", "Shape", "Sigmoid", "Slice", "Softmax", "Softplus", "Softsign",
    "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
})  # fmt: skip
"""Operators of feed-forward networks: no loops, branches, random draws or data-dependent sizes."""
OTHER_FORMATS = (
    (b"PK", "a zip archive, as Stable-Baselines3 and torch write them"),
    (b"\x80", "a pickle"),
    (b"\x93NUMPY", "a numpy array"),
    (b"\x89HDF", "an HDF5 file"),
    (b"\x1f\x8b", "a gzip file"),
)
"""First bytes of files that trainers write and that are never opened here."""


def parse(data: bytes, source: str) -> Any:
    """Parses and checks the ModelProto of a policy file's content.

    Raises:
        PolicyError: it is not an ONNX model, or one that this package does not run.
    """
    for start, kind in OTHER_FORMATS:
        if data.startswith(start):
            reason = f"is {kind}, which is never opened; export the policy with `export_policy`."
            raise PolicyError(source, "file", reason)
    try:
        check_wire(data)
        model = onnx.load_model_from_string(data)
    except WireError as error:
        reason = f"{error}, which no policy is; export or copy it again."
        raise PolicyError(source, "file", reason) from None
    except (DecodeError, ValueError, TypeError):
        reason = "is no ONNX model, or is cut off; copy it again."
        raise PolicyError(source, "file", reason) from None
    if not model.HasField("graph"):
        raise PolicyError(source, "file", "is no ONNX model, or is cut off; copy it again.")
    metadata(model, source)
    check_graph(model, source)
    return model


def sealed(data: bytes) -> bytes:
    """Appends to a model's bytes their checksum, as another metadata entry.

    Parts of a protobuf message may be concatenated, so other programs read the file as usual.
    """
    end = onnx.ModelProto()
    entry = end.metadata_props.add()
    entry.key, entry.value = SEAL, sha256(data)
    return data + bytes(end.SerializeToString(deterministic=True))


def check_seal(data: bytes, source: str) -> None:
    """Raises PolicyError unless a file is bit-identical to what was written."""
    size = len(sealed(b""))
    if data != sealed(data[:-size]):
        reason = "does not fit the file, which was changed or damaged; copy or export it again."
        raise PolicyError(source, SEAL, reason)


def check_graph(model: Any, source: str) -> None:
    """Raises PolicyError for a graph that is not self-contained, or has other operators."""
    graph = model.graph
    if len(graph.node) > MOST_NODES:
        reason = f"has {len(graph.node)} operators, a policy at most {MOST_NODES}; not run."
        raise PolicyError(source, "graph.node", reason)
    for tensor in tensors(graph):
        if tensor.data_type not in NUMBERS or len(tensor.dims) > MOST_DIMENSIONS:
            reason = f"is no array of numbers with at most {MOST_DIMENSIONS} dimensions; not run."
            raise PolicyError(source, f"weights.{tensor.name}", reason)
        location = next((entry.value for entry in tensor.external_data if entry.key), "")
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            reason = f"refers to another file ({location!r}); a policy holds its own weights."
            raise PolicyError(source, f"weights.{tensor.name}", reason)
    if len(model.functions) or len(model.training_info) or len(graph.sparse_initializer):
        raise PolicyError(source, "graph", "holds functions, training or sparse weights; remove.")
    for opset in model.opset_import:
        if opset.domain not in ("", "ai.onnx"):
            reason = f"holds the domain {opset.domain!r}; only standard operators are run."
            raise PolicyError(source, "opset_import", reason)
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            reason = f"the operator {name} is not one of a feed-forward network; not run."
            raise PolicyError(source, "graph.node", reason)
        if any(a.HasField("g") or len(a.graphs) for a in node.attribute):
            raise PolicyError(source, "graph.node", f"{node.op_type} holds a graph of its own.")
        if any(a.HasField("sparse_tensor") or len(a.sparse_tensors) for a in node.attribute):
            raise PolicyError(source, "graph.node", f"{node.op_type} holds sparse weights.")
    _check_weights(graph, source)
    try:
        onnx.checker.check_model(model)
    except (onnx.checker.ValidationError, ValueError) as error:
        words = " ".join(str(error).split())[:120]
        raise PolicyError(source, "graph", f"is no valid ONNX graph ({words}).") from None


def tensors(graph: Any) -> Iterator[Any]:
    """Yields every tensor of a graph: its weights, and constants in its nodes."""
    yield from graph.initializer
    for attribute in itertools.chain.from_iterable(node.attribute for node in graph.node):
        if attribute.HasField("t"):
            yield attribute.t
        yield from attribute.tensors


def _check_weights(graph: Any, source: str) -> None:
    for tensor in tensors(graph):
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except (ValueError, TypeError, KeyError, RuntimeError):
            name = f"weights.{tensor.name}"
            raise PolicyError(source, name, "is damaged; export the policy anew.") from None
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise PolicyError(source, f"weights.{tensor.name}", "holds NaN or inf; train anew.")
    for node in graph.node:
        for attribute in node.attribute:
            numbers = [attribute.f, *attribute.floats]
            if not all(math.isfinite(number) for number in numbers):
                raise PolicyError(source, f"graph.node.{attribute.name}", "is NaN or inf.")


def check_ends(model: Any, widths: dict[str, int | None], source: str) -> None:
    """Raises PolicyError unless inputs and outputs are those of a policy.

    Args:
        model: the ModelProto.
        widths: of `observation`, `action` and `command`; None: integers (n,).
        source: the file's name.
    """
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [one for one in model.graph.input if one.name not in weights]
    for kind, ends, names in (
        ("inputs", inputs, [INPUT]),
        ("outputs", model.graph.output, [ACTION, COMMAND]),
    ):
        if [end.name for end in ends] != names:
            reason = f"are {[end.name for end in ends]}, not {names}; export the policy anew."
            raise PolicyError(source, f"graph.{kind}", reason)
    for end in (*inputs, *model.graph.output):
        tensor, width = end.type.tensor_type, widths[end.name]
        kind = onnx.TensorProto.INT64 if width is None else onnx.TensorProto.FLOAT
        sizes = [d.dim_value if d.HasField("dim_value") else None for d in tensor.shape.dim]
        wanted = [None] if width is None else [None, width]
        if tensor.elem_type != kind or sizes != wanted:
            name = onnx.TensorProto.DataType.Name(tensor.elem_type)
            reason = f"is {name} of shape {sizes}, where {wanted} is needed; export anew."
            raise PolicyError(source, f"graph.{end.name}", reason)


def metadata(model: Any, source: str) -> str:
    """The text of the contract. Raises PolicyError unless there is exactly one."""
    found = [entry.value for entry in model.metadata_props if entry.key == KEY]
    if len(found) != 1:
        reason = f"{len(found)} contracts in it; only files of `export_policy` are policies."
        raise PolicyError(source, "metadata", reason)
    if len(found[0]) > CONTRACT_LIMIT:
        reason = f"has {len(found[0])} characters, a contract at most {CONTRACT_LIMIT}; not read."
        raise PolicyError(source, "metadata", reason)
    return str(found[0])


def graph_hash(model: Any) -> str:
    """SHA-256 of a model without its metadata."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.metadata_props[:]
    return sha256(bare.SerializeToString(deterministic=True))


MOST_PARTS = 50_000
"""Maximum number of fields of all messages; each array of weights is one part."""
MOST_NESTED = 16
"""Maximum nesting of messages; an exported graph needs six levels."""
MOST_PACKED = 2**20
"""Maximum size of packed integers in one part, such as an array's shape [bytes]; not weights."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


class WireError(ValueError):
    """The bytes are no message, or one that is too large once parsed."""


def check_wire(data: bytes) -> None:
    """Checks that the bytes of a ModelProto have few parts.

    Raises:
        WireError: they are no message, or have more parts or deeper nesting than allowed.
    """
    view, parts = memoryview(data), 0
    ahead: list[tuple[int, int, Any, int]] = [(0, len(data), onnx.ModelProto.DESCRIPTOR, 1)]
    while ahead:
        start, end, kind, depth = ahead.pop()
        if depth > MOST_NESTED:
            raise WireError(f"is nested more than {MOST_NESTED} levels deep")
        while start < end:
            parts += 1
            if parts > MOST_PARTS:
                raise WireError(f"has more than {MOST_PARTS} parts")
            key, start = _varint(view, start, end)
            begin, start = _extent(view, start, end, key & 7)
            field = kind.fields_by_number.get(key >> 3)
            if field is None or key & 7 != _BYTES:
                continue
            if field.message_type is not None:
                ahead.append((begin, start, field.message_type, depth + 1))
            elif _is_packed_number(field) and start - begin > MOST_PACKED:
                raise WireError(f"has {start - begin} bytes of {field.name!r}, not weights")


def _is_packed_number(field: Any) -> bool:
    """True for a field of variable-length numbers, which grow when they are parsed."""
    growing = (
        field.TYPE_INT64, field.TYPE_UINT64, field.TYPE_INT32, field.TYPE_UINT32, field.TYPE_ENUM,
    )  # fmt: skip
    return field.type in growing


def _extent(view: memoryview, start: int, end: int, wire: int) -> tuple[int, int]:
    """Start and end of the content of a field."""
    if wire == _VARINT:
        return start, _varint(view, start, end)[1]
    if wire == _BYTES:
        size, start = _varint(view, start, end)
    elif wire in (_FIXED64, _FIXED32):
        size = 8 if wire == _FIXED64 else 4
    else:
        raise WireError("is no ONNX model")
    if start + size > end:
        raise WireError("is cut off")
    return start, start + size


def _varint(view: memoryview, start: int, end: int) -> tuple[int, int]:
    value = 0
    for k in range(_LONGEST_VARINT):
        if start + k >= end:
            break
        value |= (view[start + k] & 0x7F) << (7 * k)
        if view[start + k] < 0x80:
            return value, start + k + 1
    raise WireError("is no ONNX model, or is cut off")
