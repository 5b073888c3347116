"""Faults around a gate of real processes: how long until the robot is told to stop, and stays so?

Each fault of `nodes.gate_faults` is injected again and again. The worst time counts from the last
good datum before the fault (or from the fault itself, where it is an event); the median, from the
fault. A command is unsafe when it moves the robot after the fault's limit, holds NaN or inf, or
lies outside the limits of the robot. After a freeze of the gate itself its first word must be a
zero.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from campaign import Given, Result, at_least, at_most, missed_bars, run_campaign
from parts.processes import busy

from nics_drl_bridge.nodes.gate_faults import (
    FAULTS,
    LATE_S,
    Injected,
    Setup,
    inject_all,
)

ROBOT = "ackermann"
TWIST = np.array([0.5, 0.0, 0.1])
LOW = np.array([0.0, 0.0, -0.5])
HIGH = np.array([1.0, 0.0, 0.5])
MEDIAN_S = 0.30
SHORT_PATIENCE_S = 8.0
AGES = {"scan_age": 3.0, "odom_age": 3.0, "command_age": 3.0, "e_stop_silence": 2.5}
"""Ten times the gate's own [s]."""


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


def set_up(control: str, folder: Path) -> Setup:
    """A gate, or what stands for it under a control, and a robot around it."""
    setup = Setup(ROBOT, ROBOT, TWIST, LOW, HIGH, folder)
    if control == "slow_gate":
        return replace(setup, parameters=AGES)
    if control == "no_gate":
        return replace(setup, gated=False)
    if control == "standing":
        still = np.zeros(3)
        return replace(setup, twist=still, goal=(0.0, 0.0), patience_s=SHORT_PATIENCE_S)
    return setup


def measure(given: Given) -> Result:
    """Injects each fault so often; a gate of its own for each fault."""
    result = {}
    with busy(given.load):
        for name in given.fault or FAULTS:
            with tempfile.TemporaryDirectory() as folder:
                setup = set_up(given.control or "", Path(folder))
                found: list[Injected] = []
                for one in inject_all(setup, name, range(given.repeats), tell):
                    found.append(one)
                    tell(f"{name}: {len(found)} of {given.repeats}")
            result[name] = {
                "n": len(found),
                "asked": given.repeats,
                "p50_s": round(
                    float(np.median([one.after_s for one in found] or np.nan)), 4
                ),
                "max_s": round(max((one.time_s for one in found), default=np.nan), 4),
                "limit_s": FAULTS[name].limit_s,
                "unsafe_commands": sum(one.unsafe for one in found),
            }
    return result


def tell(line: str) -> None:
    sys.stderr.write(f"{line}\n")


OPTIONS = {
    "repeats": 30,
    "fault": {"action": "append", "choices": sorted(FAULTS), "help": "only this one"},
    "load": (0, "keep so many cores busy besides"),
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
