"""Checks a policy file's graph before any of it runs: size, form, operators, known shapes."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
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
# maximum size of the contract [bytes], mostly golden observations
CONTRACT_LIMIT = 4 * 2**20
# maximum number of observations per run; `rehearsal` checks files with this number
MOST_ROWS = 256
# maximum number of operators; a shipped policy has 30, and the time to open a graph grows faster
# than their number
MOST_OPERATORS = 2000
STANDARD = ("", "ai.onnx")  # names of the domain of the standard operators
INPUT = "observation"
ACTION = "action"
COMMAND = "command"
# additional input and output of a policy with a state
STATE_IN = "state_in"
STATE_OUT = "state_out"
# operators of networks: no loops, branches, random numbers or data-dependent sizes
OPERATOR_NAMES = """
Abs Add ArgMax Atan AveragePool BatchNormalization Cast Clip Concat Constant Conv Cos Div Elu
Erf Exp Flatten GRU Gather Gelu Gemm GlobalAveragePool HardSigmoid HardSwish Identity LSTM
LayerNormalization LeakyRelu Log LogSoftmax MatMul Max MaxPool Min Mish Mul Neg PRelu Pow RNN
Reciprocal ReduceMax ReduceMean ReduceMin ReduceSum Relu Reshape Selu Shape Sigmoid Sign Sin
Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub Tanh Transpose Unsqueeze
"""
OPERATORS = frozenset(OPERATOR_NAMES.split())
FLOATS = frozenset({TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.FLOAT16})
NUMBERS = FLOATS | {TensorProto.INT64, TensorProto.INT32, TensorProto.BOOL}
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
Fault = tuple[str, str]  # faulty field and the reason


def read_network(file: Path, source: str, field: str) -> bytes:
    """Reads a network's file, which `field` of the source names. Raises PolicyError."""
    name = "" if str(file) == source else f"{file.name!r} "
    try:
        if not file.is_file():
            raise PolicyError(
                source, field, f"{name}does not exist or is not a file; check its path."
            )
        size = file.stat().st_size
        if size <= SIZE_LIMIT:
            return file.read_bytes()
    except OSError as error:
        raise PolicyError(
            source, field, f"{name}can't be read ({error.strerror})."
        ) from None
    sizes = f"{size / 2**20:.0f} MB, more than the {SIZE_LIMIT // 2**20} MB of a policy"
    raise PolicyError(source, field, f"{name}has {sizes}; not opened.")


def check_format(data: bytes, source: str) -> None:
    """Raises PolicyError for a file of a training framework."""
    for start, kind in OTHER_FORMATS:
        if data.startswith(start):
            raise PolicyError(
                source,
                "file",
                f"is {kind}, which is not a policy; export the policy with `export_policy`.",
            )


def parse(data: bytes, source: str) -> Any:
    """Parses any ModelProto; content of others only after `rehearsal`. Raises PolicyError."""
    check_format(data, source)
    try:
        model = onnx.load_model_from_string(data)
        if not model.HasField("graph"):
            raise ValueError
    except (DecodeError, ValueError, TypeError):
        raise PolicyError(
            source,
            "file",
            "is not an ONNX model, or is truncated; export or copy it again.",
        ) from None
    return model


def find_contract_text(model: Any, source: str) -> str:
    """Returns the text of the contract. Raises PolicyError unless the model has exactly one."""
    contracts = [entry.value for entry in model.metadata_props if entry.key == KEY]
    if len(contracts) != 1:
        raise PolicyError(
            source,
            "metadata",
            f"has {len(contracts)} contracts; only files of `export_policy` are policies.",
        )
    if len(contracts[0]) > CONTRACT_LIMIT:
        raise PolicyError(
            source,
            "metadata",
            f"has {len(contracts[0])} characters, more than {CONTRACT_LIMIT}; not read.",
        )
    return str(contracts[0])


def hash_graph(model: Any) -> str:
    """Returns the SHA-256 of a model without its metadata."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.metadata_props[:]
    return hash_bytes(bare.SerializeToString(deterministic=True))


def add_seal(data: bytes) -> bytes:
    """Appends a model's checksum as a metadata entry; serialised messages may be concatenated."""
    end = onnx.ModelProto()
    entry = end.metadata_props.add()
    entry.key, entry.value = SEAL, hash_bytes(data)
    return data + bytes(end.SerializeToString(deterministic=True))


def check_seal(data: bytes, source: str) -> None:
    """Raises PolicyError unless a file is bit-identical to the one that was written."""
    check_format(data, source)
    seal = add_seal(b"")
    mark = seal[: -len(hash_bytes(b""))]
    if not data[-len(seal) :].startswith(mark):
        reason = "does not end with the checksum of a policy file; it is another file or truncated"
        raise PolicyError(source, "file", f"{reason}; export or copy it again.")
    if data != add_seal(data[: -len(seal)]):
        raise PolicyError(
            source,
            SEAL,
            "does not match the file, which was changed or damaged; copy or export it again.",
        )


