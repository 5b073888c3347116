from __future__ import annotations

import base64
import pickle

import numpy as np
import onnx
import pytest
from robots import DIRECT

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.policy.file import onnx_graph
from nics_drl_bridge.policy.file.contract import GoldenEntry
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.policies import make_policy
from policy.policy_rig import (
    SECTORS,
    bytes_of,
    contract_in,
    export,
    export_remembering,
    model_of,
    opened_here,  # noqa: F401
    signed,
    weight,
    with_contract,
)

pytestmark = pytest.mark.usefixtures("opened_here")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "go.onnx"
    export(path)
    return path


@pytest.mark.slow
def test_a_policy_acts_as_its_network_alone_and_in_batches(file):
    policy = load_policy(file)
    drawn = np.random.default_rng(0).uniform(0.0, 1.0, (5, SECTORS + 6))
    rows = drawn.astype(np.float32)
    actions = policy.act(rows)
    assert actions.shape == (5, 3)
    assert np.abs(actions).max() <= 1.0
    assert policy.act(rows[0]) == pytest.approx(actions[0], abs=1e-6)
    assert policy.command(rows) == pytest.approx(2.0 * actions, abs=1e-6)


def test_make_policy_opens_a_file_and_checks_it_against_the_task(file):
    model = model_of()
    task = make_task("navigation", model, {"scan": SECTORS})
    policy = make_policy(str(file), task, model)
    assert policy.act(np.zeros(SECTORS + 6, np.float32)).shape == (3,)
    with pytest.raises(PolicyError, match=r"field 'scan\.?"):
        make_policy(str(file), make_task("navigation", model, {"scan": 36}), model)
    with pytest.raises(ConfigError, match="did you mean 'dynamic_window'"):
        make_policy("dynamic_widow", task, model)


def test_an_observation_of_another_size_is_refused(file):
    with pytest.raises(PolicyError, match=r"observation\.size"):
        load_policy(file).act(np.zeros(7, np.float32))


# What is refused. Each takes the parsed file and gives the bytes of a spoilt one.

ABSENT = object()


def contract(place, value=ABSENT):
    """An entry of the contract set to another value, or left out, with the hash of the graph."""

    def spoil(proto):
        data = at = contract_in(proto)
        *above, last = place.split(".")
        for key in above:
            at = at[int(key) if isinstance(at, list) else key]
        if value is ABSENT:
            del at[last]
        else:
            at[last] = value
        return bytes_of(signed(proto, data))

    return spoil


def graph(change):
    """A graph that is changed, with its hash in the contract."""

    def spoil(proto):
        change(proto)
        return bytes_of(signed(proto))

    return spoil


def set_weight(proto, value):
    tensor, array = weight(proto)
    array.flat[0] = value
    tensor.CopyFrom(onnx.numpy_helper.from_array(array, tensor.name))


def move_weights(proto):
    tensor, _ = weight(proto)
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key = "location"
    entry.value = "weights.bin"


def add_node(proto, op_type, domain="", **attributes):
    ends = ["observation"], ["unused"]
    node = onnx.helper.make_node(op_type, *ends, domain=domain, **attributes)
    proto.graph.node.append(node)
    if domain:
        proto.opset_import.append(onnx.helper.make_opsetid(domain, 1))


def add_function(proto):
    node = onnx.helper.make_node("Tanh", ["x"], ["y"])
    versions = [onnx.helper.make_opsetid("", 17)]
    made = onnx.helper.make_function("own", "F", ["x"], ["y"], [node], versions)
    proto.functions.append(made)


def take_doubles(proto):
    proto.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.DOUBLE


def forget(proto):
    """The state comes back as it was given."""
    for node in proto.graph.node:
        for names in (node.output, node.input):
            for k, name in enumerate(names):
                names[k] = "forgotten" if name == "state_out" else name
    last = onnx.helper.make_node("Identity", ["state_in"], ["state_out"])
    proto.graph.node.append(last)


