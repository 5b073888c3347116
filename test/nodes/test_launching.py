"""What launch arguments come to; `make test-upstream` has `launch`."""

from __future__ import annotations

import pytest

pytest.importorskip("launch_ros", reason="needs launch: make test-upstream")

from nics_drl_bridge.config import find_config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model, save_model
from nics_drl_bridge.nodes import launching
from nics_drl_bridge.nodes.launching import Robot, Setup, names_of, numbers_of

pytestmark = pytest.mark.ros


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
        (1, ()),
        ("", ()),
        ("2", ("robot1", "robot2")),
        (3, ("robot1", "robot2", "robot3")),
        ("[ant, bee]", ("ant", "bee")),
        ("ant bee", ("ant", "bee")),
        ("['ant']", ("ant",)),
        (["ant", "bee"], ("ant", "bee")),
    ],
)
def test_robots_are_a_count_or_names(robots, names):
    assert names_of(robots) == names


def test_no_robots_at_all_are_refused():
    with pytest.raises(
        ConfigError, match="launch argument 'robots' is 0; give a count from 1"
    ):
        names_of("0")


def test_a_robot_that_is_named_twice_is_refused():
    with pytest.raises(ConfigError, match="'robots' names 'ant' twice; name each once"):
        names_of("[ant, bee, ant]")


@pytest.mark.parametrize("name", launching.FLAGS)
def test_a_flag_that_is_neither_true_nor_false_is_refused_before_any_node_starts(name):
    with pytest.raises(
        ConfigError, match=f"launch argument '{name}' is 'maybe'; give true or"
    ):
        setup_of(**{name: "maybe"})
    assert [setup_of(**{name: one})[name] for one in ("True", "0", "")] == [
        "true",
        "false",
        "",
    ]


def test_a_missing_file_of_the_robot_is_one_sentence():
    with pytest.raises(ConfigError, match=r"^/nope\.urdf: no such file"):
        setup_of(urdf="/nope.urdf").description()


def test_one_robot_of_an_argument_goes_before_the_fleet_of_a_file(
    tmp_path, monkeypatch
):
    file = tmp_path / "fleet.yaml"
    file.write_text("simulator_node:\n  ros__parameters:\n    robots: [ant, bee]\n")
    monkeypatch.setattr(launching, "Node", dict)

    def robots(given):
        (node,) = launching.simulator(setup_of(robots=given, params_file=str(file)))
        return node["parameters"][-1].get("robots")

    assert robots("1").value[0].text == "1"
    assert "ant" in robots("").value[0].text


def test_the_policies_of_a_fleet_hear_the_map_of_all(monkeypatch):
    monkeypatch.setattr(launching, "Node", dict)
    fleet = setup_of(namespace="hall", robots="[ant, bee]")
    for node in launching.bridge(fleet):
        assert ("map", "/hall/map") in node["remappings"]
    for node in launching.bridge(setup_of(namespace="hall", robots="")):
        assert "map" not in dict(node["remappings"])


@pytest.mark.parametrize("start", ["1 0 1.5", "[1, 0, 1.5]", "1.0,0.0,1.5"])
def test_a_start_is_three_numbers_in_any_spelling(start):
    assert numbers_of(start) == [1.0, 0.0, 1.5]


@pytest.mark.parametrize("start", ["1", "here", "1 2 3 4", "1 2 x"])
def test_another_start_is_refused_with_an_example(start):
    with pytest.raises(
        ConfigError, match=r"launch argument 'start' is .*x, y, heading"
    ):
        numbers_of(start)


def test_no_start_leaves_it_to_the_seed():
    assert numbers_of("") is None


def test_one_robot_lies_in_the_namespace_and_a_fleet_below_it():
    assert setup_of(namespace="/hall", robots="").robots == [Robot("hall", "", "hall")]
    fleet = setup_of(namespace="hall", robots="[ant, bee]").robots
    assert fleet == [
        Robot("hall/ant", "ant/", "hall"),
        Robot("hall/bee", "bee/", "hall"),
    ]


def test_the_limits_are_those_of_the_model_that_is_given():
    assert setup_of().limits() == ""
    assert setup_of(model="mecanum").limits() == "mecanum"
    assert setup_of(model="mecanum", limits="own.yaml").limits() == "own.yaml"


def test_a_generated_model_has_the_limits_and_the_looks_of_its_robot(tmp_path):
    save_model(builtin_model("mecanum"), tmp_path / "model")
    setup = setup_of(model=str(tmp_path / "model"))
    assert setup.limits() == "mecanum"
    assert '<robot name="mecanum"' in setup.description()


def test_the_model_of_the_file_of_parameters_is_drawn_where_none_is_given(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("/**:\n  ros__parameters:\n    model: jackal\n")
    assert '<robot name="jackal"' in setup_of(params_file=str(file)).description()
    assert '<robot name="differential"' in setup_of().description()
    assert '<robot name="mecanum"' in setup_of(model="mecanum").description()


@pytest.mark.parametrize("model", ["mecanum", "own"])
def test_the_robot_is_drawn_with_the_frames_of_the_file_of_parameters(tmp_path, model):
    if model == "own":
        model = str(tmp_path / "model")
        save_model(builtin_model("mecanum"), tmp_path / "model")
    file = tmp_path / "own.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {base_frame: chassis, laser_frame: front_laser}\n"
    )
    drawn = setup_of(model=model, params_file=str(file)).description()
    assert '<link name="chassis">' in drawn
    assert '<link name="front_laser">' in drawn
    assert '"base_link"' not in drawn
