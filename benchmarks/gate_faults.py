"""Faults around a gate of real processes: how long until the robot is told to stop, and stays so?

The gate, and for some faults the policy, are processes of their own, as on a vehicle; this one
publishes what a robot publishes, over DDS and at 10 Hz, and breaks it. A time counts from the last
good datum before the fault (or from the fault itself, where it is an event) to the arrival of a
zero on `cmd_vel`. A command is unsafe when it moves the robot after the fault's limit, holds NaN
or inf, or lies outside the limits of the robot.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
from nics_drl_bridge.nodes.runner import open_context

ROBOT, PERIOD_S, SPEED = "ackermann", 0.1, 0.5
PATIENCE_S, WATCHED_S = 60.0, 0.8
NANO = conversions.NANO
ALL = frozenset({"scan", "odom", "odometry/filtered", "cmd_vel_raw", "e_stop"})


class Robot:
    """A robot's topics, whole or broken. It does what `cmd_vel` says, unless it is stuck.

    Attributes:
        silent: topics that say nothing.
        change: alters messages by topic before they are sent.
        stuck: odometry shows no motion.
        heard: times [s] and twists (3,) of `cmd_vel`.
        last: the message that each topic sent last.
        sent_s: when each topic sent a good one last [s].
    """

    def __init__(self, domain_id: int, policy: bool) -> None:
        self._lidar = builtin_model(ROBOT).lidar
        self._context = open_context(domain_id=domain_id)
        self.node = Node("robot", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        kinds = {
            "odom": Odometry, "scan": LaserScan, "e_stop": Bool, "cmd_vel_raw": TwistStamped,
            "odometry/filtered": Odometry,
        }  # fmt: skip
        if policy:
            del kinds["cmd_vel_raw"]
        self._topics = {
            name: self.node.create_publisher(kind, name, qos.COMMAND)
            for name, kind in kinds.items()
        }
        self.heard: list[tuple[float, np.ndarray]] = []
        self.node.create_subscription(Twist, "cmd_vel", self._hear, qos.COMMAND)
        self._clients = {
            service: self.node.create_client(Trigger, f"command_gate/{service}")
            for service in ("arm", "reset", "e_stop")
        }
        self.node.create_timer(PERIOD_S, self._send)
        self._now_ns, self._x, self.sent_s = time.time_ns(), 0.0, dict.fromkeys(ALL, 0.0)
        self.last: dict[str, Any] = {}
        self.mend()

    def mend(self) -> None:
        """Everything is well again."""
        self.silent: set[str] = set()
        self.change: dict[str, Callable[[Any], Any]] = {}
        self.stuck, self.jump_ns = False, 0

    def _hear(self, message: Twist) -> None:
        self.heard.append((time.monotonic(), conversions.twist_from_ros(message)))

    def _send(self) -> None:
        speed = self.heard[-1][1][0] if self.heard and not self.stuck else 0.0
        self._now_ns += round(PERIOD_S * NANO)
        self._x += speed * PERIOD_S
        stamp = self._now_ns + self.jump_ns
        odometry = conversions.odometry_to_ros(
            [self._x, 0.0, 0.0], [speed, 0.0, 0.0], stamp, ("odom", "base_link"), (1e-4,) * 4
        )
        ranges = np.full(self._lidar.beams, 2.0 + 0.1 * np.sin(self._now_ns * 1e-9), np.float32)
        self._say("odom", odometry)
        self._say("odometry/filtered", odometry)
        self._say("scan", conversions.scan_to_ros(self._lidar, ranges, stamp, "laser"))
        self._say("e_stop", Bool(data=False))
        command = TwistStamped(twist=conversions.twist_to_ros([SPEED, 0.0, 0.1]))
        if "scan" in self.last:  # what a policy acts on is the scan that it got
            command.header.stamp = self.last["scan"].header.stamp
        self._say("cmd_vel_raw", command)

    def _say(self, name: str, message: Any) -> None:
        if name in self.silent or name not in self._topics:
            return
        if name in self.change:
            message = self.change[name](message)
        elif not self.jump_ns:
            self.sent_s[name] = time.monotonic()
        self._topics[name].publish(message)
        self.last[name] = message

    def press(self) -> None:
        """Presses the emergency stop, by its topic."""
        self._topics["e_stop"].publish(Bool(data=True))

    def until(self, condition: Callable[[], object], seconds: float, what: str = "") -> None:
        """Lives on until something is the case; raises after the time, if it is to be named."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                if what:
                    raise RuntimeError(f"not within {seconds} s: {what}")
                return
            self._executor.spin_once(timeout_sec=0.01)

    def call(self, service: str) -> Trigger.Response:
        """Asks the gate for something."""
        client = self._clients[service]
        self.until(client.service_is_ready, PATIENCE_S, service)
        future = client.call_async(Trigger.Request())
        self.until(future.done, PATIENCE_S, service)
        return future.result()

    @property
    def moves(self) -> bool:
        """Whether the newest command moves it."""
        return bool(self.heard) and bool(self.heard[-1][1].any())

    def drive(self) -> None:
        """Arms the gate and drives, so that a fault finds the robot in motion."""
        self.mend()
        self.until(lambda: False, 3 * PERIOD_S)  # of good data
        self.call("reset")
        answers = [""]

        def armed() -> bool:
            self.until(lambda: False, PERIOD_S)
            response = self.call("arm")
            answers.append(response.message)
            return bool(response.success)

        self.until(armed, PATIENCE_S, f"arming ({answers[-1]})")
        self.until(lambda: self.moves, PATIENCE_S, "motion")
        self.until(lambda: False, 0.5)

    def close(self) -> None:
        """Leaves the graph."""
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self._context.try_shutdown()


