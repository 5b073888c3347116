"""Policies that take more memory or time than any policy needs: never parsed, never run."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import onnx
import pytest

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy import onnx_graph, policy_file
from nics_drl_bridge.policy.onnx_graph import (
    MOST_NESTED,
    MOST_PACKED,
    MOST_PARTS,
)
from nics_drl_bridge.policy.policy_file import load_policy
from policy.policy_rig import (
    SECTORS,
    bytes_of,
    contract_in,
    export,
    signed,
    with_contract,
)

make_node = onnx.helper.make_node
from_array = onnx.numpy_helper.from_array


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "go.onnx"
    export(path)
    return path


def add(proto, *nodes, **arrays):
    """Puts nodes in front of a graph's own, with weights by name."""
    graph = proto.graph
    graph.initializer.extend(from_array(value, name) for name, value in arrays.items())
    own = list(graph.node)
    del graph.node[:]
    graph.node.extend([*nodes, *own])
    return bytes_of(signed(proto))


def wide(proto):
    """Sixteen observations fit into the memory, the 256 that may be run at once do not."""
    for node in proto.graph.node:
        node.input[:] = [
            "cut" if name == "observation" else name for name in node.input
        ]
    names = ["observation", *(f"d{k}" for k in range(15))]
    nodes = [make_node("Concat", [a, a], [b], axis=1) for a, b in pairwise(names)]
    nodes.append(make_node("Slice", [names[-1], "from_", "to_", "one"], ["cut"]))
    ends = {"from_": [0], "to_": [SECTORS + 6], "one": [1]}
    return add(proto, *nodes, **{name: np.int64(end) for name, end in ends.items()})


def by_value(proto):
    """A size that only the observation tells."""
    return add(
        proto,
        make_node("Cast", ["observation"], ["whole"], to=onnx.TensorProto.INT64),
        make_node("Slice", ["whole", "zero", "one", "one"], ["first"]),
        make_node("Slice", ["observation", "zero", "one", "one"], ["row"]),
        make_node("Reshape", ["first", "flat"], ["sizes"]),
        make_node("Slice", ["row", "sizes", "sizes"], ["cut"]),
        zero=np.array([0]),
        one=np.array([1]),
        flat=np.array([-1]),
    )


def mismatched(proto):
    proto.graph.initializer.append(from_array(np.zeros((3, 5), np.float32), "wrong"))
    return add(proto, make_node("MatMul", ["observation", "wrong"], ["never"]))


def sparse(proto):
    made = make_node("Constant", [], ["dense"])
    values = from_array(np.ones(1, np.float32), "v")
    index = from_array(np.zeros(1, np.int64), "i")
    value = onnx.helper.make_sparse_tensor(values, index, [2**31])
    made.attribute.append(onnx.helper.make_attribute("sparse_value", value))
    return add(proto, made)


def divided(proto):
    """A quotient that no 64 bits hold; the processor's answer to it ends the process."""
    least = np.array([-(2**63)], np.int64)
    minus = np.array([-1], np.int64)
    return add(
        proto, make_node("Div", ["least", "minus"], ["none"]), least=least, minus=minus
    )


