"""Faults around a gate of real processes: how long until the robot is told to stop, and stays so?

Each fault of `nodes.gate_faults` is injected again and again. The worst time counts from the last
good datum before the fault (or from the fault itself, where it is an event); the median, from the
fault. A command is unsafe when it moves the robot after the fault's limit, holds NaN or inf, or
lies outside the limits of the robot. After a freeze of the gate itself its first word must be a
zero.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign, tell
from parts.processes import keep_busy

from nics_drl_bridge.nodes.gate_faults import FAULTS, LATE_S, Setup, inject_all

ROBOT = "ackermann"
TWIST = np.array([0.5, 0.0, 0.1])
MEDIAN_S = 0.30
SHORT_PATIENCE_S = 8.0
# ten times the gate's own [s]
AGES = {"scan_age": 3.0, "odom_age": 3.0, "command_age": 3.0, "e_stop_silence": 2.5}
STANDING = {
    "twist": np.zeros(3),
    "goal": (0.0, 0.0),
    "patience_s": SHORT_PATIENCE_S,
}
CHANGES = {
    "slow_gate": {"parameters": AGES},
    "no_gate": {"gated": False},
    "standing": STANDING,
}


def set_bars(result: Result) -> Bars:
    bars = {}
    for name, figures in result.items():
        bars[name] = {
            "n": at_least(figures["asked"], "injections while the robot moved"),
            "max_s": at_most(figures["limit_s"], "time to zero [s]"),
            "unsafe_commands": at_most(0),
        }
        if figures["limit_s"] == LATE_S:
            bars[name]["p50_s"] = at_most(MEDIAN_S, "median time to zero [s]")
    return bars


def measure(given: Given) -> Result:
    """Injects each fault so often; a gate of its own for each fault."""
    result = {}
    with keep_busy(given.load):
        for name in given.fault or FAULTS:
            with tempfile.TemporaryDirectory() as folder:
                setup = Setup(ROBOT, ROBOT, Path(folder), TWIST)
                setup = replace(setup, **CHANGES.get(given.control, {}))
                found = list(inject_all(setup, name, range(given.repeats), tell))
            tell(f"{name}: {len(found)} of {given.repeats}")
            after_s = [injected.after_s for injected in found] or [np.nan]
            times_s = [injected.time_s for injected in found] or [np.nan]
            result[name] = {
                "n": len(found),
                "asked": given.repeats,
                "p50_s": round(float(np.median(after_s)), 4),
                "max_s": round(max(times_s), 4),
                "limit_s": FAULTS[name].limit_s,
                "unsafe_commands": sum(injected.unsafe for injected in found),
            }
    return result


OPTIONS = {
    "repeats": 30,
    "fault": {"action": "append", "choices": sorted(FAULTS), "help": "only this one"},
    "load": (0, "keep so many cores busy besides"),
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
