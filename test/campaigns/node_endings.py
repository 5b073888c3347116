"""How long does a node take to end, by SIGINT and SIGTERM in turn, on busy cores?

Each node is ended many times while it starts (after its first line), while it compiles its kernels
into an empty cache, within a native step of compiling that is drawn out to seconds, and
while it runs, beside loops that are always busy. It has to end by itself, with exit code 0, or,
until it runs, that of the signal. Without loops, the median first line, which says that a node
starts, has to come in time, too. The control takes away what ends a node within such a step;
elsewhere Python's own handlers are as fast.
"""

from __future__ import annotations

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from campaign import Given, Result, run_campaign, some_of
from parts.processes import busy

from nics_drl_bridge.nodes.parameters import NODES
from nics_drl_bridge.nodes.processes import free_domain_id

LIMIT_S = 1.0
PATIENCE_S = 60.0
READY_S = 280.0
POLL_S = 0.01
FIRST_LINE_S = 1.0  # until a node says that it starts, on cores that are not busy
PHASES = {
    "starting": "]: starting",
    "compiling": "]: compiling, once",
    "native": "native code, seconds",
    "running": "]: running",
}
COLD = ("compiling", "native")  # into an empty cache
NEVER_COMPILES = ("record_node",)
# after its line, a node is ended at moments that are spread over this time [s]
MOMENTS_S = 2.0
MODEL = ["-p", "model:=ackermann"]
GIVEN = {
    "command_gate": [*MODEL, "-p", "limits:=ackermann"],
    "record_node": ["-p", "robot:=ackermann"],
}
START = """
import hashlib, sys, time
from nics_drl_bridge.nodes import own_process, start
if sys.argv[1] == "late":
    own_process.begin_own_process = lambda: None
if sys.argv[2] == "native":
    from numba.core import event

    def work(rounds):
        begin = time.perf_counter()
        hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)
        return time.perf_counter() - begin

    class Long(event.Listener):  # in place of LLVM's longest steps, wherever the signal falls
        seconds = 6.0

        def on_start(self, _):
            seconds, Long.seconds = Long.seconds, 0.0
            if seconds:
                rounds = int(100_000 * seconds / work(100_000))
                sys.stderr.write("native code, seconds\\n")
                sys.stderr.flush()
                work(rounds)

        def on_end(self, _):
            pass

    event.register("numba:compile", Long())
start.start(sys.argv[3], sys.argv[3:])
"""


def ended(
    node: str, phase: str, number: int, control: str | None, folder: Path
) -> dict[str, Any]:
    """Ends a node once in a phase: its exit code, the time [s], and what it wrote if it failed."""
    log = folder / "log"
    own = {"ROS_HOME": str(folder), "ROS_LOG_DIR": str(folder)}
    if phase in COLD:
        own["NUMBA_CACHE_DIR"] = str(folder / "cache")
    words = ["--ros-args", *GIVEN.get(node, MODEL), "-r", f"__ns:=/{phase}_{number}"]
    begin = time.monotonic()
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-c", START, control or "", phase, node, *words],
            env=os.environ | own,
            stdout=file,
            stderr=file,
            stdin=subprocess.DEVNULL,
            cwd=folder,
            start_new_session=True,
        )
    try:
        deadline = begin + READY_S
        while PHASES[phase] not in log.read_text(errors="replace"):
            if process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(
                    f"{node} was never {phase}:\n{log.read_text(errors='replace')}"
                )
            time.sleep(POLL_S)
        reached_s = time.monotonic() - begin
        time.sleep(number % 10 / 10 * MOMENTS_S)
        begin = time.monotonic()
        process.send_signal((signal.SIGINT, signal.SIGTERM)[number % 2])
        code: int | None = None
        with suppress(subprocess.TimeoutExpired):
            code = process.wait(PATIENCE_S)
        took_s = time.monotonic() - begin
    finally:
        process.kill()
        process.wait()
    told = log.read_text(errors="replace")
    # Until a node runs, the signal may end it as by default.
    codes = (0,) if phase == "running" else (0, -signal.SIGINT, -signal.SIGTERM)
    clean = code in codes and "Traceback" not in told
    said = "" if clean else told[-2000:]
    return {
        "code": code,
        "took_s": took_s,
        "reached_s": reached_s,
        "clean": clean,
        "log": said,
    }


def summary(endings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of a node's endings in one phase."""
    return {
        "reached_s": statistics.median(each["reached_s"] for each in endings),
        "median_s": statistics.median(each["took_s"] for each in endings),
        "longest_s": max(each["took_s"] for each in endings),
        "failed": [each for each in endings if not each["clean"]],
    }


def measure(given: Given) -> Result:
    """All endings, by node and phase."""
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    found: dict[str, Any] = {}
    cases = [(node, phase) for phase in given.phases for node in given.nodes]
    with busy(given.loops), tempfile.TemporaryDirectory() as folder:
        for node, phase in cases:
            if phase in COLD and node in NEVER_COMPILES:
                continue
            own = [Path(folder) / f"{node}_{phase}_{k}" for k in range(given.times)]
            for each in own:
                each.mkdir()
            name = f"{node} {phase}"
            found[name] = summary(
                [
                    ended(node, phase, k, given.control, each)
                    for k, each in enumerate(own)
                ]
            )
            sys.stderr.write(f"{name}: {found[name]['longest_s']:.3f} s at most\n")
    return {
        "times": given.times,
        "loops": given.loops,
        "limit_s": LIMIT_S,
        "endings": found,
    }


def judge(result: Result) -> list[str]:
    missed = []
    for name, each in result["endings"].items():
        quiet = name.endswith("starting") and not result["loops"]
        if quiet and not each["reached_s"] <= FIRST_LINE_S:
            bar = f"bar {FIRST_LINE_S:g} at most"
            missed.append(
                f"{name}: its first line took {each['reached_s']:.2f} s, {bar}"
            )
        if not each["longest_s"] <= LIMIT_S:
            missed.append(
                f"{name}: took {each['longest_s']:.2f} s, bar {LIMIT_S:g} at most"
            )
        if each["failed"]:
            codes = sorted({str(one["code"]) for one in each["failed"]})
            missed.append(
                f"{name}: {len(each['failed'])} ended badly, codes {', '.join(codes)}"
            )
    return missed


OPTIONS = {
    "times": (10, "of each node in each phase"),
    "loops": (2, "busy ones"),
    "nodes": some_of(tuple(NODES)),
    "phases": some_of(tuple(PHASES)),
}

if __name__ == "__main__":
    run_campaign(measure, judge, OPTIONS)
