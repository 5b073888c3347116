"""A robot and its gate on both ends of a network that loses packets: does it ever move on old data?

The robot (scan, odometry, emergency stop) and the stack (a policy and the real `command_gate`) live
in network namespaces of their own; nftables drops packets where they come in, fragments of a scan
one by one. A command is unsafe when it moves the robot though the newest scan that the policy had
used by then is older than the gate's limit and the tolerance below, or is NaN, or exceeds a limit.

A run in which nothing moved, in which no scan was lost, or whose robot was itself too slow to send,
has measured nothing, and fails.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from campaign import FOLDER, Bar, Bars, Given, Result, at_least, at_most, run_campaign
from gate_faults import ROBOT, TWIST
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from parts.lossy_link import Link, NoNamespacesError, open_link
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.faulty_robot import PERIOD_S, Robot
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.processes import NodeProcess

LOSSES = (5, 20)
# the gate's limit of 0.35 s, and what its tick (0.02 s) and the way to the robot may add
OLDEST_S = 0.40
# Of the scans that were to be sent; a robot without them tells nothing about the gate.
SENT_SHARES = (0.8, 1.2)
REPEAT_S = 0.02
SLOW_SKIP = 3
# limits of the robot's twist [m/s, m/s, rad/s]
LOW = np.array([0.0, 0.0, -0.5])
HIGH = np.array([1.0, 0.0, 0.5])
GATE = ("reset", "arm")
PATIENCE_S = 90.0
STANDING_S = 5.0
DRIVING = "driving"  # what the near end says on a whole network
# Shared memory would go past the network.
NETWORK = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}


class Stack(SpunNode):
    """A policy that answers each scan with the same command, and tells the gate it is located."""

    def __init__(self, is_gated: bool) -> None:
        super().__init__("policy")
        # times of the commands and stamps of their scans, by the system's clock [s]
        self.used: list[tuple[float, float]] = []
        self._last = Twist()
        if not is_gated:
            self._past = self.node.create_publisher(Twist, "cmd_vel", qos.COMMAND)
            # What a careless bridge does: the robot hears the newest command, however old.
            self.node.create_timer(REPEAT_S, lambda: self._past.publish(self._last))
        self._raw = self.node.create_publisher(TwistStamped, "cmd_vel_raw", qos.COMMAND)
        self._estimate = self.node.create_publisher(
            Odometry, "odometry/filtered", qos.COMMAND
        )
        self.node.create_subscription(LaserScan, "scan", self._act, qos.SENSOR)
        self.node.create_subscription(
            Odometry, "odom", self._estimate.publish, qos.SENSOR
        )

    def _act(self, scan: LaserScan) -> None:
        command = TwistStamped(
            header=scan.header, twist=conversions.twist_to_ros(TWIST)
        )
        self._raw.publish(command)
        self._last = command.twist
        stamp = conversions.stamp_from_ros(scan.header.stamp) / NS_PER_S
        self.used.append((time.time(), stamp))


def run_stack(seconds: float, folder: Path, control: str) -> None:
    """The far end, in its namespace; writes what the policy used when the near end has ended."""
    parameters = {
        "model": ROBOT,
        "limits": ROBOT,
        "e_stop_required": True,
        "stop_when_held": False,  # the robot's scans do not show how it moves
        "black_box": str(folder / "black_box"),
        "enable_stamped_cmd_vel": False,
    }
    domain_id = int(os.environ["ROS_DOMAIN_ID"])
    is_gated = control != "no_gate"
    stack = Stack(is_gated)
    with ExitStack() as started:
        started.callback(stack.close)
        if is_gated:
            gate = NodeProcess(
                "command_gate", folder, parameters, domain_id, discovery="SUBNET"
            )
            started.enter_context(gate)
        stack.until((folder / "ended").exists, 2 * PATIENCE_S + seconds)
    (folder / "used.json").write_text(json.dumps(stack.used))


class LossyRobot(Robot):
    quality = qos.SENSOR


def run_robot(seconds: float, folder: Path, control: str) -> None:
    """The near end: drives on a whole network, then says so and drives on."""
    robot = LossyRobot(None, builtin_model(ROBOT), TWIST, True)
    if control == "slow_robot":
        robot.odom_per_scan *= SLOW_SKIP
    robot.silent.add("odometry/filtered")  # the stack has an estimate of its own

    def drive_until(done: Callable[[], bool], patience_s: float) -> None:
        """Arms the gate whenever the robot stands."""
        end = time.monotonic() + patience_s
        while not robot.until(done, min(1.0, end - time.monotonic())):
            if time.monotonic() > end:
                return
            with suppress(TimeoutError):
                for service in () if robot.moves or control == "standing" else GATE:
                    robot.call_service(Trigger, f"command_gate/{service}", 1.0)

    try:
        stands = control in ("standing", "slow_robot")
        drive_until(lambda: robot.moves, STANDING_S if stands else PATIENCE_S)
        print(DRIVING, flush=True)
        sent = robot.sent["scan"]
        drive_until(lambda: False, seconds)
        offset_s = time.time() - time.monotonic()
        heard = [(when + offset_s, twist.tolist()) for when, twist in robot.heard]
        answer = {"scans": robot.sent["scan"] - sent, "heard": heard}
        (folder / "heard.json").write_text(json.dumps(answer))
    finally:
        robot.close()


def count_unsafe(heard: list[Any], used: list[Any], since: float) -> dict[str, Any]:
    """Counts the moving commands, and those on data that were too old, or with wrong values."""
    times = np.array([when for when, _ in heard])
    twists = np.array([twist for _, twist in heard]).reshape(-1, 3)
    moves = twists.any(axis=1)
    judged = moves & (times >= since)
    sent, stamps = np.array([(-np.inf, -np.inf), *used]).T
    newest = np.maximum.accumulate(stamps)
    ages = (times - newest[np.searchsorted(sent, times) - 1])[judged]
    wrong = ~((twists >= LOW) & (twists <= HIGH)).all(axis=1)
    return {
        "moving_commands": len(ages),
        "stops": int((moves[:-1] & ~moves[1:]).sum()),
        "worst_age_s": round(float(max(ages, default=np.nan)), 4),
        "unsafe_commands": int((ages > OLDEST_S).sum() + wrong[judged].sum()),
    }


def measure_loss(
    percent: int, seconds: float, cable: Link, control: str
) -> dict[str, Any]:
    """Drives over a network that loses so many packets of a hundred."""
    environment = os.environ | NETWORK | {"ROS_DOMAIN_ID": str(1 + percent)}
    cable.lose(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts = []
        for end, part in enumerate(("robot", "stack")):
            call = f"run_{part}({seconds}, packet_loss.Path({name!r}), {control!r})"
            code = f"import packet_loss; packet_loss.{call}"
            words = cable.command(end, [sys.executable, "-c", code])
            parts.append(
                subprocess.Popen(
                    words,
                    env=environment,
                    cwd=FOLDER,
                    text=True,
                    stdout=subprocess.PIPE if part == "robot" else None,
                )
            )
        try:
            late = threading.Timer(2 * PATIENCE_S, parts[0].kill)
            late.start()
            while DRIVING not in (parts[0].stdout.readline() or DRIVING):
                pass
            late.cancel()
            since = time.time()
            cable.lose(0 if control == "no_loss" else percent)
            parts[0].wait(PATIENCE_S + seconds)
            (folder / "ended").touch()
            parts[1].wait(PATIENCE_S)
        finally:
            for part in parts:
                part.kill()
        heard = json.loads((folder / "heard.json").read_text())
        used = json.loads((folder / "used.json").read_text())
    return {
        "scans_asked": round(seconds / PERIOD_S),
        "scans_sent": heard["scans"],
        "scans_arrived": sum(stamp >= since for _, stamp in used),
        **count_unsafe(heard["heard"], used, since),
    }


def set_loss_bars(figures: dict[str, Any]) -> Bars:
    """Returns the bars of one loss."""
    low, high = (share * figures["scans_asked"] for share in SENT_SHARES)
    return {
        "scans_sent": Bar(low, high, "invalid: scans that the robot sent"),
        "scans_arrived": at_most(
            figures["scans_sent"] - 1, "invalid: none was lost: scans that arrived"
        ),
        "moving_commands": at_least(1, "invalid: nothing moved: moving commands"),
        "worst_age_s": at_most(OLDEST_S, "age of the data behind a motion [s]"),
        "unsafe_commands": at_most(0),
    }


def measure(given: Given) -> Result:
    """Drives at each loss."""
    runs = {}
    try:
        with open_link() as cable:
            for percent in given.loss or LOSSES:
                runs[f"loss_{percent}"] = measure_loss(
                    percent, given.seconds, cable, given.control or ""
                )
    except NoNamespacesError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(2) from None
    return {"runs": runs}


def set_bars(result: Result) -> Bars:
    return {"runs": {name: set_loss_bars(one) for name, one in result["runs"].items()}}


OPTIONS = {
    "seconds": (60.0, "of driving at each loss"),
    "loss": {"type": int, "action": "append", "help": "of a hundred packets"},
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
