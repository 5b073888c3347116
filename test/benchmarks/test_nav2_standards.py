from __future__ import annotations

from pathlib import Path

import pytest
from domains import claimed_domain

from .runs import CAMPAIGNS, asked

pytestmark = pytest.mark.process
ROOT = Path(__file__).resolve().parents[2]
ARCHIVE = ROOT.parent / "shared" / "upstream" / "nav2_interfaces.tar.gz"


@pytest.mark.campaign
def test_without_obstacles_nodes_and_a_known_controller_the_bars_are_missed():
    code, result = asked("nav2_standards.py", "--control", "bare", "--episodes", "1")
    assert code == 1
    missed = " ".join(result["failures"])
    assert "map_agreement" in missed
    for name, bad in (
        ("follow_path_success", lambda v: v == 0.0),
        ("nav2_names_missing", bool),
    ):
        if result[name] is not None:  # its messages are installed
            assert bad(result[name])
            assert name in missed


@pytest.mark.ros
@pytest.mark.campaign
@pytest.mark.timeout(900)
@pytest.mark.skipif(not ARCHIVE.is_file(), reason="needs Nav2's parameter file")
def test_paths_are_followed_and_every_name_of_nav2_is_served():
    pytest.importorskip("nav2_msgs", reason="needs what `make test-messages` builds")
    code, result = asked("nav2_standards.py", "--episodes", "3")
    assert (code, result["missing"], result["not_followed"]) == (0, [], [])


def test_what_nodes_of_nav2_say_to_each_other_is_not_asked_of_the_robot(
    monkeypatch, tmp_path
):
    monkeypatch.syspath_prepend(CAMPAIGNS)
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    from parts import nav2_names

    file = tmp_path / "nav2.yaml"
    file.write_text(
        "collision_monitor:\n  ros__parameters:\n    cmd_vel_in_topic: cmd_vel_raw\n"
        "    odom_topic: /odometry/filtered\n    polygon: {polygon_pub_topic: polygon_stop}\n"
    )
    topics, _ = nav2_names.wanted(file)
    assert topics - nav2_names.ALWAYS == {"odometry/filtered"}
    assert topics <= nav2_names.TYPES.keys()


@pytest.mark.ros
@pytest.mark.parametrize(
    ("topic", "hears", "durable", "reliable", "fault"),
    [
        ("map", False, True, True, ""),
        ("map", False, False, True, "transient local"),
        ("odom", False, False, True, ""),
        ("odom", False, False, False, "reliab"),
        ("cmd_vel", True, False, False, ""),
        ("cmd_vel", True, True, True, "transient local"),
    ],
)
def test_a_topic_whose_quality_of_service_does_not_fit_is_named(
    monkeypatch, topic, hears, durable, reliable, fault
):
    monkeypatch.syspath_prepend(CAMPAIGNS)
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import OccupancyGrid, Odometry
    from parts import nav2_names
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    from nics_drl_bridge.nodes.listener import holds, open_context

    durability = (
        DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE
    )
    reliability = (
        ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    )
    profile = QoSProfile(depth=1, durability=durability, reliability=reliability)
    kind = {"map": OccupancyGrid, "odom": Odometry, "cmd_vel": Twist}[topic]
    with claimed_domain() as domain_id:
        context = open_context(domain_id=domain_id)
        robot = Node("robot", context=context)
        asker = Node("asker", context=context)
        if hears:
            robot.create_subscription(kind, topic, print, profile)
        else:
            robot.create_publisher(kind, topic, profile)

        def said() -> str:
            return "".join(nav2_names.unserved_topics(asker, {topic})).lower()

        # Of an end that is not yet known it says that there is none.
        assert holds(lambda: fault in said() if fault else not said(), 10.0, 0.05), (
            said()
        )
        for node in (robot, asker):
            node.destroy_node()
        context.try_shutdown()
