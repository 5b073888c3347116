"""A small policy and its file, and ways to spoil it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from robots import direct_model, lidar

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.policy.file import onnx_graph, rehearsal
from nics_drl_bridge.policy.file.onnx_session import check_network
from nics_drl_bridge.policy.train.export import export_policy

SECTORS = 24


@pytest.fixture
def opened_here(monkeypatch):
    """Networks are checked in this process, which is quicker than in one of their own."""

    def answer(request):
        runs, _, data = request.partition(b"\n")
        try:
            check_network(data, "policy", json.loads(runs))
        except PolicyError as error:
            return error.field, error.reason

    monkeypatch.setattr(rehearsal, "_answer_of", answer)


def model_of(**changes):
    return direct_model(sensor=lidar(**changes))


def network(inputs: int, outputs: int) -> torch.nn.Module:
    torch.manual_seed(0)
    layers = torch.nn.Linear(inputs, 16), torch.nn.Tanh(), torch.nn.Linear(16, outputs)
    return torch.nn.Sequential(*layers)


def export(path: Path, model=None, normaliser=None, **options):
    model = model or model_of()
    task = make_task("navigation", model, {"scan": SECTORS} | options)
    size = task.observation_space.shape[0]
    outputs = 9 if task.actions == "discrete" else 3
    made = {"command": "a test", "seed": 3}
    return export_policy(
        network(size, outputs), task, model, path, normaliser, made
    ), task


def bytes_of(proto) -> bytes:
    """The content of a file with a checksum that is right again."""
    for entry in [one for one in proto.metadata_props if one.key == onnx_graph.SEAL]:
        proto.metadata_props.remove(entry)
    return onnx_graph.add_seal(proto.SerializeToString(deterministic=True))


def contract_in(proto) -> dict:
    return json.loads(onnx_graph.find_contract_text(proto, "file"))


def signed(proto, data: dict | None = None):
    """The file with a contract that has the hash of its graph."""
    data = contract_in(proto) if data is None else data
    data["graph_sha256"] = onnx_graph.hash_graph(proto)
    return with_contract(proto, json.dumps(data))


def with_contract(proto, text: str):
    onnx.helper.set_model_props(proto, {onnx_graph.KEY: text})
    return proto


def weight(proto):
    """The first weight, as an array that can be put back."""
    tensor = proto.graph.initializer[0]
    return tensor, np.array(onnx.numpy_helper.to_array(tensor))


class Remembering(torch.nn.Module):
    """A network with a state, whose actions differ from step to step."""

    state_size = 6
    state_start = 0.25

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.keep = torch.nn.Linear(inputs + self.state_size, self.state_size)
        self.act = torch.nn.Linear(self.state_size, outputs)

    def forward(self, seen: torch.Tensor, state: torch.Tensor):
        following = torch.tanh(self.keep(torch.cat([seen, state], 1)))
        return self.act(following), following


def export_remembering(path: Path, model=None, **options):
    model = model or model_of()
    task = make_task("navigation", model, {"scan": SECTORS} | options)
    outputs = 9 if task.actions == "discrete" else len(model.robot.command)
    network = Remembering(task.observation_space.shape[0], outputs)
    return export_policy(network, task, model, path), task, network


def sequence(task, steps: int, *lead: int, seed: int = 1):
    """Observations (T, ..., O) within their limits."""
    space = task.observation_space
    rng = np.random.default_rng(seed)
    low = np.maximum(space.low, -2.0)
    high = np.minimum(space.high, 2.0)
    return rng.uniform(low, high, (steps, *lead, len(low))).astype(np.float32)
