"""Upstream's own tools find the nodes and run them."""

from __future__ import annotations

import os
import subprocess

import pytest

pytest.importorskip("ros2cli", reason="needs ros2: nox -s upstream")
from domains import claimed_domain

from upstream.launched import PACKAGE, Launched

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]

NODES = {
    "command_gate",
    "dart_node",
    "middleware_node",
    "mujoco_node",
    "policy_node",
    "record_node",
    "simulator_node",
}


TOPICS = {
    "/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "/odom": "nav_msgs/msg/Odometry",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/tf": "tf2_msgs/msg/TFMessage",
}
SPIN_S = "5"  # how long `ros2` looks around, without a daemon


def ros2(*words: str, domain_id: int | None = None) -> str:
    env = dict(os.environ)
    if domain_id is not None:
        env |= {
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
    done = subprocess.run(
        ["ros2", *words], env=env, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """`ros2` beside a simulation that runs."""
    with (
        claimed_domain() as domain_id,
        Launched(
            "simulation.launch.py",
            tmp_path_factory.mktemp("launch"),
            domain_id,
            model="differential",
            world="corridor",
        ) as launched,
    ):
        launched.runs(
            "simulator_node", "policy_node", "command_gate", "middleware_node"
        )
        yield lambda *words: ros2(*words, domain_id=domain_id)
        launched.ends_well()


def test_ros2_pkg_lists_every_node() -> None:
    listed = ros2("pkg", "executables", PACKAGE).split()
    assert set(listed) >= NODES


@pytest.mark.parametrize("node", sorted(NODES))
def test_ros2_run_starts_a_node_which_tells_of_itself(node: str) -> None:
    assert node in ros2("run", PACKAGE, node, "--help")


def test_ros2_topic_lists_and_hears_what_the_hardware_would_send(running):
    look = ("--no-daemon", "--spin-time", SPIN_S)
    listed = running("topic", "list", "-t", *look)
    for topic, kind in TOPICS.items():
        assert f"{topic} [{kind}]" in listed
    assert "frame_id: odom" in running("topic", "echo", "--once", *look, "/odom")
    assert "range_max: " in running(
        "topic", "echo", "--once", "/scan", "sensor_msgs/msg/LaserScan"
    )


def test_ros2_node_and_param_show_the_nodes_and_what_they_were_given(running):
    nodes = running("node", "list", "--no-daemon", "--spin-time", SPIN_S).split()
    assert {
        "/simulator_node",
        "/policy_node",
        "/command_gate",
        "/middleware_node",
    } <= set(nodes)
    asked = ("/simulator_node", "world", "--no-daemon", "--spin-time", SPIN_S)
    assert "corridor" in running("param", "get", *asked)
    assert "world" in running("param", "list", *asked[:1], *asked[2:])


def test_ros2_lifecycle_takes_the_policy_through_its_states(running):
    look = ("--no-daemon", "--spin-time", SPIN_S)
    for change, state in (
        ("deactivate", "inactive"),
        ("cleanup", "unconfigured"),
        ("configure", "inactive"),
        ("activate", "active"),
    ):
        assert "successful" in running(
            "lifecycle", "set", "/policy_node", change, *look
        )
        assert running("lifecycle", "get", "/policy_node", *look).startswith(state)
