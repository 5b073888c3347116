"""What networks compute of shapes is folded; what is large, divides by zero or grows is not."""

from __future__ import annotations

import itertools

import numpy as np
import onnx
import pytest

from nics_drl_bridge.policy.graph_folding import fold_shapes
from nics_drl_bridge.policy.onnx_graph import INTEGERS
from policy.foreign_nets import model_of

node = onnx.helper.make_node


def folded(nodes, weights, opset=17):
    """A graph of one input (1, 20) after it was folded, and the shape of its output y."""
    model = model_of(nodes, {"x": [1, 20]}, {"y": None}, weights, opset)
    shape = fold_shapes(model.graph, opset)["y"]
    return model, shape


@pytest.mark.parametrize("opset", [8, 10, 12])
def test_sizes_are_folded_as_each_opset_says_them(opset):
    slice_ = node("Slice", ["shape"], ["cut"], starts=[1], ends=[2])
    if opset >= 10:
        slice_ = node("Slice", ["shape", "one", "two"], ["cut"])
    nodes = [
        node("Shape", ["x"], ["shape"]),
        slice_,
        node("Squeeze", ["cut"], ["size"], axes=[0]),
        node("Div", ["size", "five"], ["fifth"]),
        node("Unsqueeze", ["fifth"], ["row"], axes=[0]),
        node("Concat", ["row", "minus"], ["sizes"], axis=0),
        node("Reshape", ["x", "sizes"], ["y"]),
    ]
    numbers = {"one": [1], "two": [2], "minus": [-1], "five": 5}
    model, shape = folded(
        nodes, {name: np.int64(n) for name, n in numbers.items()}, opset
    )
    assert shape == (4, 5)
    assert [one.op_type for one in model.graph.node] == ["Reshape"]
    (sizes,) = model.graph.initializer  # without those that nothing takes any more
    assert onnx.numpy_helper.to_array(sizes).tolist() == [4, -1]


def test_a_part_of_a_shape_is_what_the_runtime_gives():
    for start, end in ((0, 1), (-1, None), (1, 9), (-9, -1)):
        ends = {"start": start} | ({} if end is None else {"end": end})
        model, _ = folded([node("Shape", ["x"], ["y"], **ends)], {})
        (found,) = model.graph.initializer
        assert onnx.numpy_helper.to_array(found).tolist() == [1, 20][start:end]


WHOLE = np.arange(1024)
LEFT = {
    "large": ([node("Add", ["a", "b"], ["y"])], {"a": WHOLE, "b": WHOLE[:, None]}),
    "by zero": (
        [node("Div", ["a", "b"], ["y"])],
        {"a": np.int64([3]), "b": np.int64([0])},
    ),
    "overflow": (
        [node("Div", ["a", "b"], ["y"])],
        {"a": np.int64([-(2**63)]), "b": -WHOLE[1:2]},
    ),
    "no weights": ([node("Neg", ["x"], ["y"])], {}),
    "no whole numbers": ([node("Add", ["a", "a"], ["y"])], {"a": np.float32([1.0])}),
}


@pytest.mark.parametrize("name", LEFT)
def test_all_else_is_left_as_it_is(name):
    nodes, weights = LEFT[name]
    model, _ = folded(nodes, weights)
    assert list(model.graph.node) == nodes
    assert {one.name for one in model.graph.initializer} == set(weights)


def test_arrays_that_double_are_folded_while_they_are_small():
    names = ["a", *(f"c{k}" for k in range(40)), "y"]
    nodes = [node("Concat", [a, a], [b], axis=0) for a, b in itertools.pairwise(names)]
    model, _ = folded(nodes, {"a": np.arange(9)})
    small = [one for one in model.graph.initializer if one.data_type in INTEGERS]
    assert len(model.graph.node) > 30
    assert sum(len(one.raw_data) for one in small) < 2**14
