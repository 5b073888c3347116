"""The nodes of a robot in one namespace: names, rights, conditions, and Foxglove's layout."""

import json
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import NodeNameNonExistentError
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import middleware_node, policy_node
from nics_drl_bridge.nodes.conversions import find_message_type
from nics_drl_bridge.nodes.runner import ERROR, OK, STALE, WARN
from nodes.test_security import NODES, read_rights

pytestmark = pytest.mark.ros

SPACE = "/robot"
ABSOLUTE = {
    "/clock",
    "/tf",
    "/tf_static",
    "/diagnostics",
    "/rosout",
    "/parameter_events",
}
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

PARTS = (
    "command_gate: gate",
    "middleware_node: topics",
    "policy_node: policy",
    "simulator_node: simulator",
)
LAYOUT = json.loads(
    (Path(__file__).resolve().parents[2] / "config/foxglove/bridge.json").read_text()
)
PANELS = LAYOUT["configById"]
# published by robot_state_publisher, and by Foxglove itself
FOREIGN = {"/robot_description", "/goal_pose"}
PATHS = [path["value"] for panel in PANELS.values() for path in panel.get("paths", ())]


class Stack:
    """Four running nodes, and what the graph shows of them."""

    def __init__(self, nodes, peer):
        self.nodes = nodes
        self.peer = peer

    def list_topics(self):
        return dict(self.peer.node.get_topic_names_and_types())

    def list_services(self):
        found = self.peer.node.get_service_names_and_types()
        return {name: kinds for name, kinds in found if not name.startswith("/peer_")}

    def list_ends(self, node, space=SPACE):
        """Pairs of what a node does and the name of the topic or service, below its namespace."""
        look = self.peer.node
        asked = {
            "publish": look.get_publisher_names_and_types_by_node,
            "subscribe": look.get_subscriber_names_and_types_by_node,
            "reply": look.get_service_names_and_types_by_node,
            "request": look.get_client_names_and_types_by_node,
        }
        try:
            return {
                (what, name.removeprefix(space))
                for what, ask in asked.items()
                for name, _ in ask(node, space)
            }
        except NodeNameNonExistentError:  # not discovered yet
            return set()

    def may_do_what_it_does(self, node, rights, optional, space=SPACE):
        """Wait for all that is not optional; nothing else may be there."""
        missing = lambda: rights - optional - self.list_ends(node, space)  # noqa: E731
        self.peer.until(lambda: not missing(), f"ends of {node}: {rights}")
        assert self.list_ends(node, space) - rights == set()


@pytest.fixture(scope="module")
def stack(launch, meet, module_domain_id):
    given = {
        "simulator_node": {"world": "empty"},
        "command_gate": {"limits": "ackermann", "e_stop_required": False},
    }
    nodes = {
        node: launch(node, module_domain_id, SPACE, **given.get(node, {}))
        for node in NODES
    }
    made = Stack(nodes, meet(module_domain_id))
    last = {(node, ("reply", f"/{node}/get_parameters")) for node in NODES}
    made.peer.until(
        lambda: all(end in made.list_ends(node) for node, end in last), "all nodes"
    )
    return made


@pytest.mark.parametrize("node", NODES)
def test_every_node_may_do_what_it_does_and_nothing_else(stack, node):
    at_start = {("request", f"/{node}/get_parameters")}
    shared = {("publish", "/rosout")}  # by one of the nodes in a process
    optional = NEEDS_MORE | at_start | shared
    stack.may_do_what_it_does(node, read_rights("policy.xml")[node], optional)


def test_a_recording_drive_may_do_what_it_does_and_nothing_else(
    stack, launch, module_domain_id, tmp_path
):
    node = "record_node"
    given = {"out": str(tmp_path / "drive.npz"), "duration": 20.0}
    launch(node, module_domain_id, "recording", **given)
    optional = {("subscribe", "/clock"), ("request", f"/{node}/get_parameters")}
    rights = read_rights("recording.xml")[node]
    stack.may_do_what_it_does(node, rights, optional, "/recording")


def test_all_other_names_lie_in_the_namespace(stack):
    own = stack.list_topics().keys() - ABSOLUTE | stack.list_services().keys()
    outside = {name for name in own if not name.startswith(f"{SPACE}/")}
    assert {name for name in outside if not name.startswith("/recording/")} == set()


def test_what_the_layout_shows_publishes_and_calls_is_there(stack):
    listed = {topic for panel in PANELS.values() for topic in panel.get("topics", ())}
    rendered = {panel.get("topicToRender") for panel in PANELS.values()} - {None}
    shown = listed | rendered | {path.partition(".")[0] for path in PATHS}
    assert {"/scan", "/odom", "/odometry/filtered", "/ground_truth"} <= shown
    topics = {
        name.removeprefix(SPACE): kinds for name, kinds in stack.list_topics().items()
    }
    assert shown - FOREIGN <= topics.keys()
    goal = PANELS["3D!robot"]["publish"]["poseTopic"]
    assert topics[goal] == ["geometry_msgs/msg/PoseStamped"]
    for path in PATHS:
        topic, _, fields = path.partition(".")
        (kind,) = topics[topic]
        stamped = kind.replace("/Twist", "/TwistStamped")  # a parameter chooses
        kinds = {find_kind(each, fields) for each in (kind, stamped)}
        assert kinds & {"double", "float"}, path
    services = stack.list_services()
    called = {
        panel["serviceName"] for panel in PANELS.values() if "serviceName" in panel
    }
    kinds = {kind for name in called for kind in services[f"{SPACE}{name}"]}
    assert kinds == {"std_srvs/srv/Trigger"}


def find_kind(kind, fields):
    """Return the type of a field of a message; "" if there is none."""
    for name in fields.split("."):
        whole = kind if "/msg/" in kind else kind.replace("/", "/msg/")
        known = find_message_type(whole)
        kind = known.get_fields_and_field_types().get(name, "") if known else ""
    return kind


def test_every_panel_is_in_the_layout():
    def list_panels(part):
        if isinstance(part, str):
            return [part]
        return [*list_panels(part["first"]), *list_panels(part["second"])]

    assert sorted(list_panels(LAYOUT["layout"])) == sorted(PANELS)


def test_a_held_robot_is_an_error_a_stopped_source_is_stale_and_all_end_in_order(
    stack, monkeypatch
):
    for module in (middleware_node, policy_node):
        monkeypatch.setattr(module, "SILENCE_S", 1.0)
    newest = {}

    def note(message):
        for status in message.status:
            newest[status.name.removeprefix(f"{SPACE}/")] = status.level

    def expect(*levels):
        wanted = dict(zip(PARTS, levels, strict=False))
        newest.clear()
        stack.peer.until(lambda: newest == wanted, f"{wanted}")

    stack.peer.node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
    expect(WARN, OK, OK, OK)  # not armed yet
    assert stack.peer.call(Trigger, f"{SPACE}/command_gate/e_stop").success
    expect(ERROR, OK, OK, OK)
    assert stack.nodes["simulator_node"].close() == 0
    expect(ERROR, STALE, STALE)
    for name, node in stack.nodes.items():
        assert node.close() == 0, name
        assert "Traceback" not in node.read_text()