REFUSED = {
    "division of whole numbers": (divided, "graph.node", "may crash the process"),
    "memory": (wide, "graph", "can't run it|takes more than"),
    "sizes by value": (by_value, "graph.node", "can't be known"),
    "shapes that do not fit": (mismatched, "graph", "are inconsistent"),
    "sparse weights": (sparse, "graph.node", "sparse"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_graph_that_grows_is_refused_before_the_runtime_sees_it(
    file, tmp_path, monkeypatch, name
):
    spoil, field, words = REFUSED[name]
    path = tmp_path / "grows.onnx"
    path.write_bytes(spoil(onnx.load(file)))
    monkeypatch.setattr(
        policy_file, "open_session", lambda *_: pytest.fail("it was opened")
    )
    with pytest.raises(PolicyError, match=words) as refused:
        load_policy(path)
    assert refused.value.field == field
    assert "\n" not in str(refused.value)


def test_a_graph_of_very_many_operators_is_refused(file, tmp_path):
    names = [f"n{k}" for k in range(onnx_graph.MOST_NODES + 1)]
    nodes = [make_node("Identity", ["observation"], [name]) for name in names]
    path = tmp_path / "many.onnx"
    path.write_bytes(add(onnx.load(file), *nodes))
    with pytest.raises(PolicyError, match=r"has 10\d\d operators"):
        load_policy(path)


def test_what_fails_only_when_it_runs_is_a_policy_error(file, monkeypatch):
    policy = load_policy(file)
    monkeypatch.setattr(policy, "_session", None)
    with pytest.raises(PolicyError, match="onnxruntime can't run it") as failed:
        policy.act(np.zeros(SECTORS + 6, np.float32))
    assert failed.value.field == "graph"


def test_more_observations_than_fit_at_once_are_run_in_parts(file, monkeypatch):
    policy = load_policy(file)
    rows = (
        np.random.default_rng(0).uniform(0.0, 1.0, (10, SECTORS + 6)).astype(np.float32)
    )
    expected = policy.act(rows)
    monkeypatch.setattr(onnx_graph, "MOST_ROWS", 3)
    assert policy.act(rows) == pytest.approx(expected, abs=1e-6)
    assert policy.act(rows[:0]).shape == (0, 3)


@pytest.mark.parametrize("entry", ["format", "robot", "actions"])
def test_megabytes_in_a_field_are_not_told(file, tmp_path, entry):
    proto = onnx.load(file)
    data = contract_in(proto)
    data[entry] = "x" * 2_000_000
    path = tmp_path / "long.onnx"
    path.write_bytes(bytes_of(signed(proto, data)))
    with pytest.raises(PolicyError) as refused:
        load_policy(path)
    assert len(str(refused.value)) < 400 + len(str(path))


@pytest.mark.parametrize(
    "text",
    [
        "[" * 3_000_000,
        '{"a":[' + "[]," * 500_000 + "0]}",
        '"' + "x" * (5 * 2**20) + '"',
    ],
)
def test_a_contract_of_very_many_entries_or_characters_is_not_read(
    file, tmp_path, text
):
    path = tmp_path / "large.onnx"
    path.write_bytes(bytes_of(with_contract(onnx.load(file), text)))
    with pytest.raises(PolicyError, match="more than") as refused:
        load_policy(path)
    assert refused.value.field == "metadata"


GRAPH, NODE, ATTRIBUTE, SUBGRAPH = 7, 1, 5, 6
"""Numbers of the fields of onnx.proto."""


def field(number: int, content: bytes) -> bytes:
    size = len(content)
    length = b""
    while size >= 0x80:
        length = length + bytes([size & 0x7F | 0x80])
        size = size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


def many() -> bytes:
    return field(GRAPH, field(NODE, b"") * 3_000_000)


def deep() -> bytes:
    content = b""
    for _ in range(MOST_NESTED):
        content = field(NODE, field(ATTRIBUTE, field(SUBGRAPH, content)))
    return field(GRAPH, content)


def packed() -> bytes:
    return field(GRAPH, field(5, field(1, bytes(MOST_PACKED + 1))))


BAD = {
    "millions of operators": (many, f"more than {MOST_PARTS} fields"),
    "a graph in a graph in a graph": (deep, f"more than {MOST_NESTED} levels"),
    "a million sizes": (packed, "'dims'"),
    "a group": (lambda: b"\x0b\x0c", "not an ONNX model"),
    "an endless number": (lambda: b"\x08" + b"\xff" * 11, "not an ONNX model"),
    "cut off": (lambda: field(GRAPH, b"abc")[:-1], "truncated"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_grows_when_it_is_parsed_is_not_parsed(tmp_path, monkeypatch, name):
    make, words = BAD[name]
    path = tmp_path / "bad.onnx"
    path.write_bytes(make())
    monkeypatch.setattr(
        onnx, "load_model_from_string", lambda _: pytest.fail("it was parsed")
    )
    with pytest.raises(PolicyError, match=words) as refused:
        load_policy(path)
    assert refused.value.field == "file"