def spoil_golden(proto):
    data = contract_in(proto)
    rows = GoldenEntry(**data["golden"]).rows("actions").copy()
    rows[0, 0] += 2e-5
    data["golden"]["actions"] = base64.b64encode(rows.tobytes()).decode()
    return bytes_of(signed(proto, data))


@pytest.fixture(scope="module")
def remembering(tmp_path_factory):
    path = tmp_path_factory.mktemp("remembering") / "go.onnx"
    export_remembering(path)
    return path


def text(words):
    return lambda proto: bytes_of(with_contract(proto, words))


def other_weights(proto):
    set_weight(proto, 0.5)
    return bytes_of(proto)


def no_contract(proto):
    del proto.metadata_props[:]
    return bytes_of(proto)


INNER = onnx.helper.make_graph([], "inner", [], [])
STATE = {"size": 4, "start": 0.0, "longest_gap": 1.0}
REFUSED = {
    "sectors": (contract("scan.sectors", 36), "scan.sectors"),
    "no rate": (contract("control_period", 0.0), "control_period"),
    "task option": (contract("task.options.goal_radius", 3.0), "task.sha256"),
    "other format": (contract("format", "nics_drl_bridge/policy/9"), "format"),
    "size": (contract("observation.size", 31), "observation.size"),
    "missing": (contract("robot"), "robot"),
    # Commands beyond the limits of the robot.
    "a weaker robot": (contract("robot.command.0.max", 0.01), "robot.command"),
    "a state that the graph does not take": (contract("state", STATE), "graph.inputs"),
    "NaN in JSON": (text('{"format": NaN}'), "metadata"),
    "a key twice": (text('{"a": 1, "a": 2}'), "metadata"),
    "no contract": (no_contract, "metadata"),
    "NaN weights": (graph(lambda proto: set_weight(proto, np.nan)), "weights."),
    "other weights": (other_weights, "graph_sha256"),
    "other weights signed": (graph(lambda proto: set_weight(proto, 5.0)), "golden."),
    "external data": (graph(move_weights), "weights."),
    "own operator": (
        graph(lambda proto: add_node(proto, "Evil", "com.example")),
        "graph.node",
    ),
    "graph in a node": (
        graph(lambda proto: add_node(proto, "Identity", body=INNER)),
        "graph.node",
    ),
    "function": (graph(add_function), "graph"),
    "input name": (graph(lambda p: setattr(p.graph.input[0], "name", "o")), "graph"),
    "output name": (graph(lambda p: setattr(p.graph.output[0], "name", "o")), "graph"),
    "input type": (graph(take_doubles), "graph"),
    "golden action": (spoil_golden, "golden.actions"),
    "golden cut": (contract("golden.actions", "AAAA"), "golden.actions"),
    "pickle": (lambda _: pickle.dumps({"weights": [1.0]}), "file"),
    "zip of Stable-Baselines3": (lambda _: b"PK\x03\x04" + bytes(99), "file"),
    "text": (lambda _: b"format: policy\n" * 20, "file"),
    "too large": (lambda _: bytes(onnx_graph.SIZE_LIMIT + 1), "file"),
}
REFUSED_STATES = {
    "none": (contract("state"), "graph.inputs"),
    "another size": (contract("state.size", 5), "graph"),
    "another start": (contract("state.start", 0.5), "golden.actions"),
    "not passed on": (graph(forget), "golden.actions"),
}
CASES = [("file", name, REFUSED) for name in REFUSED]
CASES += [("remembering", name, REFUSED_STATES) for name in REFUSED_STATES]


