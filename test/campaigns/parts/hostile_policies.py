"""Policy files that an attacker would write: their checksums are right."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from parts.attempt import Attempt, nics

from nics_drl_bridge.policy.file import contract, onnx_graph
from nics_drl_bridge.policy.file.contract import shipped
from nics_drl_bridge.policy.file.policy_file import load_policy

Rng = np.random.Generator
node = onnx.helper.make_node
from_array = onnx.numpy_helper.from_array


def attempts(rng: Rng, folder: Path) -> Iterator[Attempt]:
    """Without end: grown graphs, false contracts, bytes of messages, damaged files."""
    makers = (_grown, _grown, _false, _raw, _mutated)
    names = [path.stem for path in sorted(shipped().glob("*.onnx"))]
    while True:
        name = names[int(rng.integers(len(names)))]
        if rng.random() < 0.08:
            yield Attempt(
                "policy",
                f"{name} as shipped",
                _loaded(shipped() / f"{name}.onnx"),
                "good",
            )
            continue
        told, data, verdict = makers[int(rng.integers(len(makers)))](rng, name)
        path = folder / "policy.onnx"
        path.write_bytes(data)
        act = nics("policy", "info", path) if rng.random() < 0.3 else _loaded(path)
        yield Attempt("policy", f"{name}: {told}", act, verdict)


def _loaded(path: Path) -> Callable[[], object]:
    return lambda: load_policy(path)


def _proto(name: str) -> Any:
    return onnx.load(shipped() / f"{name}.onnx")


def _signed(proto: Any, data: dict[str, Any] | None = None) -> bytes:
    """The file with every checksum right."""
    if data is None:
        data = json.loads(onnx_graph.metadata(proto, "file"))
    data["graph_sha256"] = onnx_graph.graph_hash(proto)
    return _with_contract(proto, json.dumps(data))


def _with_contract(proto: Any, text: str) -> bytes:
    del proto.metadata_props[:]
    onnx.helper.set_model_props(proto, {onnx_graph.KEY: text})
    return onnx_graph.sealed(proto.SerializeToString(deterministic=True))


def _grown(rng: Rng, name: str) -> tuple[str, bytes, str]:
    """A graph that takes memory or time, in front of the true one."""
    proto = _proto(name)
    width = 78
    kind = str(rng.choice(list(_GROWN)))
    amount = int(rng.integers(1, 9))
    nodes, arrays = _GROWN[kind](amount, width)
    proto.graph.initializer.extend(
        from_array(value, f"x_{key}") for key, value in arrays.items()
    )
    own = list(proto.graph.node)
    del proto.graph.node[:]
    proto.graph.node.extend([*nodes, *own])
    return f"{kind} {amount}", _signed(proto), "bad"


Grown = tuple[list[Any], dict[str, Any]]


def _chain(length: int, make: Callable[[str, str], Any]) -> list[Any]:
    names = ["observation", *(f"x_{k}" for k in range(length))]
    return [make(a, b) for a, b in itertools.pairwise(names)]


def _concat(amount: int, width: int) -> Grown:
    return _chain(16 + amount, lambda a, b: node("Concat", [a, a], [b], axis=1)), {}


def _concat_of_rows(amount: int, width: int) -> Grown:
    return _chain(16 + amount, lambda a, b: node("Concat", [a, a], [b], axis=0)), {}


def _many(amount: int, width: int) -> Grown:
    return _chain(1000 + 3000 * amount, lambda a, b: node("Tanh", [a], [b])), {}


def _gather(amount: int, width: int) -> Grown:
    index = np.zeros(400_000 * amount, np.int64)  # 1,200,000 numbers and more
    nodes = _chain(3, lambda a, b: node("Gather", [a, "x_index"], [b], axis=1))
    return nodes, {"index": index}


def _wide(amount: int, width: int) -> Grown:
    thin = np.zeros((8000 * amount, 1), np.float32)
    return [node("Mul", ["x_thin", "x_turned"], ["x_0"])], {
        "thin": thin,
        "turned": thin.T,
    }


def _products(amount: int, width: int) -> Grown:
    whole = np.zeros((2000, 2000), np.float32)
    first = [node("MatMul", ["observation", "x_first"], ["x_f"])]
    names = ["x_f", *(f"x_{k}" for k in range(6 + 20 * amount))]
    rest = [node("MatMul", [a, "x_whole"], [b]) for a, b in itertools.pairwise(names)]
    return first + rest, {"first": np.zeros((width, 2000), np.float32), "whole": whole}


def _outer(amount: int, width: int) -> Grown:
    turned = node("Transpose", ["observation"], ["x_t"], perm=[1, 0])
    return [turned, node("MatMul", ["observation", "x_t"], ["x_s"])], {}


def _operator(kind: str, **settings: Any) -> Callable[[int, int], Grown]:
    def make(amount: int, width: int) -> Grown:
        sizes = np.array([10**4 * amount, 10**5], np.int64)
        return [node(kind, ["x_sizes"], ["x_0"], **settings)], {"sizes": sizes}

    return make


def _mismatch(amount: int, width: int) -> Grown:
    wrong = np.zeros((width + amount, 4), np.float32)
    return [node("MatMul", ["observation", "x_wrong"], ["x_0"])], {"wrong": wrong}


def _kernel(amount: int, width: int) -> Grown:
    row = node("Unsqueeze", ["observation", "x_one"], ["x_row"])
    pads = [2 ** (24 + 4 * amount)] * 2
    pool = node("AveragePool", ["x_row"], ["x_0"], kernel_shape=[2**20], pads=pads)
    return [row, pool], {"one": np.array([1])}


def _by_value(amount: int, width: int) -> Grown:
    cast = node("Cast", ["observation"], ["x_i"], to=onnx.TensorProto.INT64)
    flat = node("Reshape", ["x_i", "x_flat"], ["x_j"])
    return [cast, flat, node("Reshape", ["observation", "x_j"], ["x_0"])], {
        "flat": np.array([-1])
    }


_GROWN: dict[str, Callable[[int, int], Grown]] = {
    "Concat": _concat,
    "Concat of rows": _concat_of_rows,
    "operators": _many,
    "Gather": _gather,
    "a wide product": _wide,
    "products": _products,
    "a square": _outer,
    "mismatch": _mismatch,
    "kernel": _kernel,
    "by value": _by_value,
    "ConstantOfShape": _operator("ConstantOfShape"),
    "RandomNormal": _operator("RandomNormal", shape=[10**5, 10**5]),
    "Loop": _operator("Loop"),
    "Expand": _operator("Expand"),
    "Range": _operator("Range"),
}
_VALUES: tuple[Any, ...] = (
    "x" * 3_000_000,
    -1,
    0,
    1e308,
    10**400,
    [],
    {},
    None,
    True,
    [[[]]],
    "\n" * 50,
    "\x1b[2J",
    2**63,
    [0.0] * 30_000,
    {"a" * 1000: 1},
    1e-320,
    float(2**70),
    "../../etc/passwd",
    ["x"] * 20_000,
)


def _false(rng: Rng, name: str) -> tuple[str, bytes, str]:
    """A contract with something else in the place of an entry, or with one more."""
    proto = _proto(name)
    data = json.loads(onnx_graph.metadata(proto, "file"))
    places = [
        path for path, _ in contract.leaves(data) if not path.startswith("checksums")
    ]
    place = str(rng.choice(places)).split(".")
    inner: Any = data
    depth = int(rng.integers(len(place)))
    for part in place[:depth]:
        inner = inner[int(part) if isinstance(inner, list) else part]
    key: Any = int(place[depth]) if isinstance(inner, list) else place[depth]
    which = int(rng.integers(len(_VALUES)))
    inner[key] = _VALUES[which]
    free = ("provenance", "task")  # where any words may stand
    verdict = "any" if place[0] in free or which in (1, 2, 4, 7, 15, 16, 17) else "bad"
    if place[0] == "robot" or key == "description":
        verdict = "any"
    try:
        made = _signed(proto, data)
    except (TypeError, KeyError, ValueError):
        made = _with_contract(proto, json.dumps(data))
    return f"{'.'.join(place[: depth + 1])} is value {which}", made, verdict


def _field(number: int, content: bytes) -> bytes:
    size = len(content)
    length = b""
    while size >= 0x80:
        length = length + bytes([size & 0x7F | 0x80])
        size = size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


def _raw(rng: Rng, name: str) -> tuple[str, bytes, str]:
    """Messages as no library would write them, or other contracts than JSON objects."""
    amount = int(rng.integers(1, 8))
    which = int(rng.integers(8))
    if which < 4:
        inner = (
            _field(1, b"") * (800_000 * amount),  # operators
            _field(5, _field(1, b"\x01" * (4_000_000 * amount))),  # sizes of an array
            _field(5, _field(4, bytes(4_000_000 * amount))),  # weights
            _field(12, _field(1, b"y" * (4_000_000 * amount))),  # a name
        )[which]
        return f"graph of {len(inner)} bytes, {which}", _field(7, inner), "bad"
    if which == 4:
        nested = b""
        for _ in range(300 * amount):
            nested = _field(1, _field(5, _field(6, nested)))
        return f"{300 * amount} graphs in graphs", _field(7, nested), "bad"
    text = (
        "[" * (500_000 * amount),
        '{"a":' * (300_000 * amount),
        '"' + "z" * (4_000_000 * amount) + '"',
    )[which - 5]
    return (
        f"contract {text[:5]} of {len(text)}",
        _with_contract(_proto(name), text),
        "bad",
    )


def _mutated(rng: Rng, name: str) -> tuple[str, bytes, str]:
    """Damaged bytes: the checksum finds each of them."""
    data = bytearray((shipped() / f"{name}.onnx").read_bytes())
    way = int(rng.integers(3))
    if way == 0:
        data = data[: int(rng.integers(len(data)))]
    elif way == 1:
        place = int(rng.integers(len(data)))
        data[place:place] = bytes(
            rng.integers(256, size=int(rng.integers(1, 60)), dtype=np.uint8)
        )
    else:
        for place in rng.integers(len(data), size=int(rng.integers(1, 9))):
            data[place] ^= 1 << int(rng.integers(8))
    return f"mutated, way {way}", bytes(data), "any" if way == 2 else "bad"
