"""Nodes and parameters that follow from the arguments of `nics up` and the launch files."""

import re

import pytest

from nics_drl_bridge.config import find_config, share_folder
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.nodes import starting
from nics_drl_bridge.nodes.starting import (
    LAUNCHES,
    Robot,
    Setup,
    parse_robots,
    parse_start,
)


def setup_of(**given):
    values = {
        "params_file": str(find_config("bridge", "nodes")),
        "simulator": "simulator",
    }
    return Setup(values | given)


@pytest.mark.parametrize(
    ("robots", "names"),
    [
        ("1", ()),
        ("", ()),
        ("2", ("robot1", "robot2")),
        ("ant bee", ("ant", "bee")),
        ("['ant']", ("ant",)),
    ],
)
def test_robots_are_a_count_or_names(robots, names):
    assert parse_robots(robots) == names


@pytest.mark.parametrize("name", starting.FLAGS)
def test_a_flag_that_is_neither_true_nor_false_is_refused_before_any_node_starts(name):
    with pytest.raises(ConfigError, match=f"'{name}' is 'maybe'"):
        setup_of(**{name: "maybe"})
    for word, value in (("True", True), ("0", False), ("", None)):
        assert setup_of(**{name: word})[name] is value


def test_the_policies_of_a_fleet_hear_the_map_of_all():
    for node in starting.bridge(setup_of(namespace="hall", robots="[ant, bee]")):
        assert ("map", "/hall/map") in node.remappings
    for node in starting.bridge(setup_of(namespace="hall", robots="")):
        assert "map" not in dict(node.remappings)


@pytest.mark.parametrize("start", ["1 0 1.5", "[1, 0, 1.5]", "1.0,0.0,1.5"])
def test_a_start_is_three_numbers_in_any_spelling(start):
    assert parse_start(start) == [1.0, 0.0, 1.5]


def test_one_robot_lies_in_the_namespace_and_a_fleet_below_it():
    assert setup_of(namespace="/hall", robots="").robots == [Robot("hall", "", "hall")]
    fleet = setup_of(namespace="hall", robots="[ant, bee]").robots
    assert fleet == [
        Robot("hall/ant", "ant/", "hall"),
        Robot("hall/bee", "bee/", "hall"),
    ]


def test_limits_and_looks_are_those_of_the_model_that_is_given(tmp_path):
    assert setup_of().choose_limits() == ""
    assert setup_of(model="mecanum").choose_limits() == "mecanum"
    assert setup_of(model="mecanum", limits="own.yaml").choose_limits() == "own.yaml"
    save_model(builtin_model("mecanum"), tmp_path / "model")
    frames = {"base_frame": "chassis", "laser_frame": "front_laser"}
    generated = setup_of(model=str(tmp_path / "model"), **frames)
    assert generated.choose_limits() == "mecanum"
    for setup in (generated, setup_of(model="mecanum", **frames)):
        drawn = setup.describe_robot()
        assert '<robot name="mecanum"' in drawn
        assert '<link name="chassis">' in drawn
        assert '<link name="front_laser">' in drawn
        assert '"base_link"' not in drawn


