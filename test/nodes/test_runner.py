import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from rclpy.exceptions import ParameterException
from std_msgs.msg import Bool

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.backends import DdsBackend
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.parameters import Row
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.nodes.record_node import declare_drive
from nics_drl_bridge.nodes.runner import (
    declare_model,
    declare_row,
    explain_ignored_values,
)
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(("domain", "variable"), [(240, "0"), (None, "999")])
def test_a_domain_without_ports_is_one_sentence(monkeypatch, domain, variable):
    monkeypatch.setenv("ROS_DOMAIN_ID", variable)
    with pytest.raises(BackendError, match=r"domain (240|999) is above 232"):
        open_context([], domain_id=domain)


def test_what_speaks_to_topics_refuses_a_robot_without_cmd_vel(
    make_node, tmp_path, monkeypatch
):
    file = tmp_path / "kart.yaml"
    file.write_text("kind: ackermann_throttle\nfootprint_radius: 0.2\n")
    kart = open_model(file)
    monkeypatch.setattr(runner, "open_model", lambda _: kart)
    for drive in (
        lambda: declare_model(make_node()),
        lambda: declare_drive(make_node(f"robot:={file}")),
        lambda: DdsBackend(kart, load_world("empty")),
        lambda: RealtimeBackend(kart, load_world("empty")),
    ):
        with pytest.raises(ConfigError, match="'throttle' names no field of cmd_vel"):
            drive()


def test_a_whole_number_is_taken_for_a_floating_point_parameter(make_node):
    node = make_node("rate:=2", "start:=[1, 2, 3]", "count:=3")
    assert declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0))) == 2.0
    assert isinstance(node.get_parameter("rate").value, float)
    assert list(declare_row(node, Row("start", [0.0, 0.0, 0.0], "Pose."))) == [
        1.0,
        2.0,
        3.0,
    ]
    assert declare_row(node, Row("count", 1, "Of robots.")) == 3


def test_an_argument_that_ros_does_not_know_is_one_sentence(domain_id):
    with pytest.raises(
        BackendError, match=r"ROS 2 knows no argument .*--wait.*; write them as in"
    ):
        open_context(["node", "--ros-args", "--wait"], domain_id)


@pytest.mark.parametrize("value", ["0.05", "11", ".nan", "fast", "[1.0]"])
def test_a_value_that_can_not_be_used_is_refused_with_the_parameters_name(
    make_node, value
):
    node = make_node(f"rate:={value}", "robots:=0")
    with pytest.raises(ParameterException, match="rate"):
        declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0)))
    with pytest.raises(ParameterException, match=r"robots.*1"):
        declare_row(node, Row("robots", 1, "How many.", span=(1, 100)))


def test_a_description_and_a_range_are_told_to_ros2_param_describe(make_node):
    node = make_node()
    declare_row(node, Row("rate", 1.0, "Of time.", span=(0.1, 10.0), fixed=True))
    told = node.describe_parameter("rate")
    assert (told.description, told.read_only) == ("Of time.", True)
    (span,) = told.floating_point_range
    assert (span.from_value, span.to_value) == (0.1, 10.0)


def test_a_value_that_nothing_reads_is_named_with_the_nearest_parameter(make_node):
    node = make_node("command_timout:=2.0", "qos_overrides./scam.publisher.depth:=3")
    declare_row(node, Row("command_timeout", 0.5, "Silence."))
    node.create_publisher(Bool, "/scan", 1)
    misspelt, quality = explain_ignored_values(node)
    assert "'command_timout'" in misspelt
    assert "did you mean 'command_timeout'?" in misspelt
    assert "'qos_overrides./scam.publisher.depth' is ignored" in quality
