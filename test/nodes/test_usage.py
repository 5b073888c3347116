import subprocess
import sys

import pytest

from nics_drl_bridge.nodes.parameters import describe_node, list_nodes
from nics_drl_bridge.nodes.start import format_help

# As where no ROS 2 is installed: what is imported in vain is missed.
WITHOUT = """
import sys
for name in ("rclpy", "numba", "matplotlib"):
    sys.modules[name] = None
from nics_drl_bridge.nodes import start
start.start(sys.argv[1], sys.argv[1:])
"""

COLLECTS = """
import gc
from nics_drl_bridge.nodes import start
start._load_main = lambda node: lambda args: print(gc.isenabled(), gc.get_freeze_count() > 0)
start.start("policy_node", ["policy_node"])
"""


def run(*words):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, *words],
        capture_output=True,
        text=True,
        timeout=100,
    )


@pytest.mark.process
def test_help_is_told_without_ros_and_ends_well():
    done = run("policy_node", "--ros-args", "-p", "rate:=2.0", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == format_help("policy_node")


@pytest.mark.parametrize("node", list_nodes())
def test_help_names_each_parameter_with_its_default_and_an_example(node):
    text = format_help(node)
    for row in describe_node(node).parameters:
        assert f"\n    {row.name} = " in text
    assert f"ros2 run nics_drl_bridge {node} --ros-args -p " in text
    assert max(map(len, text.splitlines())) <= 100


def test_defaults_are_written_as_they_are_given():
    assert "\n    rate = .nan: " in format_help("policy_node")
    assert "\n    goal = [.nan, .nan]: " in format_help("policy_node")
    assert "\n    limits = '': " in format_help("command_gate")
    assert "\n    autostart = true: " in format_help("middleware_node")


@pytest.mark.process
def test_a_node_collects_garbage_except_for_what_was_loaded(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", COLLECTS], capture_output=True, text=True, timeout=100
    )
    assert (done.returncode, done.stdout) == (0, "True True\n"), done.stderr