def test_a_robot_of_an_own_file_of_parameters_is_named_where_it_is_described(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("/**:\n  ros__parameters:\n    model: jackal\n")
    with pytest.raises(ConfigError, match="say model:=ROBOT or urdf:=FILE"):
        setup_of(params_file=str(file)).describe_robot()
    drawn = setup_of(params_file=str(file), model="jackal").describe_robot()
    assert '<robot name="jackal"' in drawn
    assert '<robot name="differential"' in setup_of().describe_robot()
    nodes = LAUNCHES["vehicle"].nodes(
        {"params_file": str(file), "use_robot_state_pub": "false"}
    )
    assert {node.params_file for node in nodes} == {str(file)}


def started(launch, **given):
    """Return the parameters of the nodes of a launch, by their names with namespaces."""
    nodes = LAUNCHES[launch].nodes(given)
    return {
        f"{node.namespace}/{node.executable}".strip("/"): node.parameters
        for node in nodes
    }


def test_a_simulation_arms_without_an_e_stop_and_a_vehicle_does_not():
    bridge = ["command_gate", "middleware_node", "policy_node"]
    assert list(started("simulation")) == ["simulator_node", *bridge]
    assert list(started("vehicle")) == bridge
    assert started("simulation")["simulator_node"] == {"robots": 1}
    with pytest.raises(ConfigError, match="'e_stop_required'"):
        started("vehicle", e_stop_required="false")
    assert started("simulation")["command_gate"]["e_stop_required"] is False
    assert started("fleet")["robot2/command_gate"]["e_stop_required"] is False
    assert started("vehicle")["command_gate"]["e_stop_required"] is True
    required = started("simulation", e_stop_required="true")
    assert required["command_gate"]["e_stop_required"] is True


def test_every_parameter_has_the_type_that_its_node_declares():
    given = {
        "world": "7",
        "policy": "1e3",
        "stamped": "0",
        "start": "1 2 3",
        "robots": "[ant]",
    }
    nodes = started("simulation", **given)
    assert nodes["simulator_node"]["world"] == "7"
    assert nodes["simulator_node"]["episode_start"] == [1.0, 2.0, 3.0]
    assert nodes["simulator_node"]["robots"] == ["ant"]
    assert nodes["simulator_node"]["enable_stamped_cmd_vel"] is False
    assert nodes["ant/policy_node"]["policy"] == "1e3"
    assert nodes["ant/policy_node"]["autostart"] is True
    assert nodes["ant/policy_node"]["base_frame"] == "ant/base_link"
    single = started("simulation", base_frame="chassis", laser_frame="front")
    assert single["simulator_node"]["laser_frame"] == "front"
    assert {name: one["base_frame"] for name, one in single.items()} == dict.fromkeys(
        single, "chassis"
    )


def test_dart_simulates_the_robot_of_a_urdf_file(tmp_path):
    file = tmp_path / "own.urdf"
    file.write_text("<robot name='own'/>")
    for engine, told in (("dart", str(file)), ("mujoco", None)):
        (node,) = starting.simulator(setup_of(simulator=engine, urdf=str(file)))
        assert node.executable == f"{engine}_node"
        assert node.parameters.get("urdf") == told


def test_rviz_shows_the_first_robot():
    nodes = LAUNCHES["fleet"].nodes({"rviz": "true"})
    (view,) = [node for node in nodes if node.package == starting.RVIZ]
    assert view.namespace == "robot1"
    assert view.arguments[0] == "-d"
    assert ("/scan", "scan") in view.remappings
    assert not view.params_file


def test_every_launch_file_starts_the_launch_of_its_name():
    """The files need `launch`, which only `nox -s upstream` has."""
    folder = share_folder() / "launch"
    files = {file.name.partition(".")[0]: file for file in folder.glob("*.launch.py")}
    assert files.keys() == LAUNCHES.keys()
    for name, file in files.items():
        assert f'describe(LAUNCHES["{name}"])' in file.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"robots": "0"}, "'robots' is 0"),
        ({"robots": "[ant, bee, ant]"}, "different namespaces"),
        ({"robots": "[ant"}, "'robots' is '[ant'"),
        ({"robots": "[ant, 9x]"}, "different namespaces"),
        ({"start": "1 2 3 4"}, "'start' is '1 2 3 4'"),
        ({"start": "1 2 x"}, "'start' is '1 2 x'"),
        (
            {"urdf": "/nope.urdf", "use_robot_state_pub": "true"},
            "/nope.urdf: no such file",
        ),
        ({"wrld": "arena"}, "did you mean 'world'"),
        ({"simulator": "gazebo"}, "'simulator' is 'gazebo'"),
        ({"stamped": "yes"}, "'stamped' is 'yes'"),
        ({"params_file": "none.yaml"}, "none.yaml: no such file"),
    ],
)
def test_an_argument_that_can_not_be_used_is_refused(given, reason):
    with pytest.raises(ConfigError, match=re.escape(reason)):
        started("simulation", **given)
