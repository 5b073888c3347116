"""What the parameters of `command_gate` come to: its defaults, and what is refused at the start."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from dataclasses import replace

from rclpy.node import Node
from rclpy.parameter import Parameter

from nics_drl_bridge.config import dump_yaml, find_config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes.command_gate import declare_black_box, declare_gate
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.runner import declare_model

pytestmark = pytest.mark.ros


@pytest.fixture
def declared(domain_id, tmp_path):
    """Declares the gate's parameters as given, over those of files."""

    def declare(given=(), files=(), model=None):
        path = tmp_path / "given.yaml"
        # By the node's full name, as launch_ros writes what a launch file gives a node.
        own = {"/command_gate": {"ros__parameters": dict(given)}}
        path.write_text(dump_yaml(own), encoding="utf-8")
        arguments = ["node", "--ros-args", "-r", "__node:=command_gate"]
        for file in (*files, path) if given else files:
            arguments += ["--params-file", str(file)]
        context = open_context(arguments, domain_id)
        try:
            node = Node("command_gate", context=context)
            try:
                return declare_gate(node, model or declare_model(node))
            finally:
                node.destroy_node()
        finally:
            context.try_shutdown()

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
        ({"odom_rate": 0.5, "odom_age": 5.0}, "too seldom"),
    ],
)
def test_a_parameter_with_which_the_robot_could_never_move_is_one_sentence(
    declared, given, sentence
):
    with pytest.raises(ConfigError, match=sentence):
        declared(given)


def test_a_typo_in_the_limits_is_one_sentence(declared, tmp_path):
    file = tmp_path / "limits.yaml"
    text = find_config("ackermann", "limits").read_text(encoding="utf-8")
    file.write_text(text.replace("max: 1.0", "max: 10.0"), encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"speed_command\.max': 10 m/s is beyond the robot's own"
    ):
        declared({"model": "ackermann", "limits": str(file)})


@pytest.mark.parametrize(
    ("rate", "age"), [(10.0, 0.3), (5.0, 0.35), (4.0, 0.4375), (40.0, 0.3)]
)
def test_scans_of_a_slow_lidar_may_get_older(declared, rate, age):
    model = builtin_model("ackermann")
    slow = replace(model, lidar=model.lidar.model_copy(update={"rate": rate}))
    assert declared({"odom_rate": 10.0}, model=slow).scan_age_s == pytest.approx(age)


def test_each_namespace_has_a_black_box_of_its_own(domain_id, tmp_path):
    def folder(*remapped):
        given = ["node", "--ros-args", "-p", f"black_box:={tmp_path}", *remapped]
        context = open_context(given, domain_id)
        try:
            node = Node("command_gate", context=context)
            try:
                return declare_black_box(node)
            finally:
                node.destroy_node()
        finally:
            context.try_shutdown()

    assert folder() == tmp_path
    assert folder("-r", "__ns:=/hall/robot_1") == tmp_path / "hall" / "robot_1"


@pytest.mark.parametrize("simulated", [False, True])
def test_the_clock_of_a_gate_that_runs_can_not_be_changed(domain_id, simulated):
    context = open_context(
        ["node", "--ros-args", "-p", f"use_sim_time:={str(simulated).lower()}"],
        domain_id,
    )
    node = Node("command_gate", context=context)
    try:
        declare_gate(node, declare_model(node))
        (same,) = node.set_parameters([Parameter("use_sim_time", value=simulated)])
        (other,) = node.set_parameters([Parameter("use_sim_time", value=not simulated)])
        assert same.successful
        assert not other.successful
        assert (
            "parameter 'use_sim_time' can't be changed while the gate runs"
            in other.reason
        )
        assert node.get_parameter("use_sim_time").value is simulated
        assert node.get_clock().ros_time_is_active is simulated
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_the_parameter_that_was_split_names_the_two_that_it_is_now(declared):
    with pytest.raises(
        ConfigError, match=r"'estimate_position' .* and 'estimate_heading'"
    ):
        declared({"estimate_std": 0.5})


def test_metres_and_radians_of_the_estimate_have_parameters_of_their_own(declared):
    config = declared(
        {"estimate_position": 0.7, "estimate_heading": 0.2, "stop_when_held": False}
    )
    assert (config.estimate_position, config.estimate_heading) == (0.7, 0.2)
    assert not config.stop_when_held
    assert declared().stop_when_held
