"""Every parameter of `config/nodes` exists in the node it is meant for."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

import yaml

from nics_drl_bridge.nodes import runner
from nics_drl_bridge.nodes.parameters import NODES
from nodes.in_process import node_class

pytestmark = pytest.mark.ros

FILES = sorted(
    (Path(__file__).resolve().parents[2] / "config" / "nodes").glob("*.yaml")
)


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_node_has_every_parameter_that_a_shipped_file_gives_it(
    name, file, make_node, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    section = yaml.safe_load(file.read_text(encoding="utf-8")).get(f"/**/{name}", {})
    node = make_node(words=("--params-file", str(file)), kind=node_class(name))
    assert runner.explain_ignored_values(node) == []
    for key, value in section.get("ros__parameters", {}).items():
        found = node.get_parameter(key).value
        assert found == pytest.approx(value, nan_ok=True), key
