from __future__ import annotations

import json

import numpy as np
import onnx
import onnxruntime
import pytest
from policy.policy_rig import opened_here  # noqa: F401

from extras.foreign_policies import nets
from extras.foreign_policies.nets import FAR, SECTORS, UNITS, write, write_mapping
from nics_drl_bridge.commands.episodes import FAST, EvaluationOrder, evaluate
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import BridgeError, ConfigError, PolicyError
from nics_drl_bridge.extras.foreign_policies import import_policy
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.policy.evaluation import drive_worlds
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.policies import open_policy

pytestmark = pytest.mark.usefixtures("opened_here")
CORNERS = (0.0, 1e-4, np.pi / 2, 3.1415, -1e-4, -1.6, -3.1415)
"""Bearings at which a part of the graph that computes them changes [rad]."""
TWISTS = np.array([[0, 0], [0.5, 0], [0.3, 1.0], [0.3, -1.0], [0, 0.7]])


@pytest.fixture(scope="module")
def robot():
    return builtin_model("differential")


def session(folder):
    return onnxruntime.InferenceSession(str(folder / "net.onnx"))


def seen(steps: int = 16):
    """Observations (T, O) of a robot somewhere: shares of a scan, goal, velocity."""
    rng = np.random.default_rng(1)
    shares = rng.uniform(0.0, 1.0, (steps, SECTORS))
    bearing = rng.uniform(-3.1, 3.1, steps)
    bearing[: len(CORNERS)] = CORNERS[:steps]
    distance = rng.uniform(0.1, 8.0, steps)
    velocity = rng.uniform(-0.5, 0.5, (steps, 3))
    goal = np.stack([distance, np.cos(bearing), np.sin(bearing)], axis=-1)
    rows = np.concatenate([shares, goal, velocity], axis=-1).astype(np.float32)
    return rows, bearing


def commands_of(path, robot, rows):
    """What the policy commands in SI, observation after observation of an episode."""
    policy = load_policy(path, robot)
    kept = policy.contract.state
    state = None
    commands = []
    if kept is not None:
        state = np.full(kept.size, kept.start, np.float32)
    for row in rows:
        _, command, *following = policy.run(row, state)
        state = following[0] if following else None
        commands.append(command)
    return np.array(commands)


def test_a_whole_number_chooses_a_command(tmp_path, robot):
    rows, _ = seen(20)
    found = commands_of(write(tmp_path, "chooser"), robot, rows)
    choices = np.clip(rows[:, SECTORS] - 2.0, 0.0, 2.0).astype(int)
    assert set(choices) == {0, 1, 2}
    assert found == pytest.approx(
        np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 1.0]])[choices]
    )


@pytest.mark.parametrize("limits", [(-1.0, -1.0), (3.0, 3.0)])
def test_a_whole_number_that_chooses_nothing_is_no_command(tmp_path, robot, limits):
    path = write(tmp_path, "chooser")
    write_bytes(tmp_path / "net.onnx", nets.chooser(*limits).SerializeToString())
    with pytest.raises(PolicyError, match="returns NaN or inf"):
        open_policy(str(path), robot)


def test_an_evaluation_keeps_what_was_driven_before_a_command_that_is_none(tmp_path):
    path = write(tmp_path, "chooser")
    # Beyond the last command from 5 m on, farther than where policies are tried as they are opened.
    network = nets.chooser(0.0, 3.0)
    write_bytes(tmp_path / "net.onnx", network.SerializeToString())
    world = tmp_path / "far.yaml"
    world.write_text("name: far\nsize: [16.0, 16.0]\ngoal_distance: [6.0, 7.0]\n")
    policies = ["straight", str(path)]
    out = tmp_path / "out"
    order = EvaluationOrder(
        policies, out, "differential", str(world), 1, places=(FAST,)
    )
    with pytest.raises(ConfigError, match="action in step 1 contains NaN or inf"):
        evaluate(order, lambda _: None, lambda *_: None)
    kept = json.loads((out / "evaluation.json").read_text())
    assert list(kept["policies"]) == ["straight"]


# What it commands is what the network alone says of inputs that are made by hand.


