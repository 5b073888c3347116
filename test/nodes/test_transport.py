"""Which transports and discovery the processes of this package have."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from nics_drl_bridge.nodes.transport import (
    BY_PROFILE,
    FIRST_PORT,
    LOCAL,
    ONLY_LOCAL,
    PORTS_OF_A_DOMAIN,
    PROFILE,
    PROFILES,
    RANGE,
    RMW,
    TRANSPORTS,
    UDP,
    find_used_domains,
    set_transport,
)

KILTED = {"ROS_DISTRO": "kilted"}
HERE = {**KILTED, RANGE: BY_PROFILE, PROFILES[0]: str(PROFILE)}
HUMBLE = {"ROS_DISTRO": "humble"}
HERE_HUMBLE = {**HUMBLE, RANGE: BY_PROFILE, PROFILES[1]: str(PROFILE)}
PEER = {"ROS_STATIC_PEERS": "10.0.0.2"}
SUBNET = {RANGE: "SUBNET"}


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, HERE),
        ({RANGE: LOCAL}, HERE),
        ({RANGE: "localhost"}, HERE),  # rcl takes it for LOCALHOST
        (HERE, HERE),  # inherited
        ({**HERE, RANGE: LOCAL}, HERE),
        ({**HERE, **SUBNET}, {**KILTED, **SUBNET, TRANSPORTS: UDP}),
        (SUBNET, {**SUBNET, TRANSPORTS: UDP}),
        ({**SUBNET, ONLY_LOCAL: "1"}, HERE),
        (HUMBLE, HERE_HUMBLE),
        (
            {**HUMBLE, ONLY_LOCAL: "0"},
            {**HUMBLE, ONLY_LOCAL: "0", RANGE: LOCAL, TRANSPORTS: UDP},
        ),
        # What the user has chosen stays.
        ({TRANSPORTS: "DEFAULT"}, {TRANSPORTS: "DEFAULT", RANGE: LOCAL}),
        ({PROFILES[1]: "mine.xml"}, {PROFILES[1]: "mine.xml", RANGE: LOCAL}),
        (PEER, {**PEER, RANGE: LOCAL}),
        ({RMW: "rmw_zenoh_cpp"}, {RMW: "rmw_zenoh_cpp", RANGE: LOCAL}),
    ],
)
def test_an_environment_gets_udp_on_this_machine_unless_it_chooses_otherwise(
    chosen, expected
):
    environment = KILTED | chosen
    set_transport(environment)
    assert environment == KILTED | expected


def test_a_domain_is_in_use_while_a_port_of_it_is_bound():
    domain_id = min(set(range(1, 101)) - find_used_domains())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", FIRST_PORT + PORTS_OF_A_DOMAIN * domain_id + 10))
        assert domain_id in find_used_domains()


def is_apart(process, domain_id):
    """Whether a node has neither shared memory of Fast DDS nor the multicast of its domain."""
    maps = Path(f"/proc/{process.pid}/maps").read_bytes()
    held = {os.readlink(file) for file in Path(f"/proc/{process.pid}/fd").iterdir()}
    rows = Path("/proc/net/udp").read_text().splitlines()[1:]
    fields = [row.split() for row in rows]
    ports = {
        int(each[1].split(":")[1], 16)
        for each in fields
        if f"socket:[{each[9]}]" in held
    }
    assert ports
    multicast = FIRST_PORT + PORTS_OF_A_DOMAIN * domain_id
    return b"shm/fast" not in maps and multicast not in ports


DRIVER = """
import sys, time
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
with open("/proc/self/maps", "rb") as maps:
    sys.exit(0 if b"shm/fast" in maps.read() else "it has no shared memory")
"""


@pytest.mark.ros
@pytest.mark.process
def test_a_node_has_udp_on_this_machine_and_a_driver_with_shared_memory_is_heard(
    launch_process, domain_id
):
    process = launch_process("simulator_node", domain_id, mode="lockstep")
    ours = (RANGE, ONLY_LOCAL, TRANSPORTS, *PROFILES)
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    own = {"ROS_DOMAIN_ID": str(domain_id), RANGE: LOCAL}
    driver = [sys.executable, "-c", DRIVER]
    subprocess.run(driver, env=kept | own, check=True, timeout=120.0)
    assert is_apart(process, domain_id)
