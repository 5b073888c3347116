"""Clients without ROS 2 read what a node publishes, and drive it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from sensor_msgs.msg import LaserScan

pytestmark = pytest.mark.ros

CLIENT = Path(__file__).with_name("other_client.py")
# What the ROS wheels leave behind for their children, which would load their libraries.
LEFT = {"LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}


@pytest.mark.parametrize("library", ["cyclonedds", "rosless"])
def test_a_client_without_ros_reads_scans_and_drives(library, launch, meet, domain_id):
    if find_spec(library) is None:
        pytest.skip(f"{library} is not installed")
    start = {"episode_start": [-1.0, 0.0, 0.0], "episode_start_given": True}
    simulator = launch("simulator_node", domain_id, **start)
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "scan")
    peer.until(lambda: scans, "a scan")
    done = subprocess.run(
        [sys.executable, CLIENT, library, str(domain_id)],
        env={key: value for key, value in os.environ.items() if key not in LEFT},
        capture_output=True, text=True, timeout=90,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["beams"] == len(scans[-1].ranges)
    assert told["ahead"][1] < told["ahead"][0] - 0.1
    simulator.check()