def test_a_network_of_three_inputs_commands_what_it_gives(tmp_path, robot):
    rows, bearing = seen()
    found = commands_of(write(tmp_path, "three"), robot, rows)
    net = session(tmp_path)
    for row, angle, command in zip(rows, bearing, found, strict=True):
        goal = [min(row[SECTORS] / 5.0, 1.0), angle / np.pi]
        feeds = {
            "scan": row[None, None, :SECTORS],
            "goal": np.float32([goal]),
            "velocity": row[None, [SECTORS + 3, SECTORS + 5]],
        }
        (action,) = net.run(None, feeds)[0]
        wanted = [
            0.6 * np.clip(action[0], 0.0, 1.0),
            np.clip(1.5 * action[1], -1.2, 1.2),
        ]
        assert command == pytest.approx(wanted, abs=1e-6)


def test_a_flat_vector_has_its_own_order_numbers_and_history(tmp_path, robot):
    rows, bearing = seen()
    found = commands_of(write(tmp_path, "flat"), robot, rows)
    net, (mean, std) = session(tmp_path), nets.flat_numbers()
    before = None
    turn = 0.0
    for row, angle, command in zip(rows, bearing, found, strict=True):
        scan = np.clip(FAR * row[:SECTORS][::-1], 0.3, 2.5)
        x = row[SECTORS] * np.cos(angle)
        y = row[SECTORS] * np.sin(angle)
        before = scan if before is None else before
        flat = np.concatenate([[turn, y, x], scan, before, [row[SECTORS + 5], 0.25]])
        logits = net.run(None, {"obs": np.clip((flat - mean) / std, -4.0, 4.0)[None]})[
            0
        ]
        wanted = TWISTS[logits.argmax()]
        assert command == pytest.approx(wanted, abs=1e-6)
        before = scan
        turn = wanted[1]
    assert len({tuple(command) for command in found.round(3)}) > 1


def test_a_recurrent_network_keeps_its_state_and_its_last_output(tmp_path, robot):
    rows, _ = seen()
    found = commands_of(write(tmp_path, "gru"), robot, rows)
    net = session(tmp_path)
    hidden = np.full((1, 1, UNITS), 0.5, np.float32)
    last = np.zeros(2, np.float32)
    for row, command in zip(rows, found, strict=True):
        goal = row[SECTORS : SECTORS + 3]
        obs = np.concatenate([1.0 - row[:SECTORS], goal, last]).astype(np.float32)
        action, hidden = net.run(None, {"obs": obs[None, None], "hidden": hidden})
        last = action[0]
        assert command == pytest.approx([0.5 * last[0] + 0.5, last[1]], abs=1e-6)
    fresh = np.array(
        [commands_of(tmp_path / "foreign.yaml", robot, [row])[0] for row in rows]
    )
    assert np.abs(found[1:] - fresh[1:]).max() > 0.01  # its state matters


@pytest.mark.parametrize("name", ["ackermann", "tricycle"])
def test_turn_rates_become_the_steering_angles_of_a_car(tmp_path, name):
    model, (rows, _) = builtin_model(name), seen()
    path = write(tmp_path, "three", robot=None)
    policy, task = open_policy(str(path), model)
    twists = commands_of(path, builtin_model("differential"), rows).astype(float)
    speed, angle = model.robot.bicycle.command(np.insert(twists, 1, 0.0, axis=1))
    wanted = np.clip(np.stack([speed, angle], axis=1), *task.command_limits)
    assert np.abs(wanted[:, 1]).max() > 0.1
    assert policy.command(rows) == pytest.approx(wanted, abs=1e-5)


# It is a policy like any other.


def test_it_drives_to_the_goal(tmp_path, robot):
    path = write(tmp_path, "three")
    policy, task = open_policy(str(path), robot)
    env = BridgeVectorEnv(8, robot, "empty", task=task, max_episode_steps=300)
    assert drive_worlds(env, policy.act, range(8)).success.mean() == 1.0


def test_it_becomes_a_policy_file(tmp_path, robot):
    rows, _ = seen()
    path = write(tmp_path, "gru")
    file = tmp_path / "ours.onnx"
    write_bytes(file, import_policy(path, robot))
    assert (
        commands_of(file, None, rows).tolist()
        == commands_of(path, robot, rows).tolist()
    )
    assert load_policy(file).contract.robot.name == robot.robot.name


