"""Upstream's own tools find the nodes and run them."""

from __future__ import annotations

import subprocess

import pytest

pytest.importorskip("ros2cli", reason="needs ros2: make test-upstream")
pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]

PACKAGE = "nics_drl_bridge"
NODES = {
    "command_gate",
    "middleware_node",
    "mujoco_node",
    "policy_node",
    "record_node",
    "simulator_node",
}


def ros2(*words: str) -> str:
    return subprocess.run(["ros2", *words], check=True, capture_output=True, text=True).stdout


def test_ros2_pkg_lists_every_node() -> None:
    listed = ros2("pkg", "executables", PACKAGE).split()
    assert set(listed) >= NODES


@pytest.mark.parametrize("node", sorted(NODES))
def test_ros2_run_starts_a_node_which_tells_of_itself(node: str) -> None:
    assert node in ros2("run", PACKAGE, node, "--help")
