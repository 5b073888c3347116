"""How many robots does one simulator process hold in real time?

A simulator node runs a fleet: each robot with 720-beam scans at 10 Hz and odometry at 50 Hz. A
process of its own subscribes to all of it and counts what arrives. A fleet is held when every
topic of every robot arrives at 99 % of its rate at least. Sizes are tried one after the other,
each for some seconds after the first message of the last topic.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

SCAN_HZ, ODOM_HZ, SHARE = 10.0, 50.0, 0.99
SIZES = (20, 24, 28, 32, 40, 48, 56, 64)
SIDE_PER_ROBOT_M = 3.0
PATIENCE_S = 90.0
LISTENER = """
import json, sys, time
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.executor import StandingExecutor
from nics_drl_bridge.nodes.runner import open_context

robots, seconds, patience = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
context = open_context()
node = Node("listener", context=context, start_parameter_services=False)
counts = {}

def counter(topic):
    def count(_):
        counts[topic] += 1
    counts[topic] = 0
    return count

for k in range(robots):
    for kind, name in ((LaserScan, "scan"), (Odometry, "odom")):
        topic = f"robot{k + 1}/{name}"
        node.create_subscription(kind, topic, counter(topic), qos.SENSOR, raw=True)
executor = StandingExecutor(context)
executor.add_node(node)
deadline = time.monotonic() + patience
while not all(counts.values()) and time.monotonic() < deadline:
    executor.spin_once(timeout_sec=0.1)
settled = time.monotonic() + 2.0
while time.monotonic() < settled:
    executor.spin_once(timeout_sec=0.1)
known, began = dict(counts), time.monotonic()
sys.stdout.write("counting\\n")
sys.stdout.flush()
while time.monotonic() < began + seconds:
    executor.spin_once(timeout_sec=0.1)
spent = time.monotonic() - began
print(json.dumps({topic: (count - known[topic]) / spent for topic, count in counts.items()}))
"""


@dataclass(frozen=True)
class Run:
    """What one fleet came to.

    Attributes:
        robots: M.
        scan_hz, odom_hz: of the robot that was heard least.
        cpu_cores: that the simulator's process used.
        rss_mb: its memory.
    """

    robots: int
    scan_hz: float
    odom_hz: float
    cpu_cores: float
    rss_mb: float

    @property
    def held(self) -> bool:
        """Whether every robot was heard at its rate."""
        return self.scan_hz >= SHARE * SCAN_HZ and self.odom_hz >= SHARE * ODOM_HZ


def world_file(folder: Path, robots: int) -> Path:
    """An empty field with room for all."""
    side = SIDE_PER_ROBOT_M * robots**0.5
    file = folder / "field.yaml"
    field = {"name": "field", "size": [side, side], "clearance": 0.2, "goal_distance": [1.0, side]}
    file.write_text(dump_yaml(field), encoding="utf-8")
    return file


def cpu_seconds(pid: int) -> float:
    """Processor time that a process and all its threads have used."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int) -> float:
    """Resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(robots: int, seconds: float) -> Run:
    """Runs a fleet of `robots` and listens to it for `seconds`."""
    domain_id = free_domain_id()
    with tempfile.TemporaryDirectory() as name:
        parameters: dict[str, Any] = {
            "model": "ackermann",
            "world": str(world_file(Path(name), robots)),
            "robots": robots,
            "scan_rate": SCAN_HZ,
            "odom_rate": ODOM_HZ,
        }
        with NodeProcess("simulator_node", Path(name), parameters, domain_id) as simulator:
            listener = subprocess.Popen(
                [sys.executable, "-c", LISTENER, str(robots), str(seconds), str(PATIENCE_S)],
                env=os.environ
                | {
                    "ROS_DOMAIN_ID": str(domain_id),
                    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                },
                stdout=subprocess.PIPE,
                text=True,
            )
            if listener.stdout is None or listener.stdout.readline().strip() != "counting":
                simulator.check()
                raise RuntimeError("the listener ended without a result")
            simulator.check()
            before, began = cpu_seconds(simulator.pid), time.monotonic()
            line = listener.stdout.readline()
            cores = (cpu_seconds(simulator.pid) - before) / (time.monotonic() - began)
            memory = rss_mb(simulator.pid)
            listener.wait()
    rates = json.loads(line)
    scan, odom = (
        min(rate for topic, rate in rates.items() if topic.endswith(end))
        for end in ("scan", "odom")
    )
    return Run(robots, round(scan, 2), round(odom, 2), round(cores, 2), round(memory, 1))


def largest(seconds: float) -> Run:
    """The largest fleet that is held, or the smallest that was tried."""
    best = measure(SIZES[0], seconds)
    for robots in SIZES[1:] if best.held else ():
        run = measure(robots, seconds)
        if not run.held:
            break
        best = run
    return best if best.held else smaller(best, seconds)


def smaller(failed: Run, seconds: float) -> Run:
    """The largest fleet below one that was not held."""
    for robots in range(failed.robots - 4, 0, -4):
        run = measure(robots, seconds)
        if run.held:
            return run
    return failed


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--seconds", type=float, default=10.0, help="to listen to each fleet")
    parser.add_argument("--robots", type=int, help="this size alone")
    given = parser.parse_args()
    run = largest(given.seconds) if given.robots is None else measure(given.robots, given.seconds)
    result = vars(run)
    if given.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        for key, value in result.items():
            sys.stdout.write(f"{key:<12}{value}\n")


if __name__ == "__main__":
    main()
