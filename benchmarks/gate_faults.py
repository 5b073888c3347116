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
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from measuring.faulty_robot import ALL, NANO, ROBOT, NoMotionError, Robot
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

WATCHED_S = 0.8
LOG_CHARACTERS, MOST_IDLE = 500, 3
GATE, POLICY = "command_gate", "policy_node"

Injection = Callable[[Robot, NodeProcess | None], object]


@dataclass(frozen=True)
class Fault:
    """A way in which something breaks.

    Attributes:
        limit_s: by when the robot must have been told to stop [s].
        inject: breaks it; gets the robot and the policy's process. Of several, each in turn.
        since: the topic whose last good datum the time counts from; empty for the fault itself.
        policy: whether it needs the policy's process.
    """

    limit_s: float
    inject: Injection | Sequence[Injection]
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

    def inject(robot: Robot, _: NodeProcess | None) -> None:
        held = robot.last[topic]

        def change(message: Any) -> Any:
            if stamped:
                held.header.stamp = message.header.stamp
            return held

        robot.change[topic] = change

    return inject


def _few_beams(robot: Robot, _: NodeProcess | None) -> None:
    def change(message: LaserScan) -> LaserScan:
        message.ranges = message.ranges[:100]
        return message

    robot.change["scan"] = change


def _nan_scan(robot: Robot, _: NodeProcess | None) -> None:
    def change(message: LaserScan) -> LaserScan:
        message.ranges = [float("nan")] * len(message.ranges)
        return message

    robot.change["scan"] = change


def _jump(seconds: int) -> Injection:
    return lambda robot, _: setattr(robot, "jump_ns", seconds * NANO)


def _signal(how: signal.Signals, republished: bool = False) -> Injection:
    """Ends or stops the policy; somebody may go on with its last command."""

    def inject(robot: Robot, policy: NodeProcess | None) -> None:
        if policy is not None:
            os.kill(policy.pid, how)
            robot.republished = republished

    return inject


FAULTS: dict[str, Fault] = {
    "policy_killed": Fault(0.40, _signal(signal.SIGKILL), policy=True),
    "policy_frozen": Fault(0.40, _signal(signal.SIGSTOP), policy=True),
    "policy_hung": Fault(0.40, _signal(signal.SIGSTOP, republished=True), policy=True),
    "scan_silent": Fault(0.40, _silence("scan"), "scan"),
    "odom_silent": Fault(0.40, _silence("odom"), "odom"),
    "nan_scan": Fault(0.40, _nan_scan, "scan"),
    "clock_jump": Fault(0.40, (_jump(10), _jump(-10), _jump(1), _jump(-1)), "scan"),
    "e_stop": Fault(0.10, (lambda robot, _: robot.press(), lambda robot, _: robot.call("e_stop"))),
    "e_stop_silent": Fault(0.40, _silence("e_stop"), "e_stop"),
    "all_silent": Fault(0.40, _silence(*ALL), "scan"),
    "command_silent": Fault(0.40, _silence("cmd_vel_raw"), "cmd_vel_raw"),
    "command_frozen": Fault(0.40, _freeze("cmd_vel_raw"), "cmd_vel_raw"),
    "command_nan": Fault(0.40, _twist(float("nan"), 0.0), "cmd_vel_raw"),
    "command_inf": Fault(0.40, _twist(float("inf"), 0.0), "cmd_vel_raw"),
    "command_absurd": Fault(0.40, _twist(1e9, 0.0), "cmd_vel_raw"),
    "command_from_the_future": Fault(0.40, _stamp("cmd_vel_raw", 3600.0), "cmd_vel_raw"),
    "scan_of_another_lidar": Fault(0.40, _few_beams, "scan"),
    "scan_stamps_frozen": Fault(0.40, _freeze("scan"), "scan"),
    "scan_from_the_future": Fault(0.40, _stamp("scan", 3600.0), "scan"),
    "scan_frozen": Fault(1.50, _freeze("scan", stamped=True), "scan"),
    "no_motion": Fault(2.50, lambda robot, _: setattr(robot, "stuck", True)),
}


