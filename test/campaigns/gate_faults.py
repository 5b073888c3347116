"""Faults around a gate of real processes: how long until the robot is told to stop, and stays so?

The gate, and for some faults the policy, are processes of their own, as on a vehicle; this one
publishes what a robot publishes, over DDS and at 10 Hz, and breaks it while the robot is being told
to move, at any phase. The worst time counts from the last good datum before the fault (or from the
fault itself, where it is an event) to the arrival of a zero on `cmd_vel`; the median, from the
fault. A command is unsafe when it moves the robot after the fault's limit, holds NaN or inf, or
lies outside the limits of the robot. After a freeze of the gate itself its first word must be a
zero.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Given, Result, at_least, at_most, missed_bars, run_campaign
from parts.faults import FAULTS, LATE_S, Around
from parts.faulty_robot import ROBOT, SPEED, NoMotionError, Robot
from parts.processes import busy

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

WATCHED_S = 0.8
MEDIAN_S = 0.30
LOG_CHARACTERS = 500
MOST_IDLE = 3
GATE = "command_gate"
POLICY = "policy_node"
PATIENCE_S = 60.0
SHORT_PATIENCE_S = 8.0
AGES = {"scan_age": 3.0, "odom_age": 3.0, "command_age": 3.0, "e_stop_silence": 2.5}
"""Ten times the gate's own [s]."""


@dataclass
class Times:
    """What one fault led to.

    Attributes:
        unsafe: commands that must not have been.
        times: from the last good datum to zero [s].
        after: from the fault to zero [s].
    """

    unsafe: int = 0
    times: list[float] = field(default_factory=list)
    after: list[float] = field(default_factory=list)


def judge(result: Result) -> list[str]:
    missed = []
    for name, one in result.items():
        bars = {
            "n": at_least(one["asked"], "injections while the robot moved"),
            "max_s": at_most(one["limit_s"], "time to zero [s]"),
            "unsafe_commands": at_most(0),
        }
        if one["limit_s"] == LATE_S:
            bars["p50_s"] = at_most(MEDIAN_S, "median time to zero [s]")
        missed += missed_bars(one, bars, f"{name}: ")
    return missed


def inject(around: Around, name: str, result: Times, patience_s: float) -> None:
    """Drives, breaks something, and watches what the gate says."""
    fault = FAULTS[name]
    robot = around.robot
    ways = [fault.inject] if callable(fault.inject) else fault.inject
    robot.drive(patience_s)
    robot.heard.clear()
    broken = time.monotonic()
    ways[len(result.times) % len(ways)](around)
    robot.until(lambda: False, fault.limit_s + WATCHED_S)
    good = robot.sent_s[fault.since] if fault.since else broken
    moving = [when for when, twist in robot.heard if twist.any()]
    zeros = [when for when, twist in robot.heard if not twist.any()]
    if fault.first_word:  # it may drive on
        moving = [when for when in moving if when < min(zeros, default=float("inf"))]
    last = max(moving, default=broken)
    stopped = min((when for when in zeros if when > last), default=float("inf"))
    result.times.append(stopped - good)
    result.after.append(stopped - broken)
    low = np.array([0.0, 0.0, -0.5])
    high = np.array([1.0, 0.0, 0.5])
    wild = sum(not ((twist >= low) & (twist <= high)).all() for _, twist in robot.heard)
    late = (
        len(moving)
        if fault.first_word
        else sum(w - good > fault.limit_s for w in moving)
    )
    result.unsafe += int(wild) + int(late)


class Bench:
    """A gate, or what stands for it under a control, and a robot around it.

    Args:
        name: of the fault.
        control: what is taken out; empty for nothing.
        stack: ends it all.
    """

    def __init__(self, name: str, control: str, stack: ExitStack) -> None:
        self.domain_id = free_domain_id()
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        given: dict[str, Any] = {
            "model": ROBOT,
            "limits": ROBOT,
            "e_stop_required": True,
        }
        given["black_box"] = str(self.folder / "black_box")
        given["enable_stamped_cmd_vel"] = False
        given["stop_when_held"] = False  # the robot's scans do not show how it moves
        given |= AGES if control == "slow_gate" else {}
        self.gate = None
        if control != "no_gate":
            process = NodeProcess(GATE, self.folder, given, self.domain_id)
            self.gate = stack.enter_context(process)
        policy = FAULTS[name].policy
        speed = 0.0 if control == "standing" else SPEED
        self.robot = Robot(self.domain_id, policy, speed, relayed=control == "no_gate")
        stack.callback(self.robot.close)
        self.goal = [0.0, 0.0] if control == "standing" else [1e6, 0.0]
        self.patience_s = SHORT_PATIENCE_S if control == "standing" else PATIENCE_S


def measure(given: Given) -> Result:
    """Injects each fault so often; a gate of its own for each fault."""
    result = {}
    with busy(given.load):
        for name in given.fault or FAULTS:
            found = Times()
            with ExitStack() as stack:
                bench = Bench(name, given.control or "", stack)
                idle = 0
                while (known := len(found.times)) < given.repeats and idle < MOST_IDLE:
                    _some(bench, name, given.repeats, found)
                    sys.stderr.write(f"{name}: {len(found.times)} of {given.repeats}\n")
                    idle = idle + 1 if known == len(found.times) else 0
            result[name] = {
                "n": len(found.times),
                "asked": given.repeats,
                "p50_s": round(float(np.median(found.after or np.nan)), 4),
                "max_s": round(max(found.times, default=np.nan), 4),
                "limit_s": FAULTS[name].limit_s,
                "unsafe_commands": found.unsafe,
            }
    return result


def _some(bench: Bench, name: str, repeats: int, result: Times) -> None:
    """One injection; or, if the policy outlives it, all of them with one policy."""
    if not FAULTS[name].policy:
        try:
            inject(
                Around(bench.robot, None, bench.gate), name, result, bench.patience_s
            )
        except NoMotionError as error:
            sys.stderr.write(f"{name}: {error}\n")
        return
    given = {"model": ROBOT, "goal": bench.goal}
    with NodeProcess(POLICY, bench.folder, given, bench.domain_id) as policy:
        while len(result.times) < repeats:
            try:
                around = Around(bench.robot, policy, bench.gate)
                inject(around, name, result, bench.patience_s)
            except NoMotionError as error:
                # Nothing was injected yet; who was killed may leave DDS ill.
                told = policy.log.read_text(encoding="utf-8", errors="replace")[
                    -LOG_CHARACTERS:
                ]
                sys.stderr.write(
                    f"{name}: {error}; another policy is started. {told}\n"
                )
                return
            try:
                os.kill(policy.pid, signal.SIGCONT)
                policy.check()
            except (BackendError, ProcessLookupError):
                return


OPTIONS = {
    "repeats": 30,
    "fault": {"action": "append", "choices": sorted(FAULTS), "help": "only this one"},
    "load": (0, "keep so many cores busy besides"),
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