def check_graph(model: Any, source: str) -> None:
    """Raises PolicyError for a graph that is not self-contained or uses a forbidden operator."""
    for field, reason in itertools.chain(
        _find_graph_faults(model), _find_weight_faults(model.graph)
    ):
        raise PolicyError(source, field, reason)
    try:
        onnx.checker.check_model(model)
    except (onnx.checker.ValidationError, ValueError) as error:
        raise PolicyError(
            source, "graph", f"is not a valid ONNX graph ({quote(error)})."
        ) from None


def quote(error: Exception) -> str:
    """Returns the message of a library's error as one short line."""
    return shorten(str(error), 120)


def _find_graph_faults(model: Any) -> Iterator[Fault]:
    graph = model.graph
    for tensor in _list_tensors(graph):
        name = f"weights.{tensor.name}"
        if tensor.data_type not in NUMBERS:
            yield name, "is not an array of ordinary numbers; not run."
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
    if len(graph.node) > MOST_OPERATORS:
        reason = f"has {len(graph.node)} operators, more than the {MOST_OPERATORS} of a policy"
        yield "graph.node", f"{reason}; simplify the network."
    for node in graph.node:
        if node.domain not in STANDARD or node.op_type not in OPERATORS:
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


def _find_weight_faults(graph: Any) -> Iterator[Fault]:
    for tensor in _list_tensors(graph):
        try:
            values = onnx.numpy_helper.to_array(tensor)
        except (ValueError, TypeError, KeyError, RuntimeError):
            yield f"weights.{tensor.name}", "is damaged; export the policy again."
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"weights.{tensor.name}", "contains NaN or inf; train again."
    for attribute in _list_attributes(graph):
        if not all(map(math.isfinite, [attribute.f, *attribute.floats])):
            yield f"graph.node.{attribute.name}", "is NaN or inf."


def _list_attributes(graph: Any) -> Iterator[Any]:
    return itertools.chain.from_iterable(node.attribute for node in graph.node)


def _list_tensors(graph: Any) -> Iterator[Any]:
    yield from graph.initializer
    for attribute in _list_attributes(graph):
        if attribute.HasField("t"):
            yield attribute.t
        yield from attribute.tensors


def list_inputs(model: Any) -> list[Any]:
    """Returns the inputs of a graph other than weights, as onnx.ValueInfoProto."""
    weights = {tensor.name for tensor in model.graph.initializer}
    return [value for value in model.graph.input if value.name not in weights]


def has_open_rows(model: Any) -> bool:
    """True if an input takes any number of observations."""
    shapes = [value.type.tensor_type.shape.dim for value in list_inputs(model)]
    return any(shape and not shape[0].dim_value for shape in shapes)


def fix_rows(model: Any, rows: int) -> Any:
    """Returns a model for `rows` observations at once, without its own shape annotations."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.graph.value_info[:]
    for value in list_inputs(bare):
        first = value.type.tensor_type.shape.dim[:1]
        if first and not first[0].dim_value:
            first[0].dim_value = rows
    for value in bare.graph.output:
        value.type.tensor_type.ClearField("shape")
    return bare


def check_sizes(model: Any, source: str) -> None:
    """Raises PolicyError for sizes that depend on the observation, or divisions of integers.

    The inputs have known shapes, and everything that depends only on these is already
    folded.
    """
    try:
        graph = onnx.shape_inference.infer_shapes(
            model, strict_mode=True, data_prop=True
        ).graph
    except Exception as error:  # noqa: BLE001 - a damaged graph raises anything
        raise PolicyError(
            source, "graph", f"its shapes are inconsistent ({quote(error)})."
        ) from None
    kinds = {tensor.name: tensor.data_type for tensor in graph.initializer}
    known = {""}  # omitted optional outputs have an empty name
    for value in (*graph.input, *graph.value_info, *graph.output):
        tensor = value.type.tensor_type
        kinds[value.name] = tensor.elem_type
        sizes = tensor.shape.dim
        if tensor.HasField("shape") and all(d.HasField("dim_value") for d in sizes):
            known.add(value.name)
    for node in graph.node:
        if node.op_type in DIVIDING and kinds.get(node.input[0]) not in FLOATS:
            raise PolicyError(
                source,
                "graph.node",
                f"{node.op_type} of integers may crash the process; use float32.",
            )
        if not known.issuperset(node.output):
            raise PolicyError(
                source,
                "graph.node",
                f"the output size of {node.op_type} can't be known before it runs.",
            )
