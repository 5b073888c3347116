"""How much of a core does the gate take, beside a bare rclpy node that hears the same?

Around the real `command_gate` a robot publishes over DDS what a vehicle does: scans of 720 beams,
commands and the emergency stop's heartbeat at 10 Hz, odometry and the estimate at 50 Hz. Beside it
a bare node, made and spun as rclpy's examples do, has the same subscriptions with callbacks that do
nothing, and publishes a constant at the gate's rate. Both hear the same messages in the same
seconds, so that what else the machine does weighs on both; `ratio` is the gate's share of a core to
that node's. Shares are of whole processes, threads of the middleware included, from /proc (Linux).

Then good and NaN commands come in turn for some seconds, each a stop, and the gate is ended by
SIGINT: `exit_s` is how long it still lives. The first of those stops has to be in the black box.
"""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from campaign import Given, Result, at_least, at_most, run_campaign
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from parts.processes import core_seconds, part
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge.gate.black_box import replay
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import command_gate, gate_log, qos
from nics_drl_bridge.nodes.faulty_robot import Robot
from nics_drl_bridge.nodes.processes import free_domain_id
from nics_drl_bridge.nodes.start import start

ROBOT = "ackermann"
TWIST = np.array([0.5, 0.0, 0.1])
PATIENCE_S = 60.0
GATE = "command_gate"
TICK_HZ = 50
ODOM_HZ = 50
MAD_S = 0.5
"""Commands are NaN for so long, then good for so long."""
BARS = {
    "ratio": at_most(1.1, "the gate's share of a core to the bare node's"),
    "longest_gap_s": at_most(0.2, "time without a command [s]"),
    "longest_gap_in_burst_s": at_most(0.2, "time without a command in the burst [s]"),
    "sent": at_least(0.9, "invalid: share of the messages that were sent"),
    "moving": at_least(0.8, "invalid: share of the commands that came and moved"),
    "stops": at_least(3, "invalid: stops in the burst"),
    "exit_s": at_most(2.0, "from SIGINT to the gate's end [s]"),
    "replayed": at_least(1),  # the first stop of the burst, by the black box
}
"""After a gap between two commands of more than 0.2 s the gate itself stops."""
BUSY = 10
HUNG_S = 4.0


def bare_node() -> None:
    """The yardstick: hears what the gate hears and does nothing, until it is killed."""
    rclpy.init()
    node = rclpy.create_node("bare")
    twists = node.create_publisher(Twist, "cmd_vel_of_nobody", qos.COMMAND)
    for kind, topic, profile in (
        (LaserScan, "scan", qos.SENSOR),
        (Odometry, "odom", qos.SENSOR),
        (Odometry, "odometry/filtered", qos.SENSOR),
        (TwistStamped, "cmd_vel_raw", qos.COMMAND),
        (Bool, "e_stop", qos.EVERY_COMMAND),
    ):
        node.create_subscription(kind, topic, lambda _: None, profile)
    node.create_timer(1.0 / TICK_HZ, lambda: twists.publish(Twist()))
    rclpy.spin(node)


class FrozenBox(gate_log.BlackBox):
    """A black box whose writers do nothing, as if their disk hung."""

    def write(self, name: str) -> None:
        super().write(name)
        self._writers[-1].send_signal(signal.SIGSTOP)


def run_gate(control: str) -> None:
    """The gate, but for what a control takes out."""
    if control == "busy":
        command_gate.decide = _often(command_gate.decide)
        for name in ("scan", "odometry", "estimate", "command", "e_stop"):
            setattr(command_gate, name, _often(getattr(command_gate, name)))
    elif control:
        gate_log.BlackBox = FrozenBox
        gate_log.CLOSING_S = HUNG_S
    start(GATE, [GATE, *sys.argv[1:]])


def _often(call: Callable[..., Any]) -> Callable[..., Any]:
    """Something without effects, done again and again."""

    def again(*given: Any) -> Any:
        for _ in range(BUSY - 1):
            call(*given)
        return call(*given)

    return again


