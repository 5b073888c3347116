"""Networks of others, made by hand, with the mappings that say what they mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.files import write_bytes, write_text

SECTORS = 24
FAR = 3.0  # of the scan [m]
UNITS = 4  # of the state of `with_gru`
OPSET = 17


def model_of(nodes, inputs, outputs, weights, opset=OPSET):
    def ends(some):
        return [
            helper.make_tensor_value_info(name, kind, shape)
            for name, (shape, kind) in {
                name: one if isinstance(one, tuple) else (one, TensorProto.FLOAT)
                for name, one in some.items()
            }.items()
        ]

    arrays = [
        numpy_helper.from_array(np.asarray(v), name) for name, v in weights.items()
    ]
    graph = helper.make_graph(nodes, "theirs", ends(inputs), ends(outputs), arrays)
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8
    )


def three():
    """Scan (n, 1, S), goal (n, 2) and velocity (n, 2): turns to the goal, the slower the more."""
    towards = np.zeros((SECTORS + 4, 1), np.float32)
    towards[:SECTORS, 0] = 0.02 * np.sin(np.arange(SECTORS))
    # by bearing and turn rate
    towards[SECTORS + 1] = 4.0
    towards[SECTORS + 3] = -0.1
    weights = {
        "shape": np.int64([-1, SECTORS]),
        "towards": towards,
        "full": np.float32([[0.9]]),
    }
    nodes = [
        helper.make_node("Reshape", ["scan", "shape"], ["beams"]),
        helper.make_node("Concat", ["beams", "goal", "velocity"], ["seen"], axis=1),
        helper.make_node("MatMul", ["seen", "towards"], ["bent"]),
        helper.make_node("Tanh", ["bent"], ["left"]),
        helper.make_node("Abs", ["left"], ["bend"]),
        helper.make_node("Sub", ["full", "bend"], ["ahead"]),
        helper.make_node("Concat", ["ahead", "left"], ["action"], axis=1),
    ]
    inputs = {"scan": ["n", 1, SECTORS], "goal": ["n", 2], "velocity": ["n", 2]}
    made = model_of(nodes, inputs, {"action": ["n", 2]}, weights)
    # A domain of which there is no operator does no harm.
    made.opset_import.append(helper.make_opsetid("ai.onnx.ml", 2))
    return made


def three_mapping():
    return {
        "kind": "foreign policy",
        "network": "net.onnx",
        "robot": "differential",
        "control_period": 0.1,
        "scan": {"sectors": SECTORS, "range_max": FAR},
        "inputs": {
            "scan": {"parts": [{"of": "scan"}], "divide": FAR},
            "goal": {
                "parts": [
                    {"of": "goal.distance", "divide": 5.0, "clip": [0.0, 1.0]},
                    {"of": "goal.bearing", "divide": float(np.pi)},
                ]
            },
            "velocity": {
                "parts": [{"of": "velocity.forward"}, {"of": "velocity.turn"}]
            },
        },
        "outputs": {
            "forward": {
                "of": "action",
                "index": 0,
                "limits": [0.0, 1.0],
                "multiply": 0.6,
            },
            "turn": {"of": "action", "index": 1, "multiply": 1.5, "clip": [-1.2, 1.2]},
        },
    }


FLAT = 2 * SECTORS + 5


def chooser(least=0.0, most=2.0):
    """A whole number between limits: by how many metres the goal (n, 1) is farther than 2 m."""
    nodes = [
        helper.make_node("Reshape", ["goal", "shape"], ["distance"]),
        helper.make_node("Sub", ["distance", "near"], ["farther"]),
        helper.make_node("Max", ["farther", "least"], ["bounded"]),
        helper.make_node("Min", ["bounded", "most"], ["within"]),
        helper.make_node("Cast", ["within"], ["choice"], to=TensorProto.INT32),
    ]
    weights = {
        "shape": np.int64([-1]),
        "near": np.float32([2.0]),
        "least": np.float32([least]),
        "most": np.float32([most]),
    }
    return model_of(
        nodes, {"goal": ["n", 1]}, {"choice": (["n"], TensorProto.INT32)}, weights
    )


def chooser_mapping():
    """Chooses among three commands."""
    data = three_mapping()
    del data["outputs"]
    commands = [{}, {"forward": 0.5}, {"turn": 1.0}]
    return data | {
        "inputs": {"goal": {"parts": [{"of": "goal.distance"}]}},
        "choices": {"of": "choice", "commands": commands},
    }


def flat():
    """One vector of 64-bit numbers, fixed to one row, and a choice of five commands."""
    rng = np.random.default_rng(3)
    weights = {
        "first": rng.normal(0.0, 0.3, (FLAT, 8)),
        "second": rng.normal(0.0, 1.0, (8, 5)),
    }
    nodes = [
        helper.make_node("MatMul", ["obs", "first"], ["hidden"]),
        helper.make_node("Tanh", ["hidden"], ["bent"]),
        helper.make_node("MatMul", ["bent", "second"], ["logits"]),
    ]
    kind = TensorProto.DOUBLE
    return model_of(
        nodes, {"obs": ([1, FLAT], kind)}, {"logits": ([1, 5], kind)}, weights
    )


def flat_numbers():
    rng = np.random.default_rng(4)
    return rng.normal(0.0, 0.5, FLAT).round(3), rng.uniform(0.5, 2.0, FLAT).round(3)


def flat_mapping():
    mean, std = (tuple(some.tolist()) for some in flat_numbers())
    scan = {"of": "scan", "clockwise": True, "limits": [0.3, 2.5], "history": 2}
    return {
        "kind": "foreign policy",
        "network": "net.onnx",
        "scan": {"sectors": SECTORS, "range_max": FAR},
        "inputs": {
            "obs": {
                "parts": [
                    {"of": "last.turn"},
                    {"of": "goal.y"},
                    {"of": "goal.x"},
                    {**scan, "newest_first": True},
                    {"of": "velocity.turn"},
                    {"of": "constant", "value": 0.25},
                ],
                "subtract": mean,
                "divide": std,
                "clip": [-4.0, 4.0],
            }
        },
        "choices": {
            "of": "logits",
            "commands": [
                {},
                {"forward": 0.5},
                {"forward": 0.3, "turn": 1.0},
                {"forward": 0.3, "turn": -1.0},
                {"turn": 0.7},
            ],
        },
    }


SEEN = SECTORS + 5


def with_gru():
    """A recurrent unit of ONNX over sequences (1, 1, I), whose state begins with 0.5."""
    rng = np.random.default_rng(5)
    weights = {
        "W": rng.normal(0.0, 0.6, (1, 3 * UNITS, SEEN)).astype(np.float32),
        "R": rng.normal(0.0, 0.6, (1, 3 * UNITS, UNITS)).astype(np.float32),
        "head": rng.normal(0.0, 1.0, (UNITS, 2)).astype(np.float32),
        "row": np.int64([1, UNITS]),
    }
    gru = ["obs", "W", "R", "", "", "hidden"]
    nodes = [
        helper.make_node(
            "GRU", gru, ["", "following"], hidden_size=UNITS, linear_before_reset=1
        ),
        helper.make_node("Reshape", ["following", "row"], ["last"]),
        helper.make_node("MatMul", ["last", "head"], ["mean"]),
        helper.make_node("Tanh", ["mean"], ["action"]),
    ]
    inputs = {"obs": [1, "n", SEEN], "hidden": [1, "n", UNITS]}
    return model_of(
        nodes, inputs, {"action": [1, 2], "following": [1, "n", UNITS]}, weights
    )


def with_gru_mapping():
    return {
        "kind": "foreign policy",
        "network": "net.onnx",
        "scan": {"sectors": SECTORS, "range_max": FAR},
        "inputs": {
            "obs": {
                "parts": [
                    {"of": "scan", "subtract": FAR, "divide": -FAR},
                    {"of": "goal.distance"},
                    {"of": "goal.cosine"},
                    {"of": "goal.sine"},
                    {"of": "last.output", "output": "action"},
                ]
            }
        },
        "states": {"hidden": {"next": "following", "start": 0.5}},
        "outputs": {
            "forward": {"of": "action", "index": 0, "multiply": 0.5, "add": 0.5},
            "turn": {"of": "action", "index": 1},
        },
    }


NETS = {
    "three": (three, three_mapping),
    "flat": (flat, flat_mapping),
    "gru": (with_gru, with_gru_mapping),
    "chooser": (chooser, chooser_mapping),
}


def write(folder: Path, name: str, **changes) -> Path:
    """Writes a network and its mapping; returns the mapping's path."""
    network, mapping = NETS[name]
    write_bytes(folder / "net.onnx", network().SerializeToString())
    return write_mapping(folder, mapping() | changes)


def write_mapping(folder: Path, data: dict) -> Path:
    path = folder / "foreign.yaml"
    write_text(path, dump_yaml(data))
    return path