@dataclass
class Result:
    """What one fault led to: times to zero [s], and commands that must not have been."""

    unsafe: int = 0
    times: list[float] = field(default_factory=list)

    def summary(self, limit_s: float) -> dict[str, Any]:
        """For the JSON object."""
        return {
            "n": len(self.times),
            "p50_s": round(float(np.median(self.times)), 4),
            "max_s": round(max(self.times), 4),
            "limit_s": limit_s,
            "unsafe_commands": self.unsafe,
        }


def inject(robot: Robot, policy: NodeProcess | None, name: str, result: Result) -> None:
    """Drives, breaks something, and watches what the gate says."""
    fault = FAULTS[name]
    ways = [fault.inject] if callable(fault.inject) else fault.inject
    robot.drive()
    robot.heard.clear()
    began = time.monotonic()
    ways[len(result.times) % len(ways)](robot, policy)
    robot.until(lambda: False, fault.limit_s + WATCHED_S)
    began = robot.sent_s[fault.since] if fault.since else began
    after = [(when - began, twist) for when, twist in robot.heard]
    moving = [when for when, twist in after if twist.any()]
    last = max(moving, default=0.0)
    result.times.append(min((when for when, _ in after if when > last), default=float("inf")))
    low, high = np.array([0.0, 0.0, -0.5]), np.array([1.0, 0.0, 0.5])
    wild = sum(not ((twist >= low) & (twist <= high)).all() for _, twist in after)
    result.unsafe += int(wild) + sum(when > fault.limit_s for when in moving)


def measure(names: Sequence[str], repeats: int, told: Callable[[str], None]) -> dict[str, Result]:
    """Injects each fault so often; a gate of its own for each fault."""
    results = {name: Result() for name in names}
    for name in names:
        domain_id = free_domain_id()
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            gate = {"model": ROBOT, "limits": ROBOT, "e_stop_required": True}
            gate["black_box"] = str(folder / "black_box")
            stack.enter_context(NodeProcess(GATE, folder, gate, domain_id))
            robot = Robot(domain_id, FAULTS[name].policy)
            stack.callback(robot.close)
            idle = 0
            while (known := len(results[name].times)) < repeats:
                _some(robot, folder, domain_id, name, repeats, results[name])
                told(f"{name}: {len(results[name].times)} of {repeats}")
                idle = idle + 1 if known == len(results[name].times) else 0
                if idle == MOST_IDLE:
                    raise NoMotionError(f"{name}: {MOST_IDLE} policies in turn did not drive")
    return results


def _some(
    robot: Robot, folder: Path, domain_id: int, name: str, repeats: int, result: Result
) -> None:
    """One injection; or, if the policy outlives it, all of them with one policy."""
    if not FAULTS[name].policy:
        inject(robot, None, name, result)
        return
    with NodeProcess(POLICY, folder, {"model": ROBOT, "goal": [1e6, 0.0]}, domain_id) as policy:
        while len(result.times) < repeats:
            try:
                inject(robot, policy, name, result)
            except (
                NoMotionError
            ) as error:  # nothing was injected yet; who was killed may leave DDS ill
                told = policy.log.read_text(encoding="utf-8", errors="replace")[-LOG_CHARACTERS:]
                sys.stderr.write(f"{name}: {error}; another policy is started. {told}\n")
                return
            try:
                os.kill(policy.pid, signal.SIGCONT)
                policy.check()
            except (BackendError, ProcessLookupError):
                return


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a stop came late."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--fault", action="append", choices=sorted(FAULTS), help="only this one")
    given = parser.parse_args()
    results = measure(
        given.fault or list(FAULTS), given.repeats, lambda line: sys.stderr.write(f"{line}\n")
    )
    summary = {name: result.summary(FAULTS[name].limit_s) for name, result in results.items()}
    if given.json:
        sys.stdout.write(json.dumps(summary) + "\n")
    else:
        for name, one in summary.items():
            sys.stdout.write(
                f"{name:<26}{one['n']:>3} times, zero after {one['p50_s']:.3f} s, "
                f"{one['max_s']:.3f} s at worst, limit {one['limit_s']:.2f} s, "
                f"unsafe commands {one['unsafe_commands']}\n"
            )
    bad = [one for one in summary.values() if one["max_s"] > one["limit_s"]]
    raise SystemExit(1 if bad or any(one["unsafe_commands"] for one in summary.values()) else 0)


if __name__ == "__main__":
    main()
