"""Policies that take more memory or time than any policy needs: never parsed, never run."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import onnx
import pytest

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy.file import onnx_graph, policy_file
from nics_drl_bridge.policy.file.onnx_session import run_rows
from nics_drl_bridge.policy.file.policy_file import load_policy
from policy.policy_rig import (
    SECTORS,
    bytes_of,
    contract_in,
    export,
    opened_here,  # noqa: F401
    signed,
    with_contract,
)

pytestmark = pytest.mark.usefixtures("opened_here")

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


def dividing(proto):
    """Whole numbers that are known only when it runs; one of them may be 0."""
    return add(
        proto,
        make_node("Cast", ["observation"], ["whole"], to=onnx.TensorProto.INT64),
        make_node("Div", ["whole", "whole"], ["none"]),
    )


def dividing_by_rows(proto):
    """A divisor that is 0 for one number of observations, other than that which is rehearsed."""
    return add(
        proto,
        make_node("Shape", ["observation"], ["shape"]),
        make_node("Gather", ["shape", "first"], ["rows"]),
        make_node("Sub", ["rows", "two"], ["fewer"]),
        make_node("Div", ["least", "fewer"], ["none"]),
        first=np.array(0),
        two=np.array(2),
        least=np.array(-(2**63)),
    )


def growing_with_fewer_rows(proto):
    """A product whose size grows as the number of observations falls."""
    return add(
        proto,
        make_node("Shape", ["observation"], ["shape"]),
        make_node("Gather", ["shape", "first"], ["rows"]),
        make_node("Sub", ["most", "rows"], ["missing"]),
        make_node("Slice", ["weights", "zero", "missing"], ["part"]),
        make_node("Unsqueeze", ["part", "zero"], ["row"]),
        make_node("Unsqueeze", ["part", "one"], ["column"]),
        make_node("Mul", ["row", "column"], ["large"]),
        first=np.array(0),
        most=np.array([256]),
        zero=np.array([0]),
        one=np.array([1]),
        weights=np.zeros(256, np.float32),
    )


def padded(proto):
    """Operators that nothing else uses, so that the policy does the same, but opens slowly."""
    names = ["observation", *(f"unused_{k}" for k in range(4000))]
    return add(proto, *(make_node("Tanh", [a], [b]) for a, b in pairwise(names)))


REFUSED = {
    "operators without use": (padded, "graph.node", "more than the 2000 of a policy"),
    "division of constants": (divided, "graph.node", "may crash the process"),
    "division of whole numbers": (dividing, "graph.node", "may crash the process"),
    "division by rows": (dividing_by_rows, "graph.node", "may crash the process"),
    "sizes by value": (by_value, "graph.node", "can't be known"),
    "sizes by rows": (growing_with_fewer_rows, "graph.node", "can't be known"),
    "shapes that do not fit": (mismatched, "graph", "Incompatible dimensions"),
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


def test_what_fails_only_when_it_runs_is_a_policy_error(file, monkeypatch):
    policy = load_policy(file)
    monkeypatch.setattr(policy, "_run_network", partial(run_rows, None, "file"))
    with pytest.raises(PolicyError, match="onnxruntime can't run it") as failed:
        policy.act(np.zeros(SECTORS + 6, np.float32))
    assert failed.value.field == "graph"


def test_more_observations_than_fit_at_once_are_run_in_parts(file, monkeypatch):
    policy = load_policy(file)
    drawn = np.random.default_rng(0).uniform(0.0, 1.0, (10, SECTORS + 6))
    rows = drawn.astype(np.float32)
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
