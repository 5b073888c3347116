"""Where an evaluation drives a robot."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from nics_drl_bridge import extensions
from nics_drl_bridge.commands import episodes
from nics_drl_bridge.commands.episodes import (
    FAST,
    NO_CONDITIONS,
    PLACES,
    Conditions,
    EvaluationOrder,
    limit_time,
    model_name,
    read_contracts,
    report_end,
    select_places,
    shorten_name,
)
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.middleware.uncertainty import Uncertainty
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import build_robot, load_robot
from nics_drl_bridge.sim.world_set import load_worlds

KART = SimpleNamespace(
    robot=build_robot({"kind": "ackermann_throttle", "footprint_radius": 0.2})
)


@pytest.mark.parametrize(
    ("policy", "among", "name"),
    [
        ("runs/a/seed_0/policy.onnx", ["runs/b/seed_0/policy.onnx"], "a_seed_0_policy"),
        ("runs/a/seed_1/policy.onnx", ["runs/a/seed_0/policy.onnx"], "seed_1_policy"),
        ("a/policy.onnx", ["b/policy.onnx"], "a_policy"),
        ("m/v1.2", ["m/v1.3"], "v1.2"),
        ("runs/a/mine.onnx", ["straight", "differential"], "mine"),
        ("straight", [], "straight"),
    ],
)
def test_pictures_of_policies_with_the_same_name_are_told_apart_by_their_folders(
    policy, among, name
):
    assert shorten_name(policy, [policy, *among]) == name


def order(*places):
    return EvaluationOrder(["straight"], Path("out"), places=places)


def test_a_robot_without_cmd_vel_is_driven_in_process_alone_and_that_is_said():
    said = []
    assert select_places(order(), KART.robot, said.append) == [FAST]
    assert said[0].startswith(
        "only in process: robot 'ackermann_throttle': the command 'throttl"
    )
    assert select_places(order(FAST), KART.robot, said.append) == [FAST]
    assert len(said) == 1
    with pytest.raises(ConfigError, match="names no field of cmd_vel"):
        select_places(order(FAST, "dds"), KART.robot, print)


@pytest.mark.parametrize(
    ("lacking", "robot", "places", "why"),
    [
        (
            "rclpy",
            "differential",
            [FAST],
            "only in process: the world 'dds' needs the module",
        ),
        (
            "mujoco",
            "differential",
            [FAST, "dds"],
            "only in process and over DDS: .*mujoco",
        ),
        (
            "",
            "tricycle",
            [FAST, "dds"],
            "only in process and over DDS: .*no machine of the kind",
        ),
    ],
)
def test_without_in_an_evaluation_leaves_out_where_it_can_not_run_in_one_line(
    monkeypatch, lacking, robot, places, why
):
    """With an explicit place it refuses."""
    pytest.importorskip("rclpy")
    if lacking == "mujoco":
        monkeypatch.setitem(sys.modules, "mujoco", None)
        for name in [name for name in sys.modules if "extras.mujoco" in name]:
            monkeypatch.delitem(sys.modules, name)
    elif lacking:
        there = extensions.find_spec
        monkeypatch.setattr(
            extensions,
            "find_spec",
            lambda name: None if name == lacking else there(name),
        )
    said = list[str]()
    spec = load_robot(robot)
    assert select_places(order(), spec, said.append) == places
    assert len(said) == 1
    assert re.match(why, said[0])
    with pytest.raises(ConfigError):
        select_places(order(*PLACES), spec, said.append)
    assert len(said) == 1


def contract(robot, **known):
    """What a policy file tells of itself, as far as an evaluation asks."""
    steps = known.pop("max_episode_steps", None)
    spec = SimpleNamespace(name=robot)
    return SimpleNamespace(robot=spec, provenance=known, max_episode_steps=steps)


def test_a_baseline_drives_the_robot_of_the_policy_beside_it(tmp_path):
    assert read_contracts(["dynamic_window", "straight"]) == {}
    assert model_name(None, {}) == DEFAULT_ROBOT
    mine = {"mine.onnx": contract("mine", model=str(tmp_path))}
    assert model_name(None, mine) == str(tmp_path)
    assert model_name(None, {"shipped.onnx": contract("mecanum")}) == "mecanum"
    assert model_name("ackermann", mine) == "ackermann"


def test_a_policy_of_a_robot_that_is_gone_asks_for_its_model(tmp_path):
    gone = {"mine.onnx": contract("mine", model=str(tmp_path / "gone"))}
    with pytest.raises(
        ConfigError, match=r"mine.onnx: .*'mine', .*which is gone; .* with --model"
    ):
        model_name(None, gone)


def test_an_evaluation_uses_the_time_limit_of_the_policy_and_tells_if_it_is_short():
    said = list[str]()
    world = load_worlds("doorway")
    slow = SimpleNamespace(robot=load_robot("turtlebot3_burger"), control_period=0.1)
    known = {"mine.onnx": contract("mine", max_episode_steps=400)}
    assert limit_time(NO_CONDITIONS, known, slow, world, said.append).steps == 400
    assert limit_time(NO_CONDITIONS, {}, slow, world, said.append).steps == 573
    assert said == []
    assert (
        limit_time(Conditions(steps=300), known, slow, world, said.append).steps == 300
    )
    assert "an episode ends after 30 s" in said[0]


def drive_of_a_vehicle(result: str, uncertain: Uncertainty | None) -> Episode:
    path = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.6, 0.0, 0.0]])
    goal = np.array([0.6, 0.0])
    return Episode(
        0, result, path, path, goal, np.zeros((0, 7)), 0.0, uncertain=uncertain
    )


@pytest.mark.parametrize(
    ("result", "word"),
    [("success", "reached"), ("collision", "touched"), ("time-out", "time-out")],
)
def test_the_end_of_a_vehicles_episode_is_told_as_believed_and_how_uncertain(
    result, word
):
    told = report_end(drive_of_a_vehicle(result, Uncertainty(0.12, 0.034)))
    assert told == (
        f"{word}, as believed; position uncertain by 0.12 m, heading by 0.034 rad since the "
        "start; 2 steps, 0.60 m"
    )
    told = report_end(drive_of_a_vehicle(result, None))
    assert told == f"{word}, as believed; 2 steps, 0.60 m"


@pytest.mark.parametrize("refusal", ["", "scan_silent"])
def test_a_vehicle_is_driven_only_if_its_gate_can_be_armed(monkeypatch, refusal):
    operator = pytest.importorskip("nics_drl_bridge.nodes.operator")
    said = []
    answer = operator.TriggerAnswer("/ant/command_gate", not refusal, refusal)
    monkeypatch.setattr(operator.Operator, "__init__", lambda self: None)
    monkeypatch.setattr(operator.Operator, "__exit__", lambda *_: None)
    monkeypatch.setattr(operator.Operator, "arm", lambda *_: answer)
    episodes._arm(False, "ant", pytest.fail)
    if refusal:
        with pytest.raises(BackendError, match=r"ant/command_gate .*: scan_silent"):
            episodes._arm(True, "ant", said.append)
    else:
        episodes._arm(True, "ant", said.append)
        assert said == ["  /ant/command_gate is armed"]
