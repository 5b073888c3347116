"""Clients without ROS 2 read what a node publishes, and drive it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from sensor_msgs.msg import LaserScan

pytestmark = pytest.mark.ros

CLIENT = Path(__file__).with_name("other_client.py")
# What the ROS wheels leave behind for their children, which would load their libraries.
LEFT = {"LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
ENVIRONMENT = {key: value for key, value in os.environ.items() if key not in LEFT}
# `nox -s clients` installs the libraries into an environment of their own, without ROS 2.
PYTHON = os.environ.get("OTHER_CLIENTS_PYTHON", sys.executable)


def installed(library):
    command = [PYTHON, "-c", f"import {library}"]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True).returncode == 0


@pytest.mark.parametrize("library", ["cyclonedds", "rosless"])
def test_a_client_without_ros_reads_scans_and_drives(library, launch, meet, domain_id):
    if not installed(library):
        pytest.skip(f"{library} is not installed; run nox -s clients")
    # The wall ahead is within the lidar's reach.
    start = {"world": "empty", "episode_start": [1.0, 0.0, 0.0]}
    simulator = launch("simulator_node", domain_id, **start)
    peer = meet(domain_id)
    scans = peer.listen(LaserScan, "scan")
    peer.until(lambda: scans, "a scan")
    done = subprocess.run(
        [PYTHON, CLIENT, library, str(domain_id)],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["beams"] == len(scans[-1].ranges)
    assert told["ahead"][1] < told["ahead"][0] - 0.1
    simulator.check()
