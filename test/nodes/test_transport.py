import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes.processes import NodeProcess
from nics_drl_bridge.nodes.transport import (
    LOCAL,
    ONLY_LOCAL,
    PROFILES,
    RANGE,
    SEGMENTS,
    TRANSPORTS,
    UDP,
    chosen,
    multicast_port,
    ports_of,
    stay_on_this_machine,
    stays_here,
)

pytestmark = pytest.mark.ros


WARNING = "Fast DDS did not apply "


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"ROS_DISTRO": "jazzy"}, {RANGE: LOCAL}),
        ({"ROS_DISTRO": "jazzy", RANGE: "SUBNET"}, {RANGE: "SUBNET"}),
        ({"ROS_DISTRO": "humble"}, {RANGE: LOCAL, ONLY_LOCAL: "1"}),
        ({"ROS_DISTRO": "humble", ONLY_LOCAL: "0"}, {RANGE: LOCAL, ONLY_LOCAL: "0"}),
    ],
)
def test_discovery_stays_on_this_machine_unless_the_environment_says_otherwise(
    given, wanted
):
    environment = dict(given)
    stay_on_this_machine(environment)
    assert environment == given | wanted


@pytest.mark.parametrize(
    ("environment", "here"),
    [
        ({RANGE: LOCAL}, True),
        ({RANGE: "localhost"}, True),  # rcl takes it for LOCALHOST
        ({RANGE: "SUBNET"}, False),
        ({RANGE: "SUBNET", ONLY_LOCAL: "1"}, True),
        ({RANGE: LOCAL, ONLY_LOCAL: "0"}, True),
        ({RANGE: LOCAL, "ROS_DISTRO": "humble", ONLY_LOCAL: "1"}, True),
        ({RANGE: LOCAL, "ROS_DISTRO": "humble", ONLY_LOCAL: "0"}, False),
    ],
)
def test_how_far_discovery_goes_is_read_as_rcl_reads_it(environment, here):
    assert stays_here(environment) == here


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, False),
        ({TRANSPORTS: UDP}, False),
        ({TRANSPORTS: "DEFAULT"}, True),
        ({PROFILES[1]: "mine.xml"}, True),
        ({ONLY_LOCAL: "1"}, False),
    ],
)
def test_who_names_other_transports_or_profiles_has_chosen(environment, expected):
    assert chosen(environment) == expected


def is_apart(process: NodeProcess, domain_id: int) -> bool:
    """Whether a node has neither shared memory of Fast DDS nor the multicast of its domain."""
    maps = Path(f"/proc/{process.pid}/maps").read_bytes()
    ports = ports_of(process.pid)
    assert ports
    shares = any(segment in maps for segment in SEGMENTS)
    return not shares and multicast_port(domain_id) not in ports


@pytest.mark.process
def test_nodes_have_udp_on_this_machine_alone(launch_process, meet, domain_id):
    process = launch_process("command_gate", domain_id)
    meet(domain_id).be_known_to("/command_gate")
    assert is_apart(process, domain_id)


def run(code: str, domain_id: int, folder: Path, **environment: str) -> str:
    """What a Python process says that has nothing of this one's environment on DDS."""
    ours = (RANGE, ONLY_LOCAL, TRANSPORTS, *PROFILES)
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=kept | {"ROS_DOMAIN_ID": str(domain_id)} | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


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


@pytest.mark.process
def test_a_driver_that_has_shared_memory_is_heard_and_hears(
    launch_process, domain_id, tmp_path
):
    process = launch_process("simulator_node", domain_id, mode="lockstep")
    run(DRIVER, domain_id, tmp_path, **{RANGE: LOCAL})
    assert is_apart(process, domain_id)


IN_ORDER = f"""
import os
from pathlib import Path
from rclpy.context import Context
from rclpy.node import Node
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.transport import multicast_port, ports_of

def ours(where=None):
    if where is not None:
        os.environ["{RANGE}"] = where
    return Node("ours", context=open_context())

def plain():
    context = Context()
    context.init(None)
    return Node("of_somebody_else", context=context)

def shared():
    return b"shm/fast" in Path("/proc/self/maps").read_bytes()

def multicast():
    return multicast_port(int(os.environ["ROS_DOMAIN_ID"])) in ports_of()
"""


@pytest.mark.process
def test_the_environment_is_left_as_it_was_found(domain_id, tmp_path):
    code = "before = dict(os.environ)\nends = [ours(), ours()]\n"
    code += f"assert os.environ == before | {{'{RANGE}': '{LOCAL}'}}\n"
    code += "assert not shared() and not multicast()"
    assert WARNING not in run(IN_ORDER + code, domain_id, tmp_path)


@pytest.mark.process
def test_after_a_node_of_somebody_else_discovery_stays_here_with_a_warning(
    domain_id, tmp_path
):
    code = "other = plain()\nends = [ours(), ours()]\nassert not multicast()"
    said = run(IN_ORDER + code, domain_id, tmp_path, **{RANGE: LOCAL})
    assert said.count(WARNING) == 1


@pytest.mark.process
def test_discovery_does_not_silently_stay_here_where_a_subnet_is_asked_for(
    domain_id, tmp_path
):
    code = "first = ours()\n"
    code += "try:\n    ours('SUBNET')\nexcept BackendError as error:\n"
    code += (
        "    assert 'SUBNET, but an earlier node in this process keeps' in str(error)\n"
    )
    code += "else:\n    raise AssertionError('a subnet that nobody sees')"
    run(IN_ORDER + code, domain_id, tmp_path)


@pytest.mark.process
def test_the_older_word_for_this_machine_is_heeded(domain_id, tmp_path):
    code = "first = ours()\nassert not multicast() and not shared()"
    run(IN_ORDER + code, domain_id, tmp_path, **{ONLY_LOCAL: "1"})


@pytest.mark.process
def test_the_probe_offers_nothing_that_rights_would_have_to_allow(domain_id, tmp_path):
    code = (
        "import nics_drl_bridge.nodes.transport as transport\n"
        "seen = []\n"
        "class Watched(transport.Node):\n"
        "    def destroy_node(self):\n"
        "        seen.append([self.get_name()] + [name for ends in (self.publishers,\n"
        "            self.subscriptions) for name in sorted(each.topic_name for each in ends)]\n"
        "            + [each.srv_name for each in self.services])\n"
        "        super().destroy_node()\n"
        "transport.Node = Watched\n"
        "ours()\n"
        "assert seen == [['transport_probe', '/parameter_events']], seen\n"
    )
    run(IN_ORDER + code, domain_id, tmp_path)
