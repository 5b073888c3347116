"""Two stacks in one domain: apart by their namespaces, or the second does not start."""

import signal

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray

from nics_drl_bridge.nodes.simulator_node import WATCH_S
from nodes.peer import DEADLINE_S

pytestmark = pytest.mark.ros


def ended(process):
    """Exit code and output of a node that ends by itself."""
    code = process._process.wait(DEADLINE_S)
    return code, process.log.read_text()


def test_a_second_node_in_the_same_namespace_refuses_to_start(launch, meet, domain_id):
    node = "command_gate"
    first = launch(node, domain_id, "one")
    peer = meet(domain_id)
    # Once it runs: the graph shows its probe before, when either may still come first.
    peer.until(lambda: "running" in first.log.read_text(), node)
    code, told = ended(launch(node, domain_id, "one"))
    assert code == 2
    assert told.startswith(
        f"a node '/one/{node}' already runs in ROS domain {domain_id}; end it"
    )
    assert told.count("\n") == 1
    first.check()
    other = launch(node, domain_id, "two")
    peer.until(
        lambda: (node, "/two") in peer.node.get_node_names_and_namespaces(), "the other"
    )
    other.check()


@pytest.mark.process
def test_a_node_that_was_just_killed_does_not_keep_the_next_from_starting(
    launch, launch_process, meet, domain_id
):
    first = launch_process("command_gate", domain_id)
    peer = meet(domain_id)

    def gates():
        return peer.node.get_node_names().count("command_gate")

    peer.until(lambda: gates() == 1, "the gate")
    first._process.send_signal(signal.SIGKILL)
    first._process.wait()
    again = launch("command_gate", domain_id)
    peer.until(
        lambda: gates() == 2, "the next gate beside the dead one, which is still listed"
    )
    again.check()


def test_two_simulators_that_tell_the_time_in_one_domain_name_each_other(
    launch, meet, domain_id
):
    peer = meet(domain_id)
    both = {
        space: launch("simulator_node", domain_id, space) for space in ("one", "two")
    }
    others = {"one": "/two/simulator_node", "two": "/one/simulator_node"}

    def said():
        return all(
            f"{others[space]} publishes /clock too" in process.log.read_text()
            for space, process in both.items()
        )

    peer.until(said, "the warnings")
    diagnoses = peer.listen(DiagnosticArray, "/diagnostics")  # one a second of each
    peer.until(lambda: len(diagnoses) > 6 * WATCH_S, "further looks at the graph")
    for process in both.values():
        assert process.log.read_text().count("/clock too") == 1
        process.check()
