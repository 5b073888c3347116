"""How many robots does one simulator process hold in real time?

A simulator node runs a fleet: each robot with 720-beam scans at 10 Hz and odometry at 50 Hz. A
process of its own commands every robot at 10 Hz, and another one subscribes to all topics, counts
what arrives of each robot, and looks how far from its start its odometry says that it came. A
fleet is held when every topic of every robot arrives at 99 % of its rate at least. Sizes are tried
one after the other, each for some seconds after the first message of the last topic.

Bars: a fleet is held, and every robot of it drove. The controls let nobody command, or the listener
miss one robot.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Given, Result, at_least, missed_bars, run_campaign
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from parts.processes import core_seconds, part, use_of
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
from nics_drl_bridge.nodes.spun_node import SpunNode

SCAN_HZ = 10.0
ODOM_HZ = 50.0
SHARE = 0.99
COMMAND_HZ = 10.0
COMMAND = (0.3, 0.0, 0.3)
DRIVEN_M = 0.1
"""Less is no drive: odometry drifts, and some are placed where they soon touch another one."""
BARS = {
    "scan": at_least(SHARE * SCAN_HZ),
    "odom": at_least(SHARE * ODOM_HZ),
    "driven_m": at_least(DRIVEN_M),
}
SIZES = (20, 24, 28, 32, 40, 48, 56, 64)
SIDE_PER_ROBOT_M = 3.0
SETTLE_S = 2.0


class Listener(SpunNode):
    """Counts what arrives of each robot.

    Args:
        robots: how many there are.
        heard: how many are listened to, from the first on.
    """

    def __init__(self, robots: int, heard: int) -> None:
        super().__init__("listener")
        self.counts = {f"robot{k + 1}": {"scan": 0, "odom": 0} for k in range(robots)}
        self.driven = dict.fromkeys(self.counts, 0.0)
        self._starts: dict[str, np.ndarray] = {}
        for name in list(self.counts)[:heard]:
            self._listen(name)

    def _listen(self, name: str) -> None:
        counts = self.counts[name]

        def scan(_: bytes) -> None:
            counts["scan"] += 1

        def odom(message: bytes) -> None:
            counts["odom"] += 1
            if counts["odom"] % int(ODOM_HZ / COMMAND_HZ) == 0:
                place = wire.read_odometry(message)[0][:2]
                gone = float(np.hypot(*(place - self._starts.setdefault(name, place))))
                self.driven[name] = max(self.driven[name], gone)

        for kind, topic, take in ((LaserScan, "scan", scan), (Odometry, "odom", odom)):
            self.node.create_subscription(
                kind, f"{name}/{topic}", take, qos.SENSOR, raw=True
            )

    @property
    def heard_all(self) -> bool:
        """Whether every topic of every robot was heard."""
        return all(all(each.values()) for each in self.counts.values())


def listen(robots: int, heard: int, seconds: float, patience_s: float) -> None:
    """Says when it begins to count, and then by robot: rates [1/s] and how far it drove [m]."""
    listener = Listener(robots, heard)
    listener.until(lambda: listener.heard_all, patience_s)
    listener.until(lambda: False, SETTLE_S)
    known = {name: dict(counts) for name, counts in listener.counts.items()}
    began = time.monotonic()
    sys.stdout.write("counting\n")
    sys.stdout.flush()
    listener.until(lambda: False, seconds)
    spent = time.monotonic() - began
    told = {
        name: {
            **{topic: (counts[topic] - known[name][topic]) / spent for topic in counts},
            "driven_m": listener.driven[name],
        }
        for name, counts in listener.counts.items()
    }
    sys.stdout.write(json.dumps(told) + "\n")


def command(robots: int) -> None:
    """Commands every robot, until its parent is gone."""
    commander = SpunNode("commander")
    topics = [
        commander.node.create_publisher(Twist, f"robot{k + 1}/cmd_vel", qos.COMMAND)
        for k in range(robots)
    ]
    message = wire.write_twist(np.array(COMMAND))
    parent = os.getppid()
    while os.getppid() == parent:
        for topic in topics:
            topic.publish(message)
        time.sleep(1.0 / COMMAND_HZ)


@dataclass(frozen=True)
class Run:
    """What one fleet came to.

    Attributes:
        robots: M.
        scan_hz, odom_hz: of the robot that was heard least.
        driven_m: of the robot that drove least [m].
        cpu_cores: that the simulator's process used.
        rss_mb: its memory.
        each: of each robot: `scan` and `odom` [1/s], and `driven_m`.
    """

    robots: int
    scan_hz: float
    odom_hz: float
    driven_m: float
    cpu_cores: float
    rss_mb: float
    each: dict[str, dict[str, float]]

    @property
    def held(self) -> bool:
        """Whether every robot was heard at its rate."""
        return self.scan_hz >= SHARE * SCAN_HZ and self.odom_hz >= SHARE * ODOM_HZ


def world_file(folder: Path, robots: int) -> Path:
    """An empty field with room for all."""
    side = SIDE_PER_ROBOT_M * robots**0.5
    file = folder / "field.yaml"
    field = {
        "name": "field",
        "size": [side, side],
        "clearance": 0.2,
        "goal_distance": [1.0, side],
    }
    file.write_text(dump_yaml(field), encoding="utf-8")
    return file


def measure_fleet(
    robots: int, seconds: float, patience_s: float, control: str | None
) -> Run:
    """Runs a fleet of `robots`, drives it, and listens to it for `seconds`."""
    domain_id = free_domain_id()
    with tempfile.TemporaryDirectory() as name:
        parameters: dict[str, Any] = {
            "model": "ackermann",
            "world": str(world_file(Path(name), robots)),
            "robots": robots,
            "scan_rate": SCAN_HZ,
            "odom_rate": ODOM_HZ,
            "enable_stamped_cmd_vel": False,
        }
        driven = 0 if control == "standing" else robots
        heard = robots - 1 if control == "deaf" else robots
        listening = f"listen({robots}, {heard}, {seconds}, {patience_s})"
        with (
            NodeProcess(
                "simulator_node", Path(name), parameters, domain_id
            ) as simulator,
            part(__file__, domain_id, f"command({driven})"),
            part(
                __file__, domain_id, listening, stdout=subprocess.PIPE, text=True
            ) as listener,
        ):
            if (
                listener.stdout is None
                or listener.stdout.readline().strip() != "counting"
            ):
                simulator.check()
                raise RuntimeError("the listener ended without a result")
            simulator.check()
            before = core_seconds(simulator.pid)
            began = time.monotonic()
            each = json.loads(listener.stdout.readline())
            cores = (core_seconds(simulator.pid) - before) / (time.monotonic() - began)
            memory = use_of(simulator.pid).rss_mb
    each = {
        name: {key: round(v, 3) for key, v in told.items()}
        for name, told in each.items()
    }
    scan, odom, driven_m = (
        min(told[key] for told in each.values()) for key in ("scan", "odom", "driven_m")
    )
    rates = round(scan, 2), round(odom, 2)
    return Run(robots, *rates, driven_m, round(cores, 2), round(memory, 1), each)


def largest(seconds: float, patience_s: float) -> Run:
    """The largest fleet that is held; the smallest that was tried, where none is."""
    best = measure_fleet(SIZES[0], seconds, patience_s, None)
    for robots in SIZES[1:] if best.held else ():
        run = measure_fleet(robots, seconds, patience_s, None)
        if not run.held:
            break
        best = run
    return best if best.held else smaller(best, seconds, patience_s)


def smaller(failed: Run, seconds: float, patience_s: float) -> Run:
    """The largest fleet below one that was not held."""
    for robots in range(failed.robots - 4, 0, -4):
        run = measure_fleet(robots, seconds, patience_s, None)
        if run.held:
            return run
    return failed


def measure(given: Given) -> Result:
    """The largest fleet that is held, or one of some size."""
    if given.robots or given.control:
        robots = given.robots or SIZES[0]
        run = measure_fleet(robots, given.seconds, given.patience, given.control)
    else:
        run = largest(given.seconds, given.patience)
    return asdict(run)


def judge(result: Result) -> list[str]:
    each = result["each"]
    missed = []
    for key, bar in BARS.items():
        worst = min(each, key=lambda name, key=key: each[name][key])
        where = f"{worst} of {result['robots']}: "
        missed += missed_bars(each[worst], {key: bar}, where)
    return missed


OPTIONS = {
    "seconds": (10.0, "to listen to each fleet"),
    "robots": {"type": int, "help": "this size alone"},
    "patience": (90.0, "for the first messages [s]"),
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