def gate(domain_id: int, folder: Path, control: str) -> Any:
    """The gate as a process, or a control's."""
    parameters = {
        "model": ROBOT,
        "limits": ROBOT,
        "e_stop_required": "true",
        "odom_rate": float(ODOM_HZ),
        "black_box": str(folder),
        "rate_tolerance": 0.6,
        "shield": "false",
        "enable_stamped_cmd_vel": "false",
        "stop_when_held": "false",  # the robot's scans do not show how it moves
    }
    given = [f"{name}:={value}" for name, value in parameters.items()]
    words = ["--ros-args", *(word for one in given for word in ("-p", one))]
    call = f"run_gate({control!r})"
    return part(__file__, domain_id, call, *words, stderr=subprocess.DEVNULL)


def measure(given: Given) -> Result:
    """Drives for a time and takes what both processes used of a core; then stops and ends."""
    domain_id = free_domain_id()
    with (
        tempfile.TemporaryDirectory() as name,
        gate(domain_id, Path(name), given.control or "") as real,
        part(__file__, domain_id, "bare_node()", stderr=subprocess.DEVNULL) as bare,
    ):
        robot = Robot(domain_id, builtin_model(ROBOT), TWIST, odom_hz=ODOM_HZ)
        try:
            if not robot.until(lambda: robot.listeners() >= 2, PATIENCE_S):
                raise RuntimeError(
                    f"not within {PATIENCE_S} s: the gate and the bare node"
                )
            robot.drive()
            robot.until(lambda: False, 1.0)
            shares = share_of_a_core(robot, (real.pid, bare.pid), given.seconds)
            return shares | ended_after_a_burst(robot, real, given.burst, Path(name))
        finally:
            robot.close()


def share_of_a_core(
    robot: Robot, pids: tuple[int, int], seconds: float
) -> dict[str, Any]:
    """What the gate and the bare node use while commands pass."""
    robot.heard.clear()
    began = time.monotonic()
    sent = robot.sent["odom"]
    used = [core_seconds(pid) for pid in pids]
    robot.until(lambda: False, seconds)
    lasted = time.monotonic() - began
    sent = robot.sent["odom"] - sent
    of_gate, of_bare = (
        (core_seconds(pid) - was) / lasted for pid, was in zip(pids, used, strict=True)
    )
    times = [began, *(when for when, _ in robot.heard), began + lasted]
    return {
        "seconds": round(lasted, 2),
        "gate_share": round(of_gate, 4),
        "bare_share": round(of_bare, 4),
        "ratio": round(of_gate / of_bare, 3) if of_bare else float("nan"),
        "longest_gap_s": round(float(np.diff(times).max()), 4),
        "sent": round(sent / (lasted * ODOM_HZ), 3),
        "moving": round(
            sum(twist.any() for _, twist in robot.heard) / (lasted * TICK_HZ), 3
        ),
    }


def ended_after_a_burst(
    robot: Robot, real: subprocess.Popen[bytes], seconds: float, folder: Path
) -> dict[str, Any]:
    """Stops again and again, SIGINT, and what is in the black box then."""

    def spoil(message: TwistStamped) -> TwistStamped:
        if time.monotonic() // MAD_S % 2:
            message.twist.linear.x = math.nan
        return message

    robot.heard.clear()
    robot.change["cmd_vel_raw"] = spoil
    robot.until(lambda: False, seconds)
    times = [when for when, _ in robot.heard]
    moving = [bool(twist.any()) for _, twist in robot.heard]
    real.send_signal(signal.SIGINT)
    began = time.monotonic()
    robot.until(lambda: real.poll() is not None, PATIENCE_S)
    exit_s = time.monotonic() - began
    files = sorted(folder.glob("*_command_malformed.jsonl"))
    return {
        "stops": sum(was and not moves for was, moves in pairwise(moving)),
        "longest_gap_in_burst_s": round(float(np.diff(times).max()), 4),
        "exit_s": round(exit_s, 3),
        "files": len(list(folder.iterdir())),
        "replayed": int(bool(files) and replay(files[0]).differing == ()),
    }


OPTIONS = {
    "seconds": (30.0, "of driving"),
    "burst": (15.0, "of stops, before the end [s]"),
}

if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
