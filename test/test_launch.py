"""What the launch files would start: `launch` has no wheel, so it is played by a stub."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from launch_stub import ROOT, Launched

FILES = sorted(path.name for path in (ROOT / "launch").glob("*.launch.py"))
WHOLE = ("simulation.launch.py", "vehicle.launch.py")
BRIDGE = {"command_gate", "middleware_node", "policy_node"}


@pytest.mark.parametrize("file", FILES)
def test_every_launch_file_starts_our_own_nodes_by_the_name_of_their_executable(file: str) -> None:
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    for name, node in Launched().run(file).nodes.items():
        if node["package"] == "nics_drl_bridge":
            assert node["executable"] == name
            assert f'"{name} = ' in setup.replace("f", "")
            assert all(Path(path).is_file() for path in node["files"])
        assert node["arguments"][-3:] == ["--ros-args", "--log-level", "info"]


@pytest.mark.parametrize("file", WHOLE)
def test_the_arguments_are_named_as_in_nav2(file: str) -> None:
    declared = Launched().run(file).declared
    assert declared.keys() >= {
        "namespace", "params_file", "use_sim_time", "autostart", "use_rviz", "log_level"
    }  # fmt: skip


def test_a_simulation_is_a_vehicle_and_a_simulator_on_simulated_time() -> None:
    vehicle, simulation = (Launched().run(file).nodes for file in reversed(WHOLE))
    assert vehicle.keys() == BRIDGE | {"robot_state_publisher"}
    assert simulation.keys() == vehicle.keys() | {"simulator_node"}
    for name in vehicle:
        assert simulation[name]["parameters"]["use_sim_time"] is True
        assert vehicle[name]["parameters"]["use_sim_time"] is False


@pytest.mark.parametrize(
    ("file", "required"),
    [("simulation.launch.py", False), ("vehicle.launch.py", True), ("bridge.launch.py", True)],
)
def test_only_a_simulation_does_without_an_emergency_stop(file: str, required: bool) -> None:
    gate = Launched().run(file).nodes["command_gate"]
    assert gate["parameters"]["e_stop_required"] is required
    told = yaml.safe_load(Path(gate["files"][0]).read_text(encoding="utf-8"))
    assert told["/**/command_gate"]["ros__parameters"]["e_stop_required"] is True


def test_arguments_reach_every_node() -> None:
    given = {
        "namespace": "car", "params_file": "own.yaml", "use_sim_time": "False",
        "autostart": "false", "log_level": "debug", "simulator": "mujoco", "use_rviz": "True",
    }  # fmt: skip
    nodes = Launched(values=given).run("simulation.launch.py").nodes
    assert nodes.keys() == BRIDGE | {"mujoco_node", "robot_state_publisher", "rviz2"}
    for name, node in nodes.items():
        assert node["namespace"] == "car"
        assert node["arguments"][-1] == "debug"
        if node["package"] == "nics_drl_bridge":
            assert node["files"] == ["own.yaml"]
            assert node["parameters"].get("use_sim_time", False) is False
        if name in ("middleware_node", "policy_node"):
            assert node["parameters"]["autostart"] is False
    assert nodes["rviz2"]["remappings"]["/scan"] == "scan"


@pytest.mark.parametrize("file", [*WHOLE, "bridge.launch.py"])
def test_a_fallback_reaches_the_policy_and_without_the_argument_the_file_decides(file: str) -> None:
    assert "fallback" not in Launched().run(file).nodes["policy_node"]["parameters"]
    nodes = Launched(values={"fallback": "mppi"}).run(file).nodes
    told = [name for name, node in nodes.items() if "fallback" in node["parameters"]]
    assert told == ["policy_node"]
    assert nodes["policy_node"]["parameters"]["fallback"] == "mppi"


def test_the_transforms_of_a_robot_stay_in_its_namespace() -> None:
    nodes = Launched(values={"use_rviz": "true"}).run("simulation.launch.py").nodes
    for name in ("simulator_node", "robot_state_publisher", "rviz2"):
        remapped = nodes[name]["remappings"]
        assert (remapped["/tf"], remapped["/tf_static"]) == ("tf", "tf_static")


def test_without_robot_state_publisher_the_rest_starts_all_the_same() -> None:
    assert Launched(installed=()).run("vehicle.launch.py").nodes.keys() == BRIDGE


def test_robot_state_publisher_gets_the_text_of_a_shipped_urdf() -> None:
    node = Launched().run("description.launch.py").nodes["robot_state_publisher"]
    text = (ROOT / "urdf" / "ackermann.urdf").read_text(encoding="utf-8")
    assert node["parameters"]["robot_description"] == text


def test_rviz_shows_topics_that_its_launch_file_puts_into_the_namespace() -> None:
    config = yaml.safe_load((ROOT / "config" / "rviz" / "bridge.rviz").read_text(encoding="utf-8"))
    remapped = Launched(values={"use_rviz": "true"}).run("description.launch.py").nodes["rviz2"]
    shown = {
        value["Value"] for _, value in items(config)
        if isinstance(value, dict) and str(value.get("Value", "")).startswith("/")
    }  # fmt: skip
    assert {"/scan", "/odometry/filtered", "/goal_pose", "/robot_description"} <= shown
    assert shown <= remapped["remappings"].keys()


def items(tree: object) -> list[tuple[object, object]]:
    """Every key and value of a tree, at all depths."""
    pairs = list(tree.items()) if isinstance(tree, dict) else []
    below = tree if isinstance(tree, list) else [value for _, value in pairs]
    return pairs + [pair for value in below for pair in items(value)]
