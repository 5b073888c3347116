"""Two stacks in one domain: apart by their namespaces, or the second does not start."""

import signal

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from nics_drl_bridge.nodes.simulator_node import SimulatorNode
from nodes.in_process import LINES

pytestmark = pytest.mark.ros


@pytest.mark.process
def test_a_node_is_the_only_one_of_its_name_in_its_namespace_until_it_dies(
    launch, launch_process, meet, domain_id
):
    first = launch_process("command_gate", domain_id, "one")
    peer = meet(domain_id)

    def wait_for(node):
        peer.until(lambda: "running" in node.log.read_text(encoding="utf-8"), "a gate")

    wait_for(first)
    refused = launch("command_gate", domain_id, "one")
    assert refused.wait() == 2
    told = f"a node '/one/command_gate' already runs in ROS domain {domain_id}; end it"
    (line,) = refused.lines
    assert line.startswith(told)
    wait_for(launch("command_gate", domain_id, "two"))
    first._process.send_signal(signal.SIGKILL)
    first._process.wait()
    wait_for(launch("command_gate", domain_id, "one"))


def test_another_simulator_that_publishes_the_time_is_named_once(direct):
    node = direct(kind=SimulatorNode).node
    other = Node("other", context=node.context)
    other.create_publisher(Clock, "/clock", 1)
    known = len(LINES["MainThread"])
    for _ in range(3):
        node._watch()
    (line,) = LINES["MainThread"][known:]
    assert line.startswith("/other publishes /clock too")
    other.destroy_node()