Injection = Callable[[Robot, dict[str, NodeProcess]], object]


@dataclass(frozen=True)
class Fault:
    """A way in which something breaks.

    Attributes:
        limit_s: by when the robot must have been told to stop [s].
        inject: breaks it; gets the robot and the processes by name.
        since: the topic whose last good datum the time counts from; empty for the fault itself.
        policy: whether it needs the policy's process.
    """

    limit_s: float
    inject: Injection
    since: str = ""
    policy: bool = False


def _silence(*topics: str) -> Injection:
    return lambda robot, _: robot.silent.update(topics)


def _twist(x: float, turn: float) -> Injection:
    def change(message: TwistStamped) -> TwistStamped:
        message.twist = conversions.twist_to_ros([x, 0.0, turn])
        return message

    return lambda robot, _: robot.change.update({"cmd_vel_raw": change})


def _stamp(topic: str, off_s: float) -> Injection:
    def change(message: LaserScan) -> LaserScan:
        stamp = conversions.stamp_from_ros(message.header.stamp) + round(off_s * NANO)
        message.header.stamp = conversions.stamp_to_ros(stamp)
        return message

    return lambda robot, _: robot.change.update({topic: change})


def _freeze(topic: str, stamped: bool = False) -> Injection:
    """Repeats the last good message, as a frozen driver does; with the stamp of now if wanted."""

    def inject(robot: Robot, _: dict[str, NodeProcess]) -> None:
        held = robot.last[topic]

        def change(message: Any) -> Any:
            if stamped:
                held.header.stamp = message.header.stamp
            return held

        robot.change[topic] = change

    return inject


def _few_beams(robot: Robot, _: dict[str, NodeProcess]) -> None:
    def change(message: LaserScan) -> LaserScan:
        message.ranges = message.ranges[:100]
        return message

    robot.change["scan"] = change


def _kill(how: signal.Signals) -> Injection:
    return lambda _, nodes: os.kill(nodes["policy_node"].pid, how)


FAULTS: dict[str, Fault] = {
    "scan silent": Fault(0.40, _silence("scan"), "scan"),
    "odom silent": Fault(0.40, _silence("odom"), "odom"),
    "all silent": Fault(0.40, _silence(*ALL), "scan"),
    "commands silent": Fault(0.40, _silence("cmd_vel_raw"), "cmd_vel_raw"),
    "command frozen": Fault(0.40, _freeze("cmd_vel_raw"), "cmd_vel_raw"),
    "command NaN": Fault(0.40, _twist(float("nan"), 0.0), "cmd_vel_raw"),
    "command inf": Fault(0.40, _twist(float("inf"), 0.0), "cmd_vel_raw"),
    "command absurd": Fault(0.40, _twist(1e9, 0.0), "cmd_vel_raw"),
    "command from the future": Fault(0.40, _stamp("cmd_vel_raw", 3600.0), "cmd_vel_raw"),
    "scan of another lidar": Fault(0.40, _few_beams, "scan"),
    "scan stamps frozen": Fault(0.40, _freeze("scan"), "scan"),
    "scan stamps from the future": Fault(0.40, _stamp("scan", 3600.0), "scan"),
    "clock jumps ahead": Fault(0.40, lambda robot, _: setattr(robot, "jump_ns", 10 * NANO), "scan"),
    "clock jumps back": Fault(0.40, lambda robot, _: setattr(robot, "jump_ns", -10 * NANO), "scan"),
    "e-stop pressed": Fault(0.10, lambda robot, _: robot.press()),
    "e-stop called": Fault(0.10, lambda robot, _: robot.call("e_stop")),
    "e-stop silent": Fault(0.40, _silence("e_stop"), "e_stop"),
    "scan frozen": Fault(1.50, _freeze("scan", stamped=True), "scan"),
    "no motion": Fault(2.50, lambda robot, _: setattr(robot, "stuck", True)),
    "policy dead": Fault(0.40, _kill(signal.SIGKILL), policy=True),
    "policy hung": Fault(0.40, _kill(signal.SIGSTOP), policy=True),
}


