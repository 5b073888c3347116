"""How much of a core does the gate take, beside a bare rclpy node that hears the same?

Around the real `command_gate` a robot publishes over DDS what a vehicle does: scans of 720 beams,
commands and the emergency stop's heartbeat at 10 Hz, odometry and the estimate at 50 Hz. A bare
node, made and spun as in rclpy's examples, has the same subscriptions with callbacks that do
nothing, and publishes a constant at the gate's rate. Both hear the same messages in the same
seconds, so other work of the machine slows both; `ratio` is the gate's share of a core to that
node's. Shares are of whole processes, with the middleware's threads, from /proc (Linux).
"""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import numpy as np
import rclpy
from campaign import Given, Result, at_least, at_most, run_campaign
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from parts.processes import call_apart
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import command_gate, qos
from nics_drl_bridge.nodes.faulty_robot import Robot
from nics_drl_bridge.nodes.load import read_cpu_time
from nics_drl_bridge.nodes.processes import choose_domain_id
from nics_drl_bridge.nodes.start import start

ROBOT = "ackermann"
TWIST = np.array([0.5, 0.0, 0.1])
PATIENCE_S = 60.0
GATE = "command_gate"
TICK_HZ = 50
ODOM_HZ = 50
# The gate itself stops after a gap between two commands of more than 0.2 s.
BARS = {
    "ratio": at_most(1.1, "the gate's share of a core to the bare node's"),
    "longest_gap_s": at_most(0.2, "time without a command [s]"),
    "sent": at_least(0.9, "invalid: share of the messages that were sent"),
    "moving": at_least(0.8, "invalid: share of the commands that came and moved"),
}
REPEATS = 10  # of the decisions of a busy gate
PARAMETERS = {
    "model": ROBOT,
    "limits": ROBOT,
    "e_stop_required": "true",
    "odom_rate": float(ODOM_HZ),
    "rate_tolerance": 0.6,
    "shield": "false",
    "enable_stamped_cmd_vel": "false",
    "stop_when_held": "false",  # the robot's scans do not show how it moves
}


def run_bare_node() -> None:
    """Hears what the gate hears and does nothing, until it is killed."""
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


def run_gate(is_busy: bool) -> None:
    """Runs the gate; a busy one decides ten times on each message."""
    decide = command_gate.decide

    def repeat(*given: Any) -> Any:
        return [decide(*given) for _ in range(REPEATS)][-1]

    if is_busy:
        command_gate.decide = repeat
    start(GATE, [GATE, *sys.argv[1:]])


def measure(given: Given) -> Result:
    """Drives for a time; returns what both processes used of a core, and what came."""
    domain_id = choose_domain_id()
    words = ["--ros-args"]
    for name, value in PARAMETERS.items():
        words += ["-p", f"{name}:={value}"]
    silent = {"stderr": subprocess.DEVNULL}
    call = f"run_gate({given.control is not None})"
    with (
        call_apart(__file__, domain_id, call, *words, **silent) as gate,
        call_apart(__file__, domain_id, "run_bare_node()", **silent) as bare,
    ):
        robot = Robot(domain_id, builtin_model(ROBOT), TWIST, odom_hz=ODOM_HZ)
        try:
            if not robot.until(
                lambda: robot.node.count_subscribers("scan") >= 2, PATIENCE_S
            ):
                raise RuntimeError("the gate or the bare node does not listen")
            robot.drive()
            robot.until(lambda: False, 1.0)
            return measure_shares(robot, gate.pid, bare.pid, given.seconds)
        finally:
            robot.close()


def measure_shares(robot: Robot, gate: int, bare: int, seconds: float) -> Result:
    """Returns what the processes of gate and bare node use while commands pass."""
    robot.heard.clear()
    begin_s = time.monotonic()
    sent = robot.sent["odom"]
    used = np.array([read_cpu_time(gate), read_cpu_time(bare)])
    robot.until(lambda: False, seconds)
    end_s = time.monotonic()
    lasted_s = end_s - begin_s
    used = np.array([read_cpu_time(gate), read_cpu_time(bare)]) - used
    times = [begin_s, *(time_s for time_s, _ in robot.heard), end_s]
    moving = sum(twist.any() for _, twist in robot.heard)
    return {
        "gate_share": used[0] / lasted_s,
        "bare_share": used[1] / lasted_s,
        "ratio": used[0] / used[1] if used[1] else float("nan"),
        "longest_gap_s": float(np.diff(times).max()),
        "sent": (robot.sent["odom"] - sent) / (lasted_s * ODOM_HZ),
        "moving": moving / (lasted_s * TICK_HZ),
    }


if __name__ == "__main__":
    run_campaign(measure, BARS, {"seconds": (30.0, "of driving")})
