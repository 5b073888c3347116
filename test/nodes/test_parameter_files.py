"""Every parameter of `config/nodes` exists in the node it is meant for."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

import yaml
from rclpy.node import Node

from nics_drl_bridge.extras.mujoco.node import mujoco_node
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.command_gate import CommandGate
from nics_drl_bridge.nodes.middleware_node import MiddlewareNode
from nics_drl_bridge.nodes.policy_node import PolicyNode
from nics_drl_bridge.nodes.record_node import declare_drive
from nics_drl_bridge.nodes.simulator_node import simulator_node

pytestmark = pytest.mark.ros

FILES = sorted(
    (Path(__file__).resolve().parents[2] / "config" / "nodes").glob("*.yaml")
)


def record_node(context):
    node = Node("record_node", context=context)
    declare_drive(node)
    return node


MAKERS = {
    "simulator_node": simulator_node,
    "mujoco_node": mujoco_node,
    "middleware_node": MiddlewareNode,
    "policy_node": PolicyNode,
    "command_gate": CommandGate,
    "record_node": record_node,
}


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_node_has_every_parameter_that_a_shipped_file_gives_it(
    name, file, make_node, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    section = yaml.safe_load(file.read_text(encoding="utf-8")).get(f"/**/{name}", {})
    node = make_node(words=("--params-file", str(file)), kind=MAKERS[name])
    assert runner.unknown(node) == []
    for key, value in section.get("ros__parameters", {}).items():
        found = node.get_parameter(key).value
        assert found == pytest.approx(value, nan_ok=True), key
