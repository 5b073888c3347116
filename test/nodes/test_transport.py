from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes.transport import (
    CHOICES,
    LOCAL,
    PROFILE,
    PROFILES,
    RANGE,
    SEGMENTS,
    SELF_MADE,
    TRANSPORTS,
    UDP,
    prefer_udp,
)

pytestmark = pytest.mark.ros

NODES = ("simulator_node", "command_gate", "policy_node", "middleware_node")
PROFILED = {RANGE: SELF_MADE, PROFILES[0]: str(PROFILE)}
OF_ANOTHER_TREE = "/elsewhere/nics_drl_bridge/nodes/this_machine.xml"


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({RANGE: LOCAL}, PROFILED),
        ({RANGE: LOCAL, TRANSPORTS: UDP}, PROFILED | {TRANSPORTS: UDP}),
        ({RANGE: "SUBNET"}, {RANGE: "SUBNET", TRANSPORTS: UDP}),
        ({RANGE: SELF_MADE}, {RANGE: SELF_MADE, TRANSPORTS: UDP}),
    ],
)
def test_shared_memory_is_off_in_every_range_of_discovery(given, wanted):
    environment = dict(given)
    prefer_udp(environment)
    assert environment == wanted


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (PROFILED, PROFILED),
        (PROFILED | {RANGE: LOCAL}, PROFILED),
        (PROFILED | {PROFILES[0]: OF_ANOTHER_TREE}, PROFILED),
        (PROFILED | {RANGE: "SUBNET"}, {RANGE: "SUBNET", TRANSPORTS: UDP}),
    ],
)
def test_what_a_process_inherits_from_another_does_not_bind_it(given, wanted):
    environment = dict(given)
    prefer_udp(environment)
    assert environment == wanted


@pytest.mark.parametrize("name", [*CHOICES, TRANSPORTS])
def test_who_chooses_for_himself_is_left_alone(name):
    environment = given = {RANGE: LOCAL, name: "mine"}
    prefer_udp(environment)
    assert environment == given


def shared(pid: int) -> bool:
    """Whether a process has shared memory of Fast DDS."""
    maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
    return any(segment in maps for segment in SEGMENTS)


@pytest.mark.parametrize("node", NODES)
def test_no_node_has_shared_memory_in_which_another_could_hold_it_up(launch, meet, domain_id, node):
    process, peer = launch(node, domain_id), meet(domain_id)
    peer.be_known_to(f"/{node}")
    assert not shared(process.pid)


DRIVER = """
import os, sys, time
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
context = Context()
context.init(None)
node, heard = Node("driver", context=context), []
node.create_subscription(Odometry, "odom", lambda each: heard.append(each.header.stamp.sec), 1)
commands = node.create_publisher(Twist, "cmd_vel", 1)
executor = SingleThreadedExecutor(context=context)
executor.add_node(node)
deadline = time.monotonic() + 90.0
while len(set(heard)) < 3:  # in lock-step the world moves by commands alone
    assert time.monotonic() < deadline, heard
    commands.publish(Twist())
    executor.spin_once(timeout_sec=0.01)
with open("/proc/self/maps") as maps:
    sys.exit(0 if "shm/fast" in maps.read() else "it has no shared memory")
"""


def plain(domain_id: int) -> dict[str, str]:
    """The environment of a process of somebody else's."""
    ours = (RANGE, TRANSPORTS, *PROFILES)
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    return kept | {"ROS_DOMAIN_ID": str(domain_id), RANGE: LOCAL}


def test_a_driver_that_has_shared_memory_is_heard_and_hears(launch, domain_id):
    process = launch("simulator_node", domain_id, mode="lockstep")
    done = subprocess.run(
        [sys.executable, "-c", DRIVER],
        env=plain(domain_id),
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    assert done.returncode == 0, done.stderr
    assert not shared(process.pid)


AFTER_ANOTHER = f"""
import os
from rclpy.context import Context
from rclpy.node import Node
from nics_drl_bridge.nodes.runner import open_context
other = Context()
other.init(None)
node = Node("of_somebody_else", context=other)
if {{forgotten}}:
    node.destroy_node()
    other.try_shutdown()
for _ in range(2):
    ours = Node("ours", context=open_context())
    assert os.environ["{RANGE}"] == "{LOCAL}", os.environ
    assert "{PROFILES[0]}" not in os.environ
"""


@pytest.mark.parametrize("forgotten", [False, True])
def test_after_a_node_of_somebody_else_the_range_is_kept_and_a_warning_given(domain_id, forgotten):
    done = subprocess.run(
        [sys.executable, "-c", AFTER_ANOTHER.format(forgotten=forgotten)],
        env=plain(domain_id),
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("a node was started in this process before") == 1
