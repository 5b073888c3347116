from __future__ import annotations

import hashlib
import json

import numpy as np
import onnx
import pytest
import torch
import yaml
from command_line import nics
from onnx import helper
from policy.policy_rig import (
    SECTORS,
    export,
    export_remembering,
    opened_here,  # noqa: F401
    sequence,
)
from robots import direct_model

from extras.foreign_policies import nets
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import BridgeError, ConfigError, PolicyError
from nics_drl_bridge.extras.foreign_policies import (
    export_bundle,
    import_policy,
    leapp_import,
)
from nics_drl_bridge.files import write_bytes, write_text
from nics_drl_bridge.policy.file.contract import shipped
from nics_drl_bridge.policy.file.policy_file import load_policy, policy_of

pytestmark = pytest.mark.usefixtures("opened_here")
KINDS = ("plain", "discrete", "beams", "remembering")


def made(folder, kind):
    """A policy file of a kind, and its task."""
    path = folder / "policy.onnx"
    if kind == "remembering":
        return export_remembering(path)[:2]
    options = {"discrete": {"actions": "discrete"}, "beams": {"scan": None}}.get(
        kind, {}
    )
    return export(path, **options)


def by_name(row, parts):
    """The inputs of a bundle for an observation."""
    zero = np.zeros(1, np.float32)
    goal = row[parts : parts + 3]
    velocity = row[parts + 3 :]
    return {
        "scan": row[:parts],
        "goal": goal,
        "linear_velocity": np.concatenate([velocity[:2], zero]),
        "angular_velocity": np.concatenate([zero, zero, velocity[2:]]),
    }


