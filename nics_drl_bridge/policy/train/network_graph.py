"""ONNX graphs of trained networks: from observations to raw actions, and on to commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from nics_drl_bridge.env.task import Task
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.policy.file import onnx_graph
from nics_drl_bridge.policy.file.contract import Rows
from nics_drl_bridge.policy.train.networks import Actor
from nics_drl_bridge.policy.train.normaliser import LIMIT, compute_bend

OPSET = 17
IR_VERSION = 8  # of that opset; a runtime refuses a version newer than itself
RAW = "raw"  # output of a network: actions before they are clipped, or logits

Standardisation = tuple[ArrayLike, ArrayLike, float]
"""Mean (O,), deviation (O,) and limit of a foreign network's observations."""


class RawNetwork(NamedTuple):
    """A network without the commands; S is the size of its state, if it has one."""

    # ModelProto: maps observations (n, O) to `RAW` (n, C), and states (n, S) to the next ones
    onnx_model: Any
    compute: Callable[..., list[Rows]]  # does the same as `onnx_model`
    state: tuple[int, float] | None = None  # S, and the start value of each element


class GraphBuilder:
    """Adds operators to the graph of a ModelProto."""

    def __init__(self, model: Any) -> None:
        self._graph = model.graph

    def add(
        self, operator: str, *inputs: str | ArrayLike, out: str = "", **attributes: Any
    ) -> str:
        """Adds an operator; returns the name of its output, which is `out` if given.

        Inputs are the names of others' outputs, or constants.
        """
        name = out or f"nics_{len(self._graph.node)}_{operator}"
        names = []
        for values in inputs:
            if isinstance(values, str):
                names.append(values)
                continue
            names.append(f"{name}_{len(names)}")
            constant = np.asarray(values, np.float32)
            self._graph.initializer.append(numpy_helper.from_array(constant, names[-1]))
        node = helper.make_node(operator, names, [name], name, **attributes)
        self._graph.node.append(node)
        return name


def make_raw_network(actor: Actor) -> RawNetwork:
    """Builds the graph of an actor: normaliser and layers."""
    count = len(actor.normaliser.mean)
    outputs = actor.network.widths[-1]
    graph = helper.make_graph(
        [],
        "policy",
        [
            helper.make_tensor_value_info(
                onnx_graph.INPUT, TensorProto.FLOAT, ["n", count]
            )
        ],
        [helper.make_tensor_value_info(RAW, TensorProto.FLOAT, ["n", outputs])],
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION)
    build = GraphBuilder(model).add
    normaliser = actor.normaliser
    factors, offsets = compute_bend(normaliser.shares)
    above = build("Mul", onnx_graph.INPUT, factors)
    below = build("Add", build("Mul", onnx_graph.INPUT, normaliser.shares), offsets)
    shifted = build("Sub", build("Div", above, below), normaliser.mean)
    rows = build("Clip", build("Div", shifted, normaliser.std), -LIMIT, LIMIT)
    *hidden, last = actor.network.layers
    for layer in hidden:
        rows = build("Relu", build("Gemm", rows, layer.matrix, layer.bias, transB=1))
    build("Gemm", rows, last.matrix, last.bias, transB=1, out=RAW)
    return RawNetwork(model, lambda seen: [actor(seen)])


def add_commands(model: Any, task: Task) -> None:
    """Extends a raw network's graph: outputs actions and SI commands (n, C) instead of `RAW`.

    Actions are (n, C) in [-1, 1], or indices (n,) of discrete ones.
    """
    build = GraphBuilder(model).add
    commands = len(task.robot.command)
    if task.actions == "discrete":
        build("ArgMax", RAW, axis=1, keepdims=0, out=onnx_graph.ACTION)
        table = task.discrete_commands
        build("Gather", table, onnx_graph.ACTION, out=onnx_graph.COMMAND)
        action = helper.make_tensor_value_info(
            onnx_graph.ACTION, TensorProto.INT64, ["n"]
        )
    else:
        low, high = task.command_limits
        build("Clip", RAW, -1.0, 1.0, out=onnx_graph.ACTION)
        share = build("Div", build("Add", onnx_graph.ACTION, 1.0), 2.0)
        command = build("Add", build("Mul", share, high - low), low)
        build("Min", build("Max", command, low), high, out=onnx_graph.COMMAND)
        action = helper.make_tensor_value_info(
            onnx_graph.ACTION, TensorProto.FLOAT, ["n", commands]
        )
    command_info = helper.make_tensor_value_info(
        onnx_graph.COMMAND, TensorProto.FLOAT, ["n", commands]
    )
    states = [one for one in model.graph.output if one.name != RAW]
    del model.graph.output[:]
    model.graph.output.extend([action, command_info, *states])
    onnx.checker.check_model(model)


def compute_commands(raw: Rows, task: Task) -> tuple[AnyArray, AnyArray]:
    """Returns actions and commands (n, C) for raw actions (n, C), as `add_commands` does."""
    if task.actions == "discrete":
        indices = raw.argmax(axis=1)
        return indices, task.discrete_commands[indices]
    low, high = task.command_limits
    actions = raw.clip(-1.0, 1.0)
    return actions, np.clip(low + (actions + 1.0) / 2.0 * (high - low), low, high)
