"""The policies of sros2 allow what the nodes do, and nothing besides."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from nics_drl_bridge.config import share_folder

NODES = ("simulator_node", "middleware_node", "policy_node", "command_gate")
FOLDER = share_folder() / "config" / "sros2"
NEEDS_MORE = {
    ("subscribe", "/clock"),  # use_sim_time
    ("subscribe", "/pose"),  # pose_type
    ("subscribe", "/imu"),  # imu
    ("subscribe", "/imu/data"),
    ("subscribe", "/ackermann_cmd"),  # ackermann_msgs
    ("publish", "/tf"),  # tf2_msgs
    ("publish", "/tf_static"),
    ("subscribe", "/tf"),
    ("subscribe", "/tf_static"),
    ("subscribe", "/map"),  # nav2_msgs
    ("subscribe", "/speed_limit"),
    ("execute", "/follow_path"),
    ("execute", "/navigate_to_pose"),
}
"""What a node does with other parameters, or where more packages are installed."""


def allowed(file: str) -> dict[str, set[tuple[str, str]]]:
    """By node: (what it may do, the full name)."""
    policy = ElementTree.parse(FOLDER / file).getroot()
    assert (policy.tag, policy.get("version")) == ("policy", "0.2.0")
    rights: dict[str, set[tuple[str, str]]] = {}
    for enclave in policy.iterfind("enclaves/enclave"):
        for profile in enclave.iterfind("profiles/profile"):
            node = str(profile.get("node"))
            assert (enclave.get("path"), profile.get("ns")) == (f"/{node}", "/")
            own = rights.setdefault(node, set())
            for group in profile:
                assert set(group.attrib.values()) == {"ALLOW"}
                for name in group:
                    text = str(name.text)
                    full = text.replace("~", f"/{node}") if text[0] == "~" else text
                    whole = full if full.startswith("/") else f"/{full}"
                    own |= {(what, whole) for what in group.attrib}
    return rights


def test_only_the_gate_may_publish_cmd_vel_and_only_the_policy_what_it_listens_to():
    rights = allowed("policy.xml")
    for topic, sole in (
        ("/cmd_vel", {"command_gate"}),
        ("/cmd_vel_raw", {"policy_node"}),
    ):
        assert {node for node in rights if ("publish", topic) in rights[node]} == sole
    assert not any("*" in name for own in rights.values() for _, name in own)
    assert {
        n
        for n in rights
        if ("publish", "/cmd_vel") in allowed("recording.xml").get(n, ())
    } <= {"record_node"}


def test_nobody_but_the_operator_may_arm_or_reset_the_gate():
    rights = allowed("policy.xml")
    for service in ("arm", "reset", "e_stop"):
        may = {
            n for n in rights if ("request", f"/command_gate/{service}") in rights[n]
        }
        assert may == {"operator"}
        assert ("reply", f"/command_gate/{service}") in rights["command_gate"]


def test_the_shares_hold_both_policies():
    assert {file.name for file in Path(FOLDER).iterdir()} == {
        "policy.xml",
        "recording.xml",
    }


@pytest.fixture(scope="module")
def graph(launch, meet, module_domain_id, tmp_path_factory):
    """Asks the graph of a running stack what a node does."""
    unknown = pytest.importorskip(
        "rclpy.node", reason="needs ROS 2: rclpy is not installed"
    ).NodeNameNonExistentError
    started = [launch(node, module_domain_id) for node in NODES]
    out = str(tmp_path_factory.mktemp("drive") / "drive.npz")
    options = {"robot": "ackermann", "out": out}
    alone = launch("record_node", module_domain_id, "recording", model="", **options)
    peer = meet(module_domain_id)
    look = peer.node

    def does(node, space="/"):
        asked = {
            "publish": look.get_publisher_names_and_types_by_node,
            "subscribe": look.get_subscriber_names_and_types_by_node,
            "reply": look.get_service_names_and_types_by_node,
            "request": look.get_client_names_and_types_by_node,
        }
        prefix = space.rstrip("/")
        try:
            return {
                (what, name.removeprefix(prefix))
                for what, ask in asked.items()
                for name, _ in ask(node, space)
            }
        except unknown:  # not found yet
            return set()

    def complete():
        there = look.get_node_names()
        return set(NODES) <= set(there) and all(
            end in does(node)
            for node, end in (
                ("simulator_node", ("reply", "/simulator_node/pause")),
                ("middleware_node", ("publish", "/odometry/filtered")),
                ("policy_node", ("subscribe", "/odom")),
                ("command_gate", ("reply", "/command_gate/e_stop")),
            )
        )

    peer.until(complete, "all nodes")
    yield does, peer
    for process in started:
        process.check()
    del alone


@pytest.mark.ros
class TestWhatTheNodesDo:
    @pytest.mark.parametrize("node", NODES)
    def test_every_node_may_do_what_it_does_and_nothing_else(self, graph, node):
        does, peer = graph
        rights = allowed("policy.xml")[node]
        at_start = {("request", f"/{node}/get_parameters")}
        # rcl opens it once for all nodes of a name in a process
        shared = {("publish", "/rosout")}
        wanted = rights - NEEDS_MORE - at_start - shared
        peer.until(lambda: wanted <= does(node), f"{wanted - does(node)}")
        assert does(node) - rights == set()

    def test_a_recording_drive_may_do_what_it_does_and_nothing_else(self, graph):
        does, peer = graph
        node = "record_node"
        rights = allowed("recording.xml")[node]
        optional = {("subscribe", "/clock"), ("request", f"/{node}/get_parameters")}
        peer.until(lambda: rights - optional <= does(node, "/recording"), "its ends")
        assert does(node, "/recording") - rights == set()

    @pytest.mark.parametrize("engine", ["dart_node", "mujoco_node"])
    def test_an_engine_may_do_what_the_simulator_may(self, engine):
        rights = allowed("policy.xml")

        def of(node):
            return {
                (what, name.replace(f"/{node}/", "/~/")) for what, name in rights[node]
            }

        assert of(engine) == of("simulator_node")