def described(file):
    return yaml.safe_load(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_comes_back_bit_for_bit(tmp_path, kind):
    policy, _ = made(tmp_path, kind)
    file = export_bundle(policy, tmp_path / "bundle")
    assert import_policy(tmp_path / "bundle") == policy.path.read_bytes()
    assert import_policy(file) == policy.path.read_bytes()


@pytest.mark.slow
def test_the_runner_of_leapp_takes_it_and_gives_the_same(tmp_path):
    leapp = pytest.importorskip("leapp", reason="needs the extra 'leapp'")
    policy, task = made(tmp_path, "remembering")
    manager = leapp.InferenceManager(str(export_bundle(policy, tmp_path / "bundle")))
    assert manager.inputs == [
        f"policy/{name}" for name in by_name(np.zeros(30), SECTORS)
    ]
    kept = policy.contract.state
    for _ in range(2):  # the second time after a reset
        state = np.full((1, kept.size), kept.start, np.float32)
        for row in sequence(task, 6):
            given = by_name(row, task.scan_parts).items()
            out = manager({f"policy/{k}": torch.as_tensor(v[None]) for k, v in given})
            action, command, state = policy.run(row[None], state)
            assert out["policy/action"].numpy() == pytest.approx(action, abs=1e-6)
            assert out["policy/command"].numpy() == pytest.approx(command, abs=1e-6)
        manager.reset()


def test_the_bundle_says_what_it_needs(tmp_path):
    policy, _ = made(tmp_path, "remembering")
    data = described(export_bundle(policy, tmp_path / "bundle"))
    node = data["models"]["policy"]
    assert node["inputs"][0]["kind"] == "state/lidar/sectors"
    command = next(one for one in node["outputs"] if one["name"] == "command")
    assert command["element_names"] == [["linear.x", "linear.y", "angular.z"]]
    assert command["limits"] == [[-2.0, 2.0]] * 3


def test_nics_policy_exports_and_imports_what_is_shipped(tmp_path):
    words = ("policy", "export", "differential", "--leapp", "bundle", "--json")
    (written,) = json.loads(nics(*words, cwd=tmp_path).stdout).values()
    assert (tmp_path / written).parent.name == "bundle"
    words = ("policy", "import", "bundle", "-o", "back.onnx", "--json")
    told = json.loads(nics(*words, cwd=tmp_path).stdout)
    assert told == {"file": "back.onnx", "robot": "differential"}
    assert (tmp_path / "back.onnx").read_bytes() == (
        shipped() / "differential.onnx"
    ).read_bytes()


# Bundles of others.

OPSET = nets.OPSET


def tensor(name, shape, kind=None, names=None):
    data = {"name": name, "dtype": "float32", "shape": shape, "type": "tensor"}
    data |= {} if kind is None else {"kind": kind}
    return data | ({} if names is None else {"element_names": [names]})


def parts():
    """Two networks, a scaling and a policy with a state that counts, and what they mean."""
    first = nets.model_of(
        [
            helper.make_node(
                "Concat", ["scan", "way", "linear", "angular"], ["seen"], axis=1
            ),
            helper.make_node("Div", ["seen", "three"], ["features"]),
        ],
        {"scan": [1, SECTORS], "way": [1, 2], "linear": [1, 3], "angular": [1, 3]},
        {"features": [1, SECTORS + 8]},
        {"three": np.float32(3.0)},
    )
    weights = (
        np.random.default_rng(0).normal(0.0, 0.2, (SECTORS + 8, 4)).astype(np.float32)
    )
    second = nets.model_of(
        [
            helper.make_node("MatMul", ["features", "weights"], ["raw"]),
            helper.make_node("Add", ["raw", "hidden_in"], ["sum"]),
            helper.make_node("Tanh", ["sum"], ["hidden_out"]),
            helper.make_node(
                "Split", ["hidden_out"], ["linear", "spare", "turning"], axis=1
            ),
            helper.make_node("Identity", ["turning"], ["turn"]),
        ],
        {"features": [1, SECTORS + 8], "hidden_in": [1, 4]},
        {"linear": [1, 2], "turn": [1, 1], "hidden_out": [1, 4]},
        {"weights": weights, "lengths": np.int64([2, 1, 1])},
    )
    second.graph.node[3].input.append("lengths")
    layout = {"sectors": SECTORS, "range_max": 3.0}
    scan = tensor("scan", [1, SECTORS], "state/lidar/sectors") | {"scan": layout}
    way = tensor("way", [1, 2], "command/goal", ["goal.x", "goal.y"])
    linear = tensor("linear", [1, 3], "state/body/linear_velocity")
    angular = tensor("angular", [1, 3], "state/body/angular_velocity", ["x", "y", "z"])
    features = tensor("features", [1, SECTORS + 8])
    hidden = [1, 4]
    return {
        "models": {
            "scaling": {"inputs": [scan, way, linear, angular], "outputs": [features]},
            "policy": {
                "inputs": [features, tensor("hidden_in", hidden)],
                "outputs": [
                    tensor("linear", [1, 2], "target/body/linear_velocity", ["x", "y"]),
                    tensor("turn", [1, 1], "target/body/angular_velocity", ["z"]),
                    tensor("hidden_out", hidden),
                ],
            },
        },
        "pipeline": {
            "configs": {"frequency": 10.0},
            "data_flow": {"scaling/features": ["policy/features"]},
            "feedback_flow": {"policy/hidden_out": ["policy/hidden_in"]},
            "inputs": {"scaling": ["scan", "way", "linear", "angular"]},
            # The name of an input, too.
            "outputs": {"policy": ["linear", "turn"]},
        },
        "system information": {"leapp version": "0.7.2"},
    }, {"scaling": first, "policy": second}


def write_foreign(folder, spoil=lambda data, models: None):
    data, models = parts()
    for name, model in models.items():
        content = model.SerializeToString()
        write_bytes(folder / f"{name}.onnx", content)
        data["models"][name]["parameters"] = {
            "model_path": f"{name}.onnx",
            "backend": "onnx",
            "md5sum": hashlib.md5(content).hexdigest(),
            "sha256sum": hashlib.sha256(content).hexdigest(),
        }
    spoil(data, models)
    write_text(folder / "theirs.yaml", dump_yaml(data))
    return folder / "theirs.yaml"


def inputs_of(row):
    distance, cosine, sine, forward, left, turn = row[SECTORS:]
    return {
        "scaling/scan": 3.0 * row[:SECTORS],
        "scaling/way": np.float32([distance * cosine, distance * sine]),
        "scaling/linear": np.float32([forward, left, 0.0]),
        "scaling/angular": np.float32([0.0, 0.0, turn]),
    }


@pytest.mark.slow
def test_a_bundle_of_others_becomes_a_policy_file_by_its_kinds(tmp_path):
    leapp = pytest.importorskip("leapp", reason="needs the extra 'leapp'")

    def pose(data, _):
        goal = {"kind": "command/body/pose", "element_names": [["x", "y"]]}
        data["models"]["scaling"]["inputs"][1] |= goal

    bundle = write_foreign(tmp_path, pose)
    model = direct_model()
    policy = policy_of(import_policy(bundle, model), tmp_path / "ours.onnx")
    task = policy.make_task(model)
    manager = leapp.InferenceManager(str(bundle))
    state = np.full(policy.contract.state.size, policy.contract.state.start, np.float32)
    for row in sequence(task, 8):
        given = {
            key: torch.as_tensor(value[None]) for key, value in inputs_of(row).items()
        }
        out = manager(given)
        wanted = np.concatenate([out["policy/linear"][0], out["policy/turn"][0]])
        _, command, state = policy.run(row, state)
        assert command == pytest.approx(wanted, abs=1e-6)


class Walker(torch.nn.Module):
    """A recurrent policy of others, without a dimension for the batch."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.cell = torch.nn.GRUCell(SECTORS + 2, 5)
        self.head = torch.nn.Linear(5, 3)

    def forward(self, scan, goal, hidden):
        seen = torch.cat([scan / 3.0, goal], dim=-1)
        following = self.cell(seen[None], hidden)
        return torch.tanh(self.head(following))[0], following


@pytest.mark.slow
def test_what_leapp_itself_traces_becomes_a_policy_file(tmp_path):
    leapp = pytest.importorskip("leapp", reason="needs the extra 'leapp'")
    annotate = leapp.annotate
    means = leapp.TensorSemantics
    layout = {"sectors": SECTORS, "range_max": 3.0}
    scan = means(
        "scan", torch.rand(SECTORS), kind="state/lidar/sectors", extra={"scan": layout}
    )
    goal = means(
        "goal", torch.rand(2), kind="command/goal", element_names=["goal.x", "goal.y"]
    )
    leapp.start("walker", save_path=str(tmp_path))
    seen = annotate.input_tensors("walk", [scan, goal])
    hidden = annotate.state_tensors("walk", {"hidden": torch.full((1, 5), 0.25)})
    action, following = Walker()(*seen, hidden)
    annotate.update_state("walk", {"hidden": following})
    names = ["linear.x", "linear.y", "angular.z"]
    done = means("action", action, kind="target/body/velocity", element_names=names)
    annotate.output_tensors("walk", done, export_with="onnx-torchscript")
    leapp.stop()
    leapp.compile_graph(visualize=False)
    model = direct_model()
    policy = policy_of(
        import_policy(tmp_path / "walker", model), tmp_path / "ours.onnx"
    )
    manager = leapp.InferenceManager(str(tmp_path / "walker" / "walker.yaml"))
    state = np.full(policy.contract.state.size, policy.contract.state.start, np.float32)
    for row in sequence(policy.make_task(model), 5):
        way = row[SECTORS] * row[SECTORS + 1 : SECTORS + 3]
        given = {"walk/scan": 3.0 * row[:SECTORS], "walk/goal": way}
        out = manager({key: torch.as_tensor(value) for key, value in given.items()})
        _, command, state = policy.run(row, state)
        assert command == pytest.approx(out["walk/action"].detach().numpy(), abs=1e-6)


@pytest.mark.parametrize(
    ("unit", "divisor"), [("m", 1.0), ("fraction of range_max", 3.0), ("share", 3.0)]
)
def test_a_bundle_of_others_is_driven_by_a_mapping_too(tmp_path, unit, divisor):
    bundle = write_foreign(
        tmp_path, lambda data, _: node(data, "scaling", "inputs", 0, unit=unit)
    )
    model = direct_model()
    path = tmp_path / "mapping.yaml"
    mapping = leapp_import.derive_mapping(leapp_import.read_bundle(bundle), model)
    (scan,) = mapping["inputs"]["scan"]["parts"]
    assert scan == {"of": "scan", "divide": divisor}
    write_text(path, dump_yaml(mapping))
    mine = load_policy(path, model)
    theirs = policy_of(import_policy(bundle, model), tmp_path / "ours.onnx")
    row = sequence(mine.make_task(model), 1)[0]
    state = np.zeros(5, np.float32)
    assert mine.run(row, state)[1].tolist() == theirs.run(row, state)[1].tolist()


def node(data, name, end, k, **changes):
    data["models"][name][end][k].update(changes)


REFUSED = {
    "kind": (
        lambda data, _: node(data, "scaling", "inputs", 1, kind="state/joint/position"),
        "'pipeline.inputs.way': kind 'state/joint/position'",
    ),
    "outputs": (
        lambda data, _: node(
            data, "policy", "outputs", 1, kind="target/joint/position"
        ),
        "none is marked as the robot's velocity",
    ),
    "backend": (
        lambda data, _: data["models"]["policy"]["parameters"].update(backend="jit"),
        "is 'jit', which is not supported; export it with 'onnx'",
    ),
    "damaged": (
        lambda data, _: data["models"]["policy"]["parameters"].update(
            sha256sum="0" * 64
        ),
        "does not match 'policy.onnx', which was changed or damaged",
    ),
    "outside": (
        lambda data, _: data["models"]["policy"]["parameters"].update(
            model_path="../p.onnx"
        ),
        "'../p.onnx' lies outside the bundle",
    ),
    "not connected": (
        lambda data, _: data["pipeline"].update(data_flow={}),
        "no earlier node supplies 'policy/features'",
    ),
    "no such node": (
        lambda data, _: data["pipeline"].update(outputs={"polici": ["linear"]}),
        "names no node 'polici'; did you mean 'policy'",
    ),
    "initial values": (
        lambda data, _: data["pipeline"].update(initial_values="policy.onnx"),
        "is not a valid safetensors file",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_bundle_lacks_is_said_in_one_sentence(tmp_path, name):
    spoil, words = REFUSED[name]
    bundle = write_foreign(tmp_path, spoil)
    with pytest.raises(BridgeError) as refused:
        import_policy(bundle, direct_model())
    assert words in str(refused.value)
    assert str(bundle) in str(refused.value)


def test_a_bundle_of_others_needs_a_robot_and_a_folder_a_bundle(tmp_path):
    bundle = write_foreign(tmp_path)
    with pytest.raises(ConfigError, match="name one with --robot"):
        import_policy(bundle)
    (tmp_path / "empty").mkdir()
    with pytest.raises(PolicyError, match="contains 0 bundle descriptions"):
        import_policy(tmp_path / "empty")


def test_a_changed_export_is_refused(tmp_path):
    policy, _ = made(tmp_path, "plain")
    file = export_bundle(policy, tmp_path / "bundle")
    network = tmp_path / "bundle" / "policy.onnx"
    model = onnx.load(network)
    model.graph.initializer[-1].raw_data = bytes(
        len(model.graph.initializer[-1].raw_data)
    )
    write_bytes(network, model.SerializeToString(deterministic=True))
    data = described(file)
    digest = hashlib.sha256(network.read_bytes()).hexdigest()
    data["models"]["policy"]["parameters"]["sha256sum"] = digest
    write_text(file, dump_yaml(data))
    with pytest.raises(PolicyError, match="changed"):
        policy_of(import_policy(file), tmp_path / "back.onnx")
