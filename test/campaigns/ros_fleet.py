"""How many robots does one simulator process hold in real time?

A simulator node runs a fleet: each robot with 720-beam scans at 10 Hz and odometry at 50 Hz. A
process of its own commands every robot at 10 Hz, and this one subscribes to all topics, counts
what arrives of each robot, and looks how far from its start its odometry says that it came. A
fleet is held when every topic of every robot arrives at 99 % of its rate at least. Sizes are tried
one after the other, until one is not held.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from campaign import Given, Result, at_least, find_missed, run_campaign
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from parts.processes import call_apart, measure_use
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.load import read_cpu_time
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

SCAN_HZ = 10.0
ODOM_HZ = 50.0
SHARE = 0.99
COMMAND_HZ = 10.0
COMMAND = (0.3, 0.0, 0.3)
# Less is no drive: odometry drifts, and some are placed where they soon touch another one.
DRIVEN_M = 0.1
EACH = {
    "scan": at_least(SHARE * SCAN_HZ),
    "odom": at_least(SHARE * ODOM_HZ),
    "driven_m": at_least(DRIVEN_M),
}
BARS = {"each": {"*": EACH}}
SIZES = (4, 8, 12, 16, 20, 24, 28, 32, 40, 48, 56, 64)
SIDE_PER_ROBOT_M = 3.0
SETTLE_S = 2.0


class Listener(SpunNode):
    """Counts what arrives of each robot that it listens to, from the first on."""

    def __init__(self, domain_id: int, robots: int, heard: int) -> None:
        super().__init__("listener", domain_id)
        self.counts = {f"robot{k + 1}": {"scan": 0, "odom": 0} for k in range(robots)}
        self.driven_m = dict.fromkeys(self.counts, 0.0)
        self._starts: dict[str, Array] = {}
        for name in list(self.counts)[:heard]:
            self._listen(name)

    def _listen(self, name: str) -> None:
        counts = self.counts[name]

        def count_scan(_: bytes) -> None:
            counts["scan"] += 1

        def count_odom(message: bytes) -> None:
            counts["odom"] += 1
            if counts["odom"] % int(ODOM_HZ / COMMAND_HZ) == 0:
                place = wire.read_odometry(message)[0][:2]
                start = self._starts.setdefault(name, place)
                gone = float(np.hypot(*(place - start)))
                self.driven_m[name] = max(self.driven_m[name], gone)

        for kind, topic, take in (
            (LaserScan, "scan", count_scan),
            (Odometry, "odom", count_odom),
        ):
            self.node.create_subscription(
                kind, f"{name}/{topic}", take, qos.SENSOR, raw=True
            )

    def has_heard_all(self) -> bool:
        """Returns whether every topic of every robot was heard."""
        return all(all(counts.values()) for counts in self.counts.values())

    def measure(self, seconds: float) -> dict[str, dict[str, float]]:
        """Returns by robot: rates [1/s] and how far it drove [m]."""
        known = {name: dict(counts) for name, counts in self.counts.items()}
        begin_s = time.monotonic()
        self.until(lambda: False, seconds)
        spent_s = time.monotonic() - begin_s
        told = {}
        for name, counts in self.counts.items():
            told[name] = {"driven_m": round(self.driven_m[name], 3)}
            for topic, count in counts.items():
                told[name][topic] = round((count - known[name][topic]) / spent_s, 3)
        return told


def command(robots: int) -> None:
    """Commands every robot, until its parent is gone."""
    commander = SpunNode("commander")
    topics = [
        commander.node.create_publisher(Twist, f"robot{k + 1}/cmd_vel", qos.COMMAND)
        for k in range(robots)
    ]
    message = wire.write_twist(np.array(COMMAND))

    def publish() -> None:
        for topic in topics:
            topic.publish(message)

    commander.node.create_timer(1.0 / COMMAND_HZ, publish)
    parent = os.getppid()
    commander.until(lambda: os.getppid() != parent, math.inf)


def write_world(file: Path, robots: int) -> None:
    """Writes an empty field with room for all."""
    side = SIDE_PER_ROBOT_M * robots**0.5
    field = {"name": "field", "size": [side, side], "clearance": 0.2}
    file.write_text(dump_yaml(field | {"goal_distance": [1.0, side]}), encoding="utf-8")


def measure_fleet(robots: int, given: Given) -> Result:
    """Runs a fleet, drives it, and listens to it."""
    domain_id = choose_domain_id()
    driven = 0 if given.control == "standing" else robots
    heard = robots - 1 if given.control == "deaf" else robots
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_world(folder / "field.yaml", robots)
        parameters = {
            "model": "ackermann",
            "world": str(folder / "field.yaml"),
            "robots": robots,
            "scan_rate": SCAN_HZ,
            "odom_rate": ODOM_HZ,
            "enable_stamped_cmd_vel": False,
        }
        listener = Listener(domain_id, robots, heard)
        with (
            NodeProcess("simulator_node", folder, parameters, domain_id) as simulator,
            call_apart(__file__, domain_id, f"command({driven})"),
        ):
            listener.until(listener.has_heard_all, given.patience)
            listener.until(lambda: False, SETTLE_S)
            simulator.check()
            used_s = read_cpu_time(simulator.pid)
            told = listener.measure(given.seconds)
            used_s = read_cpu_time(simulator.pid) - used_s
            memory = measure_use(simulator.pid).rss_mb
        listener.close()
    return {
        "robots": robots,
        **{key: min(figures[key] for figures in told.values()) for key in EACH},
        "cpu_cores": round(used_s / given.seconds, 2),
        "rss_mb": round(memory, 1),
        "each": told,
    }


def measure(given: Given) -> Result:
    """Returns the largest fleet that is held, or one of some size."""
    robots = given.robots or (SIZES[0] if given.control else None)
    best = None
    for size in SIZES if robots is None else (robots,):
        run = measure_fleet(size, given)
        if best is not None and find_missed(run, BARS):
            break
        best = run
    return best


OPTIONS = {
    "seconds": (10.0, "to listen to each fleet"),
    "robots": {"type": int, "help": "this size alone"},
    "patience": (90.0, "for the first messages [s]"),
}

if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