@pytest.mark.parametrize(("whole", "name", "table"), CASES)
def test_a_spoilt_file_is_refused_and_the_field_named(
    request, tmp_path, whole, name, table
):
    spoil, field = table[name]
    path = tmp_path / "spoilt.onnx"
    path.write_bytes(spoil(onnx.load(request.getfixturevalue(whole))))
    with pytest.raises(PolicyError) as refused:
        load_policy(path)
    assert refused.value.field.startswith(field)
    assert str(refused.value).startswith(f"{path}: field ")
    assert "\n" not in str(refused.value)


def test_a_file_without_its_checksum_or_with_an_addition_is_refused(file, tmp_path):
    path = tmp_path / "changed.onnx"
    path.write_bytes(onnx.load(file).SerializeToString())
    load_policy(path)
    proto = onnx.load(file)
    proto.producer_name = "another"
    for data in (
        proto.SerializeToString(),
        file.read_bytes()[: -len(onnx_graph.add_seal(b""))],
    ):
        path.write_bytes(data)
        with pytest.raises(PolicyError, match=r"field '(file|sha256)'"):
            load_policy(path)


def test_an_observation_without_the_state_that_a_policy_needs_is_refused(
    remembering, file
):
    policy = load_policy(remembering)
    seen = np.zeros((3, SECTORS + 6), np.float32)
    size = policy.contract.state.size
    with pytest.raises(PolicyError, match=rf"field 'state'.*\(3, {size}\), not None"):
        policy.act(seen)
    with pytest.raises(
        PolicyError, match=rf"field 'state'.*\(3, {size}\), not \(2, {size}\)"
    ):
        policy.run(seen, np.zeros((2, size), np.float32))
    with pytest.raises(PolicyError, match=r"field 'state'.*None, not \(3, 4\)"):
        load_policy(file).run(seen, np.zeros((3, 4), np.float32))


# What it runs on.


@pytest.mark.parametrize(
    "changes", [{"beams": 720}, {"range_max": 12.0}, {"rate": 5.0}]
)
def test_any_lidar_that_fills_its_sectors_fits(file, changes):
    model = model_of(**changes)
    assert load_policy(file).make_task(model) is not None


def misfit_model(**changes):
    model = model_of()
    for name, value in changes.items():
        object.__setattr__(model, name, value)
    return model


def robot(**changes):
    return DIRECT.model_copy(update=changes)


FASTER = (DIRECT.command[0].model_copy(update={"max": 3.0}), *DIRECT.command[1:])


@pytest.mark.parametrize(
    ("model", "field"),
    [
        (model_of(angle_min=-1.0, angle_max=1.0), "scan"),
        (model_of(range_max=2.0), "scan"),
        (misfit_model(control_period=0.05), "control_period"),
        (misfit_model(robot=robot(command=FASTER)), "robot.command.0.max"),
        (misfit_model(robot=robot(command=DIRECT.command[:2])), "robot.command.2.name"),
        (misfit_model(robot=robot(footprint_radius=0.5)), "robot.footprint_radius"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_and_the_field_named(file, model, field):
    with pytest.raises(PolicyError) as refused:
        load_policy(file).check_fits(model)
    assert refused.value.field == field


@pytest.mark.parametrize(
    ("name", "options", "field"),
    [
        ("navigation", {"scan": 36}, "scan.sectors"),
        ("navigation", {}, "scan"),
        ("navigation", {"scan": SECTORS, "actions": "discrete"}, "actions"),
        ("cooperative_reaching", {"scan": SECTORS}, "task.name"),
    ],
)
def test_a_task_that_does_not_fit_is_refused_and_the_field_named(
    file, name, options, field
):
    model = model_of()
    with pytest.raises(PolicyError) as refused:
        load_policy(file).check_fits(model, make_task(name, model, options))
    assert refused.value.field.startswith(field)


def test_a_policy_of_beams_needs_the_very_lidar(tmp_path):
    policy, _ = export(tmp_path / "beams.onnx", scan=None)
    policy.make_task(model_of())
    with pytest.raises(PolicyError, match=r"field 'lidar\.beams'"):
        policy.check_fits(model_of(beams=144))