# What is refused: one sentence with the place, what is wrong, and what to do.


def changed(path, value):
    """An entry of the mapping with another value; None takes it out."""

    def spoil(data):
        *above, last = path.split("/")
        at = data
        for key in above:
            at = at[int(key)] if isinstance(at, list) else at[key]
        if value is None:
            del at[last]
        else:
            at[last] = value

    return spoil


SPOILT = {
    "kind": (changed("kind", "policy"), "not the mapping of a foreign policy"),
    "no network": (changed("network", "nets.onnx"), "'nets.onnx' does not exist"),
    "pickle": (changed("network", "net.pt"), "must be an .onnx file or a LEAPP bundle"),
    "unknown key": (
        changed("output", {}),
        "unknown key 'output'; did you mean 'outputs'",
    ),
    "unknown input": (
        changed("inputs/scann", {"parts": [{"of": "scan"}]}),
        "'inputs.scann': the network has no such input; did you mean 'scan'?",
    ),
    "missing input": (
        changed("inputs/velocity", None),
        "'inputs.velocity': the network has this input",
    ),
    "unknown quantity": (
        changed("inputs/goal/parts/0/of", "goal.range"),
        "goal.distance",
    ),
    "wrong shape": (
        changed("scan", {"sectors": 20, "range_max": FAR}),
        "the network takes (1, 1, 24), but the parts have 20 (scan 20)",
    ),
    "unknown output": (changed("outputs/turn/of", "acton"), "did you mean 'action'?"),
    "missing output": (changed("outputs/turn", None), "'outputs.turn': is missing"),
    "left": (changed("outputs/left", {"of": "action"}), "'outputs.left': the robot"),
    "index": (
        changed("outputs/turn/index", 2),
        "is 2, but the output 'action' has only 2 elements",
    ),
    "no such command": (changed("outputs/speed", {"of": "action"}), "no such command"),
    "divide": (changed("inputs/scan/divide", 0.0), "must not be 0"),
    "numbers": (
        changed("inputs/scan/divide", [1.0, 2.0]),
        "has 2 numbers, but 24 are needed",
    ),
    "limits": (changed("inputs/scan/limits", [1.0, 0.0]), "must be [minimum, maximum]"),
    "constant": (changed("inputs/goal/parts/0/value", 1.0), "has no `value:`"),
    "period": (changed("control_period", 0.2), "is 0.2 s, but the robot's is 0.1 s"),
    "state": (
        changed("states", {"goal": {"next": "action"}}),
        "is also listed under inputs",
    ),
    "range": (changed("scan", {"sectors": SECTORS, "range_max": 50.0}), "sees farther"),
    "both": (
        changed("choices", {"of": "action", "commands": [{}]}),
        "give either `outputs:`",
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_what_does_not_fit_is_refused_in_one_sentence(tmp_path, robot, name):
    spoil, words = SPOILT[name]
    write(tmp_path, "three")
    data = nets.three_mapping()
    spoil(data)
    with pytest.raises(BridgeError) as refused:
        open_policy(str(write_mapping(tmp_path, data)), robot)
    assert words in str(refused.value)
    assert str(tmp_path) in str(refused.value)


def test_a_network_that_gives_no_numbers_or_hides_others_operators_is_refused(
    tmp_path, robot
):
    path = write(tmp_path, "three")
    whole = nets.three()
    for node, words in (
        (onnx.helper.make_node("Log", ["bent"], ["left"]), "returns NaN or inf"),
        (onnx.helper.make_node("Tanh", ["bent"], ["left"], domain="evil"), "evil.Tanh"),
    ):
        spoilt = onnx.ModelProto()
        spoilt.CopyFrom(whole)
        spoilt.graph.node[3].CopyFrom(node)
        write_bytes(tmp_path / "net.onnx", spoilt.SerializeToString())
        with pytest.raises(PolicyError, match=words):
            open_policy(str(path), robot)


def test_without_a_robot_it_says_how_to_name_one(tmp_path):
    path = write(tmp_path, "flat")
    with pytest.raises(ConfigError, match="names no robot; add `robot:`"):
        load_policy(path)
    write(tmp_path, "three")
    assert load_policy(path).contract.robot.name == "differential"
