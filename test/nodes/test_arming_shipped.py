"""Every shipped robot can be armed with the parameters that the launch files give its nodes."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

import yaml

from nics_drl_bridge.config import find_config, list_shipped
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes.parameters import NODES
from nodes.test_command_gate import PLAIN, Robot

pytestmark = pytest.mark.ros

FILE = find_config("bridge", "nodes")


@pytest.mark.parametrize("robot", list_shipped("robots"))
def test_a_shipped_robot_is_armed_with_the_shipped_parameters(
    direct, clock, tmp_path, robot
):
    given = [f"model:={robot}", f"limits:={robot}", "e_stop_required:=false", *PLAIN]
    words = ["--params-file", str(FILE), "-r", "__node:=command_gate"]
    for each in (*given, f"black_box:={tmp_path}"):
        words += ["-p", f"command_gate:{each}"]  # as specific as those of `launch`
    standing = Robot(direct, clock, builtin_model(robot), words=words)
    standing.run(3.0)
    answer = standing.gate.call("~/arm")
    assert answer.success, answer.message


@pytest.mark.parametrize("node", NODES)
def test_the_shipped_file_sets_nothing_that_a_node_derives_from_the_robot(node):
    content = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    given = content.get(f"/**/{node}", {"ros__parameters": {}})["ros__parameters"]
    derived = {row.name for row in NODES[node]().parameters if row.shown}
    assert not derived & given.keys()
