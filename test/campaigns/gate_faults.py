"""Faults around a gate of real processes: how long until the robot is told to stop, and stays so?

Each fault of `nodes.gate_faults` is injected again and again. The worst time counts from the last
good datum before the fault (or from the fault itself, where it is an event); the median, from the
fault. A command is unsafe when it moves the robot after the fault's limit, holds NaN or inf, or
lies outside the limits of the robot. After a freeze of the gate itself its first word must be a
zero.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign, tell
from domains import claimed_domain
from parts.processes import keep_busy

from nics_drl_bridge.nodes.gate_faults import FAULTS, LATE_S, Setup, inject_all
from nics_drl_bridge.nodes.transport import set_transport

ROBOT = "ackermann"
TWIST = np.array([0.5, 0.0, 0.1])
MEDIAN_S = 0.30
MEDIAN_OF = 5  # the median of fewer injections is chance
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
        if figures["limit_s"] == LATE_S and figures["asked"] >= MEDIAN_OF:
            bars[name]["p50_s"] = at_most(MEDIAN_S, "median time to zero [s]")
    return bars


def measure_fault(name: str, given: Given) -> dict[str, Any]:
    """Injects a fault so often, around a gate of its own."""
    with tempfile.TemporaryDirectory() as folder:
        setup = Setup(ROBOT, ROBOT, Path(folder), TWIST)
        setup = replace(setup, **CHANGES.get(given.control, {}))
        found = list(inject_all(setup, name, range(given.repeats), tell))
    tell(f"{name}: {len(found)} of {given.repeats}")
    after_s = [injected.after_s for injected in found] or [np.nan]
    times_s = [injected.time_s for injected in found] or [np.nan]
    return {
        "n": len(found),
        "asked": given.repeats,
        "p50_s": round(float(np.median(after_s)), 4),
        "max_s": round(max(times_s), 4),
        "limit_s": FAULTS[name].limit_s,
        "unsafe_commands": sum(injected.unsafe for injected in found),
    }


def measure(given: Given) -> Result:
    """Injects each fault; most of the time passes while nodes start and gates are watched."""
    names = given.fault or list(FAULTS)
    about = partial(measure_fault, given=given)
    with keep_busy(given.load), make_pool(given.at_once) as pool:
        return dict(zip(names, pool.map(about, names), strict=True))


@contextmanager
def make_pool(at_once: int) -> Iterator[ProcessPoolExecutor]:
    """Makes processes, each with a ROS domain of its own."""
    spawn = get_context("spawn")
    domains = spawn.Queue()
    with ExitStack() as claimed:
        for _ in range(at_once):
            domains.put(claimed.enter_context(claimed_domain()))
        yield claimed.enter_context(
            ProcessPoolExecutor(at_once, spawn, enter_domain, (domains,))
        )


def enter_domain(domains: Any) -> None:
    """Takes one of the domains, for all nodes that this process starts."""
    os.environ["ROS_DOMAIN_ID"] = str(domains.get())
    set_transport(
        os.environ
    )  # through shared memory, a killed process may block others


OPTIONS = {
    "repeats": 30,
    "fault": {"action": "append", "choices": sorted(FAULTS), "help": "only this one"},
    "load": (0, "keep so many cores busy besides"),
    "at-once": (1, "so many faults, each in processes of its own"),
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
