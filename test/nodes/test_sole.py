"""Two stacks in one domain: apart by their namespaces, or the second does not start."""

from __future__ import annotations

import math
import signal
import threading
from functools import partial

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.runner import sole
from nics_drl_bridge.nodes.simulator_node import WATCH_S
from nodes.peer import DEADLINE_S

pytestmark = pytest.mark.ros

PACE_S = 0.05


def ended(process):
    """Exit code and output of a node that ends by itself."""
    code = process._process.wait(DEADLINE_S)
    return code, process.log.read_text()


def way(odometry):
    """How far a robot has come [m]."""
    places = [
        (told.pose.pose.position.x, told.pose.pose.position.y) for told in odometry
    ]
    return math.dist(places[0], places[-1]) if places else 0.0


@pytest.mark.parametrize("node", ["command_gate", "middleware_node"])
def test_a_second_node_in_the_same_namespace_refuses_to_start(
    launch, meet, domain_id, node
):
    first, peer = launch(node, domain_id, "one"), meet(domain_id)
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


def test_a_node_of_another_package_with_the_same_name_is_asked_and_found(
    domain_id, meet
):
    peer, other = meet(domain_id), meet(domain_id)
    name = peer.node.get_name()
    asked = other.node.create_client(GetParameters, f"{name}/get_parameters")
    alive = Node(name, context=peer.context)  # with the services of parameters
    peer._executor.add_node(alive)
    done = threading.Event()
    spinning = threading.Thread(
        target=lambda: peer.until(done.is_set, "the end"), daemon=True, name="alive"
    )
    spinning.start()
    try:
        other.until(lambda: asked.service_is_ready(), "it in the graph")
        with (
            pytest.raises(BackendError, match="already runs"),
            sole(other.context, name),
        ):
            pass
    finally:
        done.set()
        spinning.join()
        alive.destroy_node()


def named(ends):
    """Whether the names of ends are known; they travel apart from the ends themselves."""
    return bool(ends) and not any("UNKNOWN" in end.node_name for end in ends)


def test_robots_in_one_domain_do_not_hear_each_other(launch, meet, domain_id, model):
    """One is told to drive: the other does not move."""
    for space in ("one", "two"):
        launch("simulator_node", domain_id, space, world="empty")
    one, two = meet(domain_id, "one"), meet(domain_id, "two")
    scans = {peer: peer.listen(LaserScan, "scan", qos.SENSOR) for peer in (one, two)}
    for peer in (one, two):
        peer.another(scans[peer], "scan")
    for space, peer in (("one", one), ("two", two)):
        publishers = partial(peer.node.get_publishers_info_by_topic, f"/{space}/scan")
        listeners = partial(
            peer.node.get_subscriptions_info_by_topic, f"/{space}/cmd_vel"
        )
        for ends in (publishers, listeners):
            peer.until(lambda ends=ends: named(ends()), "the names of ends")
        (info,), (heard,) = publishers(), listeners()
        assert (info.node_namespace, info.node_name) == (f"/{space}", "simulator_node")
        assert heard.node_namespace == f"/{space}"
        assert not peer.node.get_subscriptions_info_by_topic("/cmd_vel")
        assert not peer.node.get_publishers_info_by_topic("/scan")
    commands = one.speak(Twist, "cmd_vel")
    odometry = {peer: peer.listen(Odometry, "odom", qos.SENSOR) for peer in (one, two)}
    one.node.create_timer(
        PACE_S, lambda: commands.publish(conversions.twist_to_ros([0.5, 0.0, 0.0]))
    )
    one.until(lambda: way(odometry[one]) > 0.3, "the one drives")
    two.until(lambda: len(odometry[two]) > 5, "odometry of the other")
    assert all(abs(told.twist.twist.linear.x) < 0.1 for told in odometry[two])
    assert way(odometry[two]) < 0.1


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
