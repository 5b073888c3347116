"""A robot that stands still and looks around, for a policy_node of the same environment.

    python deployed_policy.py MODEL POLICY

Prints one JSON object: how many commands came, and what the file says about itself.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.generator import open_model
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

WANTED = 20
DEADLINE_S = 600.0


def drive(name: str, policy: str, folder: Path) -> int:
    """How many commands came until there were enough."""
    lidar = open_model(name).lidar
    domain_id = free_domain_id()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id)
    node = rclpy.create_node("stand_in", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    heard: list[TwistStamped] = []
    node.create_subscription(TwistStamped, "cmd_vel_raw", heard.append, qos.COMMAND)
    scans = node.create_publisher(LaserScan, "scan", qos.SENSOR_RELIABLE)
    odometry = node.create_publisher(Odometry, "odom", qos.SENSOR_RELIABLE)
    ranges = np.full(lidar.beams, 2.0, np.float32)
    still = np.zeros(3)
    parameters = {"model": name, "policy": policy, "goal": [2.0, 0.0]}
    with NodeProcess("policy_node", folder, parameters, domain_id) as process:
        end = time.monotonic() + DEADLINE_S
        while len(heard) < WANTED and time.monotonic() < end:
            process.check()
            now = time.time_ns()
            frames = ("odom", "base_link")
            variance = (1e-3, 1e-3, 1e-3, 1e-3)
            odometry.publish(
                conversions.odometry_to_ros(still, still, now, frames, variance)
            )
            scans.publish(conversions.scan_to_ros(lidar, ranges, now, "laser"))
            executor.spin_once(timeout_sec=0.05)
    node.destroy_node()
    context.try_shutdown()
    return len(heard)


def main() -> None:
    """Drives, and asks `nics policy info`."""
    name, policy = sys.argv[1:]
    from nics_drl_bridge.policy.file.policy_file import load_policy, summary

    facts = summary(load_policy(policy))
    with tempfile.TemporaryDirectory() as folder:
        commands = drive(name, policy, Path(folder))
    print(json.dumps({"commands": commands, "policy_bytes": facts["bytes"]}))


if __name__ == "__main__":
    main()
