"""What `--help` tells of a node is what the node has."""

import math
from types import SimpleNamespace

import pytest
from rclpy.parameter import Parameter

from nics_drl_bridge.config import find_config, list_shipped, share_folder
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import runner, transport
from nics_drl_bridge.nodes.parameters import (
    describe_node,
    find_frame_fault,
    is_stamped_default,
    list_nodes,
)
from nics_drl_bridge.nodes.qos import get_given_values
from nodes.in_process import node_class
from nodes.test_command_gate import PLAIN, Robot

pytestmark = pytest.mark.ros


RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")
RCLPY_TOPICS = ("/rosout", "/parameter_events", "/transition_event")


@pytest.fixture(params=list_nodes())
def node(request, make_node, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = make_node(kind=node_class(request.param))
    if hasattr(made, "start"):
        made.start()
    return request.param, made


def same(value, default):
    """Whether two values are equal, or both NaN."""
    if isinstance(default, list):
        return len(value) == len(default) and all(map(same, value, default))
    return value == default or (math.isnan(value) and math.isnan(default))


def test_help_tells_the_parameters_topics_and_services_of_a_node(node):
    name, made = node
    facts = describe_node(name)
    own = {
        each for each in made.get_parameters_by_prefix("") if not each.startswith(RCLPY)
    }
    assert own == {row.name for row in facts.parameters}
    for row in facts.parameters:
        assert made.describe_parameter(row.name).description == row.about
        assert row.shown or same(made.get_parameter(row.name).value, row.default), row
    place = (made.get_name(), "/")
    for told, there in (
        (facts.publishes, made.get_publisher_names_and_types_by_node(*place)),
        (facts.subscribes, made.get_subscriber_names_and_types_by_node(*place)),
    ):
        words = {
            f"/{word.strip('/,')}"
            for each in told
            for word in each.partition("(")[0].split()
        }
        topics = {topic for topic, _ in there if not topic.endswith(RCLPY_TOPICS)}
        assert topics <= words
        # A drive speaks once somebody listens.
        assert topics or (name, told) == ("record_node", facts.publishes)
    services = {
        service for service, _ in made.get_service_names_and_types_by_node(*place)
    }
    always = {
        each for each in facts.services if "(" not in each
    }  # whatever is installed
    assert {each.replace("~", f"/{made.get_name()}") for each in always} <= services


def given(values):
    """Parameters of some values."""
    return [SimpleNamespace(name=name, value=value) for name, value in values.items()]


@pytest.mark.parametrize("frame", ["", "a b", "/map", "m\n", "x" * 5000])
def test_a_frame_that_tf_does_not_know_is_one_short_sentence(frame):
    told = find_frame_fault(
        given({"map_frame": "map", "base_frame": frame, "rate": 1.0})
    )
    assert told.startswith(
        "parameter 'base_frame': must be 1 to 255 characters, without blanks"
    )
    assert len(told) < 250


def test_the_frame_of_the_robot_is_its_own_and_a_footprint_may_be_none():
    good = {
        "map_frame": "map",
        "odom_frame": "odom",
        "base_frame": "r/base",
        "footprint_frame": "",
    }
    assert not find_frame_fault(given(good))
    assert not find_frame_fault(
        given(good) + given({"map_frame": "odom"})
    )  # without localisation
    told = find_frame_fault(given(good) + given({"base_frame": "odom"}))
    assert (
        told
        == "parameter 'base_frame': is 'odom', like 'odom_frame'; they must differ."
    )


@pytest.mark.parametrize("name", ["middleware_node", "policy_node"])
def test_a_node_with_such_a_frame_is_refused_at_the_start(name, make_node):
    with pytest.raises(ConfigError, match="must differ"):
        make_node("base_frame:=map", kind=node_class(name))


@pytest.mark.parametrize("frame", ["a b", "map"])
def test_a_running_node_refuses_such_a_frame_and_keeps_its_own(frame, make_node):
    made = make_node("autostart:=false", kind=node_class("middleware_node"))
    (answer,) = made.set_parameters([Parameter("base_frame", value=frame)])
    assert not answer.successful
    assert "'base_frame'" in answer.reason
    assert made.set_parameters([Parameter("base_frame", value="car")])[0].successful
    assert made.get_parameter("base_frame").value == "car"


@pytest.mark.parametrize(
    ("distribution", "stamped"),
    [
        ("jazzy", False),
        ("kilted", True),
    ],
)
def test_commands_are_stamped_since_kilted(monkeypatch, distribution, stamped):
    monkeypatch.setenv("ROS_DISTRO", distribution)
    assert is_stamped_default() is stamped
    for node in list_nodes():
        rows = {row.name: row.default for row in describe_node(node).parameters}
        assert rows["enable_stamped_cmd_vel"] is stamped


def test_without_a_sourced_distribution_its_wheels_tell_which_it_is(monkeypatch):
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.setattr(transport, "_is_wheel", lambda name: name == "jazzy")
    assert not is_stamped_default()
    monkeypatch.setattr(transport, "_is_wheel", lambda name: False)
    assert is_stamped_default()


def test_values_that_are_given_are_known_before_they_are_declared(make_node):
    node = make_node("plugins:=[]", "rate:=2")
    given = {name: value.value for name, value in get_given_values(node).items()}
    assert given["plugins"] is None  # an empty list has no type yet
    assert given["rate"] == 2
    assert not node.has_parameter("rate")
    assert node.declare_parameter("rate", 1).value == 2
    assert node.declare_parameter("plugins", ["a"]).value is None


FILES = sorted((share_folder() / "config" / "nodes").glob("*.yaml"))


@pytest.mark.parametrize("name", list_nodes())
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_file_sets_what_a_node_has_and_does_not_derive_from_its_robot(
    name, file, make_node
):
    node = make_node(words=("--params-file", str(file), "-r", f"__node:={name}"))
    rows = {row.name: row for row in describe_node(name).parameters}
    for given, parameter in node.given.items():
        if given == runner.SHARED and given not in rows:
            continue
        assert not rows[given].shown, given
        found = runner.declare_row(node, rows[given])
        assert found == pytest.approx(parameter.value, nan_ok=True), given


@pytest.mark.parametrize("robot", list_shipped("robots"))
def test_a_shipped_robot_is_armed_with_the_shipped_parameters(
    direct, clock, tmp_path, robot
):
    given = [f"model:={robot}", f"limits:={robot}", "e_stop_required:=false", *PLAIN]
    file = find_config("bridge", "nodes")
    words = ["--params-file", str(file), "-r", "__node:=command_gate"]
    for each in (*given, f"black_box:={tmp_path}"):
        words += ["-p", f"command_gate:{each}"]  # as specific as those of `launch`
    standing = Robot(direct, clock, builtin_model(robot), words=words)
    standing.run(2.0)
    answer = standing.gate.call("~/arm")
    assert answer.success, answer.message
