from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from sensor_msgs.msg import LaserScan

pytestmark = pytest.mark.ros

NODES = ("simulator_node", "middleware_node", "policy_node", "command_gate")
ABSOLUTE = {
    "/clock",
    "/tf",
    "/tf_static",
    "/diagnostics",
    "/rosout",
    "/parameter_events",
}


@pytest.fixture(scope="module")
def spaced(launch, meet, module_domain_id):
    """All nodes of a robot in a namespace, with the scan under another name."""
    started = [
        launch(node, module_domain_id, namespace="car", remap={"scan": "front/scan"})
        for node in NODES
    ]
    peer = meet(module_domain_id)
    scans = peer.listen(LaserScan, "/car/front/scan")
    peer.until(
        lambda: len(peer.node.get_publishers_info_by_topic("/car/cmd_vel")) == 1,
        "the gate",
    )
    peer.until(lambda: scans and len(names(peer)) >= len(NODES), "all nodes")
    yield peer
    for process in started:
        process.check()


def names(peer):
    found = {
        f"{space}/{name}" for name, space in peer.node.get_node_names_and_namespaces()
    }
    return {name for name in found if not name.split("/")[-1].startswith("peer_")}


def test_every_node_lies_in_the_namespace(spaced):
    assert names(spaced) == {f"/car/{node}" for node in NODES}


def test_every_topic_is_relative_but_those_that_are_absolute_by_convention(spaced):
    topics = {name for name, _ in spaced.node.get_topic_names_and_types()}
    assert all(name.startswith("/car/") for name in topics - ABSOLUTE)
    assert {
        "/car/cmd_vel",
        "/car/cmd_vel_raw",
        "/car/odom",
        "/car/odometry/filtered",
    } <= topics


def test_every_service_is_relative(spaced):
    services = {name for name, _ in spaced.node.get_service_names_and_types()}
    services = {name for name in services if not name.startswith("/peer_")}
    assert all(name.startswith("/car/") for name in services)
    assert {"/car/policy_node/change_state", "/car/simulator_node/reset"} <= services


def test_a_topic_that_is_remapped_is_so_at_both_ends(spaced):
    def ends(topic):
        look = spaced.node.get_subscriptions_info_by_topic
        return {end.node_name for end in look(topic)}

    listeners = {"middleware_node", "policy_node", "command_gate"}
    spaced.until(lambda: listeners <= ends("/car/front/scan"), "all listeners")
    assert not spaced.node.get_publishers_info_by_topic("/car/scan")
    assert not ends("/car/scan")
