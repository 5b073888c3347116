from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool

from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.qos import QosWatch
from nics_drl_bridge.nodes.runner import open_context

pytestmark = pytest.mark.ros


@pytest.fixture
def watched(domain_id, meet, capfd):
    """A node in the namespace `car`, a peer, and what the node warns of once it has met it."""
    context = open_context(domain_id=domain_id)
    node = QosWatch("gate", namespace="car", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    peer = meet(domain_id, "car")
    lines: list[str] = []

    def warned() -> str:
        executor.spin_once(timeout_sec=0.05)
        lines.extend(line for line in capfd.readouterr().err.splitlines() if "[car.gate]" in line)
        return lines[-1] if lines else ""

    yield node, peer, warned
    executor.shutdown(timeout_sec=1.0)
    node.destroy_node()
    context.try_shutdown()


def test_a_publisher_that_offers_too_little_is_named_with_both_sides_and_a_cure(watched):
    node, peer, warned = watched
    peer.node.create_publisher(Bool, "e_stop", qos.SENSOR)
    node.create_subscription(Bool, "e_stop", lambda _: None, qos.EVERY_COMMAND)
    peer.until(warned, "a warning")
    line = warned()
    assert (
        f"/car/e_stop: no message passes between this node and /car/{peer.node.get_name()}" in line
    )
    assert "the reliability that the publisher offers (best effort)" in line
    assert "what the subscription asks for (reliable)" in line
    assert f"let /car/{peer.node.get_name()} offer reliable" in line


def test_a_subscription_that_asks_for_too_much_is_named_with_both_sides_and_a_cure(watched):
    node, peer, warned = watched
    keeping = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.node.create_subscription(Bool, "scan", lambda _: None, keeping)
    node.create_publisher(Bool, "scan", qos.SENSOR_RELIABLE)
    peer.until(warned, "a warning")
    line = warned()
    assert "/car/scan" in line
    assert "the durability that the publisher offers (volatile)" in line
    assert "what the subscription asks for (transient local)" in line
    assert f"let /car/{peer.node.get_name()} ask for volatile" in line
