"""How long does a node take to end, by SIGINT and SIGTERM in turn, on busy cores?

Each node is ended many times while it starts (after its first line), while it compiles its kernels
into an empty cache, within a native step of compiling that is drawn out to seconds, and
while it runs, beside loops that are always busy. It has to end by itself, with exit code 0, or,
until it runs, that of the signal. Without loops, the median first line, which says that a node
starts, has to come in time, too. The control takes away what ends a node within such a step;
elsewhere Python's own handlers are as fast.
"""

from __future__ import annotations

import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from campaign import Bars, Given, Result, at_most, run_campaign, some_of, tell
from parts.processes import keep_busy, make_environment

from nics_drl_bridge.nodes.parameters import list_nodes
from nics_drl_bridge.nodes.processes import choose_domain_id

LIMIT_S = 1.0
PATIENCE_S = 60.0
READY_S = 280.0
FIRST_LINE_S = 1.0  # until a node says that it starts, on cores that are not busy
PHASES = {
    "starting": "]: starting",
    "compiling": "]: compiling, once",
    "native": "native code, seconds",
    "running": "]: running",
}
COLD = ("compiling", "native")  # into an empty cache
NEVER_COMPILES = ("record_node",)
# After its line, a node is ended at moments that are spread over this time [s].
MOMENTS_S = 2.0
MODEL = ["-p", "model:=ackermann"]
GIVEN = {
    "command_gate": [*MODEL, "-p", "limits:=ackermann"],
    "record_node": ["-p", "robot:=ackermann"],
}
START = """
import hashlib, signal, sys, time
from nics_drl_bridge.nodes import own_process, start
if sys.argv[1] == "late":
    load = start._load_main

    def load_with_handlers(node):
        for number in own_process.list_ending_signals():
            signal.signal(number, lambda *_: sys.exit())
        return load(node)

    start._load_main = load_with_handlers
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


def await_line(process: subprocess.Popen[bytes], words: str) -> None:
    """Reads what a node says up to a line with some words. Raises RuntimeError if none comes."""
    told = ""
    late = threading.Timer(READY_S, process.kill)
    late.start()
    try:
        for line in process.stdout or ():
            told += line.decode(errors="replace")
            if words in told:
                return
    finally:
        late.cancel()
    raise RuntimeError(f"no line {words!r}:\n{told}")


def end_node(
    node: str, phase: str, number: int, control: str, folder: Path
) -> dict[str, Any]:
    """Ends a node once in a phase; returns times [s], and its code and output if it failed."""
    environment = make_environment(choose_domain_id())
    environment |= {"ROS_HOME": str(folder), "ROS_LOG_DIR": str(folder)}
    if phase in COLD:
        environment["NUMBA_CACHE_DIR"] = str(folder / "cache")
    words = ["--ros-args", *GIVEN.get(node, MODEL), "-r", f"__ns:=/{phase}_{number}"]
    begin_s = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-c", START, control, phase, node, *words],
        env=environment,
        bufsize=0,  # so that nothing is read ahead of the line that is awaited
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        cwd=folder,
        start_new_session=True,
    )
    try:
        await_line(process, PHASES[phase])
        reached_s = time.monotonic() - begin_s
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=number % 10 / 10 * MOMENTS_S)
        begin_s = time.monotonic()
        process.send_signal((signal.SIGINT, signal.SIGTERM)[number % 2])
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=PATIENCE_S)
        took_s = time.monotonic() - begin_s
        code = process.poll()
    finally:
        process.kill()
        output, _ = process.communicate()
    told = output.decode(errors="replace")
    # Until a node runs, the signal may end it as by default.
    codes = (0,) if phase == "running" else (0, -signal.SIGINT, -signal.SIGTERM)
    is_clean = code in codes and "Traceback" not in told
    failure = "" if is_clean else f"code {code}: {told[-2000:]}"
    return {"took_s": took_s, "reached_s": reached_s, "failure": failure}


def summarise(endings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the figures of a node's endings in one phase."""
    failures = [ending["failure"] for ending in endings if ending["failure"]]
    return {
        "reached_s": statistics.median(ending["reached_s"] for ending in endings),
        "median_s": statistics.median(ending["took_s"] for ending in endings),
        "longest_s": max(ending["took_s"] for ending in endings),
        "failed": len(failures),
        "failures": failures,
    }


def measure(given: Given) -> Result:
    """Ends all nodes in all phases."""
    found: dict[str, Any] = {}
    cases = [(node, phase) for phase in given.phases for node in given.nodes]
    with keep_busy(given.loops):
        for node, phase in cases:
            if phase in COLD and node in NEVER_COMPILES:
                continue
            endings = []
            for number in range(given.times):
                with tempfile.TemporaryDirectory() as folder:
                    about = node, phase, number, given.control or "", Path(folder)
                    endings.append(end_node(*about))
            name = f"{node} {phase}"
            found[name] = summarise(endings)
            tell(f"{name}: {found[name]['longest_s']:.3f} s at most")
    return {"times": given.times, "loops": given.loops, "endings": found}


def set_bars(result: Result) -> Bars:
    each = {
        "longest_s": at_most(LIMIT_S, "took [s]"),
        "failed": at_most(0, "ended badly"),
    }
    first = {"reached_s": at_most(FIRST_LINE_S, "its first line took [s]")}
    bars = {}
    for name in result["endings"]:
        is_first = name.endswith("starting") and not result["loops"]
        bars[name] = each | first if is_first else each
    return {"endings": bars}


OPTIONS = {
    "times": (10, "of each node in each phase"),
    "loops": (2, "busy ones"),
    "nodes": some_of(tuple(list_nodes())),
    "phases": some_of(tuple(PHASES)),
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
