"""What the graph of a policy file may hold, checked before anything of it runs.

A policy file's bytes, counted before they are parsed.

Two bytes of a file can become a message of some hundred bytes in memory, and one byte a number of
eight. So the parts of the file are counted as they lie there, and only a file of few is parsed.
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
"""Of the metadata that holds the contract."""
SEAL = "sha256"
"""Of the metadata at the file's end: the checksum of all that stands before it."""
SIZE_LIMIT = 32 * 2**20
MOST_NODES = 1000
"""An exported network has some dozens."""
MOST_DIMENSIONS = 8
"""Of one array of weights."""
NUMBERS = frozenset(
    getattr(onnx.TensorProto, kind)
    for kind in ("FLOAT", "DOUBLE", "FLOAT16", "INT64", "INT32", "BOOL")
)
"""Kinds of arrays that are as large in memory as in the file."""
CONTRACT_LIMIT = 4 * 2**20
"""Bytes of the contract, whose golden observations are the most of it."""
INPUT, ACTION, COMMAND = "observation", "action", "command"
OPERATORS = frozenset({
    "Abs", "Add", "ArgMax", "AveragePool", "Cast", "Clip", "Concat", "Constant", "Conv", "Div",
    "Elu", "Erf", "Exp", "Flatten", "Gather", "Gelu", "Gemm", "GlobalAveragePool", "HardSigmoid",
    "HardSwish", "Identity", "LayerNormalization", "LeakyRelu", "Log", "LogSoftmax", "MatMul",
    "Max", "MaxPool", "Min", "Mish", "Mul", "Neg", "Pow", "PRelu", "ReduceMean", "ReduceSum",
    "Relu", "Reshape", "Selu", "Shape", "Sigmoid", "Slice", "Softmax", "Softplus", "Softsign",
    "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
})  # fmt: skip
"""Feed-forward networks; nothing that loops, branches, draws, or grows with its input's values."""
OTHER_FORMATS = (
    (b"PK", "a zip archive, as Stable-Baselines3 and torch write them"),
    (b"\x80", "a pickle"),
    (b"\x93NUMPY", "a numpy array"),
    (b"\x89HDF", "an HDF5 file"),
    (b"\x1f\x8b", "a gzip file"),
)
"""How files begin that trainers write and that are never opened here."""


def parse(data: bytes, source: str) -> Any:
    """The ModelProto of a policy file's content, checked.

    Raises:
        PolicyError: it is no ONNX model, or one that this package would not run.
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
    """A model's bytes with their checksum as one more entry of the metadata.

    Parts of a protobuf message may follow one another, so other programs read it as any other.
    """
    end = onnx.ModelProto()
    entry = end.metadata_props.add()
    entry.key, entry.value = SEAL, sha256(data)
    return data + bytes(end.SerializeToString(deterministic=True))


def check_seal(data: bytes, source: str) -> None:
    """Raises PolicyError unless every bit of a file is as it was written."""
    size = len(sealed(b""))
    if data != sealed(data[:-size]):
        reason = "does not fit the file, which was changed or damaged; copy or export it again."
        raise PolicyError(source, SEAL, reason)


def check_graph(model: Any, source: str) -> None:
    """Raises PolicyError for a graph that is not self-contained, or holds other operators."""
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
    """Every tensor of a graph: its weights, and constants in its nodes."""
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
        widths: of `observation`, `action` and `command`; None: whole numbers (n,).
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
    """The text of the contract. Raises PolicyError when there is none, or more."""
    found = [entry.value for entry in model.metadata_props if entry.key == KEY]
    if len(found) != 1:
        reason = f"{len(found)} contracts in it; only files of `export_policy` are policies."
        raise PolicyError(source, "metadata", reason)
    if len(found[0]) > CONTRACT_LIMIT:
        reason = f"has {len(found[0])} characters, a contract at most {CONTRACT_LIMIT}; not read."
        raise PolicyError(source, "metadata", reason)
    return str(found[0])


def graph_hash(model: Any) -> str:
    """SHA-256 over a model without its metadata."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.metadata_props[:]
    return sha256(bare.SerializeToString(deterministic=True))


MOST_PARTS = 50_000
"""Fields of all messages of a file; the weights of a network are one part each."""
MOST_NESTED = 16
"""Messages within messages; an exported graph needs six."""
MOST_PACKED = 2**20
"""Bytes of whole numbers in one part, such as the sizes of an array; weights are no such part."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


class WireError(ValueError):
    """No message, or one that is too large once parsed; the text says which."""


def check_wire(data: bytes) -> None:
    """Makes sure that the bytes of a ModelProto are few messages.

    Raises:
        WireError: they are no message, or hold more parts or deeper ones than allowed.
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
    """Whether numbers of variable length lie in a field, which grow when they are parsed."""
    growing = (
        field.TYPE_INT64, field.TYPE_UINT64, field.TYPE_INT32, field.TYPE_UINT32, field.TYPE_ENUM,
    )  # fmt: skip
    return field.type in growing


def _extent(view: memoryview, start: int, end: int, wire: int) -> tuple[int, int]:
    """Where the content of a field begins and ends."""
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
