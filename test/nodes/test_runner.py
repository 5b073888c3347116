from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes.runner import stay_on_this_machine

pytestmark = pytest.mark.ros

RANGE, LOCAL = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"ROS_DISTRO": "jazzy"}, {RANGE: "LOCALHOST"}),
        ({"ROS_DISTRO": "jazzy", RANGE: "SUBNET"}, {RANGE: "SUBNET"}),
        ({"ROS_DISTRO": "humble"}, {RANGE: "LOCALHOST", LOCAL: "1"}),
        ({"ROS_DISTRO": "humble", LOCAL: "0"}, {RANGE: "LOCALHOST", LOCAL: "0"}),
    ],
)
def test_discovery_stays_on_this_machine_unless_the_environment_says_otherwise(given, wanted):
    environment = dict(given)
    stay_on_this_machine(environment)
    assert environment == given | wanted