@dataclass
class Result:
    """What one fault led to: the worst time to zero [s], and commands that must not have been."""

    worst_s: float = 0.0
    unsafe: int = 0
    times: list[float] = field(default_factory=list)


def inject(robot: Robot, nodes: dict[str, NodeProcess], fault: Fault, result: Result) -> None:
    """Drives, breaks something, and watches what the gate says."""
    robot.drive()
    robot.heard.clear()
    began = time.monotonic()
    fault.inject(robot, nodes)
    robot.until(lambda: False, fault.limit_s + WATCHED_S)
    began = robot.sent_s[fault.since] if fault.since else began
    after = [(when - began, twist) for when, twist in robot.heard]
    moving = [when for when, twist in after if twist.any()]
    last = max(moving, default=0.0)
    stop = min((when for when, twist in after if when > last), default=float("inf"))
    low, high = np.array([0.0, 0.0, -0.5]), np.array([1.0, 0.0, 0.5])
    wild = sum(not ((twist >= low) & (twist <= high)).all() for _, twist in after)
    result.times.append(stop)
    result.worst_s = max(result.worst_s, stop)
    result.unsafe += int(wild) + sum(when > fault.limit_s for when in moving)


def measure(names: list[str], policy: bool, repeats: int, results: dict[str, Result]) -> None:
    """Injects faults into one set of processes after the other."""
    parameters = {
        "command_gate": {"model": ROBOT, "limits": ROBOT, "e_stop_required": True},
        "policy_node": {"model": ROBOT, "goal": [1e6, 0.0]},
    }
    for _ in range(repeats):
        for batch in [[name] for name in names] if policy else [names]:
            domain_id = free_domain_id()
            with ExitStack() as stack:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                parameters["command_gate"]["black_box"] = str(folder / "black_box")
                nodes = {
                    node: stack.enter_context(NodeProcess(node, folder, given, domain_id))
                    for node, given in parameters.items()
                    if policy or node == "command_gate"
                }
                robot = Robot(domain_id, policy)
                stack.callback(robot.close)
                for name in batch:
                    inject(robot, nodes, FAULTS[name], results.setdefault(name, Result()))


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a stop came late."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--fault", action="append", choices=sorted(FAULTS), help="only this one")
    given = parser.parse_args()
    chosen = given.fault or list(FAULTS)
    results: dict[str, Result] = {}
    for policy in (False, True):
        names = [name for name in chosen if FAULTS[name].policy == policy]
        if names:
            measure(names, policy, given.repeats, results)
    late = [name for name, result in results.items() if result.worst_s > FAULTS[name].limit_s]
    unsafe = sum(result.unsafe for result in results.values())
    if given.json:
        faults = {
            name: {
                "worst_s": round(result.worst_s, 4),
                "limit_s": FAULTS[name].limit_s,
                "times_s": [round(each, 4) for each in result.times],
                "unsafe_commands": result.unsafe,
            }
            for name, result in results.items()
        }
        answer = {"faults": faults, "late": late, "unsafe_commands": unsafe}
        sys.stdout.write(json.dumps(answer) + "\n")
    else:
        for name, result in results.items():
            limit = FAULTS[name].limit_s
            sys.stdout.write(
                f"{name:<30}zero after {result.worst_s:.3f} s at worst, limit {limit:.2f} s, "
                f"unsafe commands {result.unsafe}\n"
            )
    raise SystemExit(1 if late or unsafe else 0)


if __name__ == "__main__":
    main()
