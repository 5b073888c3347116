"""What the parameters of `command_gate` come to: its defaults, and what is refused at the start."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from dataclasses import replace

from rclpy.parameter import Parameter

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes.command_gate import declare_gate, find_black_box
from nics_drl_bridge.nodes.runner import declare_model

pytestmark = pytest.mark.ros


@pytest.fixture
def declared(make_node):
    """Declares the gate's parameters as given, `declared({"scan_age": 0.5})`."""

    def declare(given=(), model=None):
        node = make_node(*(f"{name}:={value}" for name, value in dict(given).items()))
        return declare_gate(node, model or declare_model(node))

    return declare


def test_a_gate_that_is_told_nothing_requires_an_emergency_stop(declared):
    config = declared()
    assert config.e_stop_required
    assert not config.simulated


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"scan_age": 0.05}, "parameter 'scan_age': 0.05 s: scan comes every 0.1 s"),
        ({"odom_age": 0.02}, "parameter 'odom_age'"),
        ({"odom_rate": 50.0, "odom_age": 0.01}, "give more than 0.02"),
        ({"odom_rate": 0.5, "odom_age": 5.0}, "too rarely"),
        ({"estimate_std": 0.5}, "'estimate_position' .* and 'estimate_heading'"),
        ({"model": "ackermann", "limits": "mecanum"}, "limits are for 'mecanum', not"),
    ],
)
def test_a_parameter_that_can_not_be_used_is_one_sentence(declared, given, sentence):
    with pytest.raises(ConfigError, match=sentence):
        declared(given)


@pytest.mark.parametrize(
    ("rate", "age"), [(10.0, 0.3), (5.0, 0.35), (4.0, 0.4375), (40.0, 0.3)]
)
def test_scans_of_a_slow_lidar_may_get_older(declared, rate, age):
    model = builtin_model("ackermann")
    slow = replace(model, lidar=model.lidar.model_copy(update={"rate": rate}))
    assert declared({"odom_rate": 10.0}, model=slow).scan_age_s == pytest.approx(age)


def test_metres_and_radians_of_the_estimate_have_parameters_of_their_own(declared):
    config = declared(
        {"estimate_position": 0.7, "estimate_heading": 0.2, "stop_when_held": False}
    )
    assert (config.estimate_position, config.estimate_heading) == (0.7, 0.2)
    assert not config.stop_when_held
    assert declared().stop_when_held


def test_the_shield_needs_the_wheelbase_of_a_car_and_can_be_turned_off(declared):
    model = builtin_model("ackermann")
    robot = model.robot.model_copy(update={"parameters": {}})
    with pytest.raises(ConfigError, match="needs the parameter 'wheelbase' of a car"):
        declared(model=replace(model, robot=robot))
    assert declared(model=model).shield is not None
    assert declared({"shield": False}, model).shield is None


def test_each_namespace_has_a_black_box_of_its_own(make_node, tmp_path):
    def folder(*words):
        node = make_node(f"black_box:={tmp_path}", words=words)
        declare_gate(node, declare_model(node))
        return find_black_box(node)

    assert folder() == tmp_path
    assert folder("-r", "__ns:=/hall/robot_1") == tmp_path / "hall" / "robot_1"


@pytest.mark.parametrize("simulated", [False, True])
def test_the_clock_of_a_gate_that_runs_can_not_be_changed(make_node, simulated):
    node = make_node(f"use_sim_time:={simulated}")
    declare_gate(node, declare_model(node))
    (same,) = node.set_parameters([Parameter("use_sim_time", value=simulated)])
    (other,) = node.set_parameters([Parameter("use_sim_time", value=not simulated)])
    assert same.successful
    assert not other.successful
    assert "'use_sim_time' can't be changed" in other.reason
    assert node.get_clock().ros_time_is_active is simulated
