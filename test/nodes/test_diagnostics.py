"""Levels of `/diagnostics` as an operator reads them, from real processes."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes.runner import ERROR, OK, STALE, WARN

pytestmark = pytest.mark.ros


def test_a_held_robot_is_an_error_and_a_source_that_stopped_is_stale(
    launch_process, meet, domain_id
):
    peer = meet(domain_id)
    simulator = launch_process("simulator_node", domain_id, world="empty")
    for node in ("middleware_node", "policy_node"):
        launch_process(node, domain_id)
    limits = {"limits": "ackermann", "e_stop_required": False}
    launch_process("command_gate", domain_id, **limits)
    newest = {}

    def note(message):
        newest.update((status.name, status.level) for status in message.status)

    peer.node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
    running = {
        "/simulator_node: simulator": OK,
        "/middleware_node: topics": OK,
        "/policy_node: policy": OK,
        "/command_gate: gate": WARN,  # not armed yet
    }
    peer.until(lambda: newest == running, f"{running}")
    assert peer.call(Trigger, "command_gate/e_stop").success
    held = running | {"/command_gate: gate": ERROR}
    peer.until(lambda: newest == held, f"{held}")
    simulator.close()
    newest.clear()
    stale = {
        "/middleware_node: topics": STALE,
        "/policy_node: policy": STALE,
        "/command_gate: gate": ERROR,
    }
    peer.until(lambda: newest == stale, f"{stale}")
