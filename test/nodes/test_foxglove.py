import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes.conversions import find_message_type

pytestmark = pytest.mark.ros

LAYOUT = Path(__file__).resolve().parents[2] / "config" / "foxglove" / "bridge.json"
PANELS = json.loads(LAYOUT.read_text(encoding="utf-8"))["configById"]
# Of others: robot_state_publisher, and a commander that says where to.
FOREIGN = {"/robot_description", "/goal_pose"}
STAMPS = {
    "Twist": "TwistStamped",
    "TwistStamped": "Twist",
}  # a parameter of the nodes chooses


def paths():
    """Every message path that is plotted."""
    return [
        path["value"] for panel in PANELS.values() for path in panel.get("paths", ())
    ]


def shown():
    """Every topic that is shown."""
    listed = {topic for panel in PANELS.values() for topic in panel.get("topics", ())}
    rendered = {
        panel["topicToRender"] for panel in PANELS.values() if "topicToRender" in panel
    }
    return listed | rendered | {path.partition(".")[0] for path in paths()}


@pytest.fixture(scope="module")
def graph(launch, meet, module_domain_id):
    """Names and types of what the nodes of a robot publish, and of what they serve."""
    peer = meet(module_domain_id)
    names = "simulator_node", "middleware_node", "policy_node", "command_gate"
    nodes = [launch(name, module_domain_id) for name in names]
    wanted = shown() - FOREIGN
    served = {"/command_gate/arm", "/simulator_node/reset"}

    def topics():
        return dict(peer.node.get_topic_names_and_types())

    def services():
        return dict(peer.node.get_service_names_and_types())

    peer.until(
        lambda: wanted <= topics().keys() and served <= services().keys(),
        "the graph",
        240,
    )
    yield topics(), services()
    for node in nodes:
        node.check()


def test_every_topic_of_the_layout_is_one_of_the_nodes(graph):
    topics, _ = graph
    assert {"/scan", "/odom", "/odometry/filtered", "/ground_truth"} <= shown()
    assert shown() - FOREIGN <= topics.keys()


def test_every_path_of_the_layout_leads_to_a_number(graph):
    topics, _ = graph
    assert paths()
    for path in paths():
        topic, _, fields = path.partition(".")
        (kind,) = topics[topic]
        package, _, name = kind.rpartition("/")
        kinds = [kind, *([f"{package}/{STAMPS[name]}"] if name in STAMPS else [])]
        assert any(field_of(each, fields) in ("double", "float") for each in kinds), (
            path
        )


def field_of(kind, fields):
    """The type of a field of a message, "" if there is none."""
    for name in fields.split("."):
        known = find_message_type(
            kind if "/msg/" in kind else kind.replace("/", "/msg/")
        )
        kind = known.get_fields_and_field_types().get(name, "") if known else ""
    return kind


def test_a_goal_is_published_where_the_policy_listens(graph):
    topics, _ = graph
    assert topics[PANELS["3D!robot"]["publish"]["poseTopic"]] == [
        "geometry_msgs/msg/PoseStamped"
    ]


def test_every_button_calls_a_service_without_a_request(graph):
    _, services = graph
    called = [
        panel["serviceName"] for panel in PANELS.values() if "serviceName" in panel
    ]
    assert called
    assert {kind for name in called for kind in services[name]} == {
        "std_srvs/srv/Trigger"
    }


def test_every_panel_is_in_the_picture():
    def panels_of(part):
        if isinstance(part, str):
            return [part]
        return [*panels_of(part["first"]), *panels_of(part["second"])]

    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))["layout"]
    assert sorted(panels_of(layout)) == sorted(PANELS)
