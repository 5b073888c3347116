"""How long does a newcomer wait: from a clean clone and nothing compiled to the end of the demo?

Clones this repository into a temporary folder and runs `make demo` there, twice. Then `nics warmup`
compiles into an empty cache, and a script makes a first env and resets it, in an empty
cache of its own. What is not committed is not in the clone.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path

from campaign import ROOT, Given, Result, at_least, at_most, missed_bars, run_campaign
from measuring.environments import newcomer, wait_for

FORGET = """
import os, tempfile
os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()
"""
BARS = {
    "demo_s": at_most(180.0),
    "compile_s": at_most(60.0),
    "kernels": at_least(100.0, "nothing was measured: kernels"),
}
FIRST_RESET = """
import time
begin = time.monotonic()
import gymnasium
name = "nics_drl_bridge:NicsBridge/Navigation-v0"
env = gymnasium.make(name, model="differential", world="arena")
env.reset(seed=0)
print(time.monotonic() - begin)
"""


def measure(given: Given) -> Result:
    """All figures, see the head of this file."""
    with tempfile.TemporaryDirectory() as folder:
        return measure_in(Path(folder), given.control)


def measure_in(folder: Path, control: str | None) -> Result:
    clone = folder / "clone"
    around = newcomer(folder, FORGET if control == "no_cache" else "")
    wait_for(["git", "clone", "--quiet", str(ROOT), str(clone)], folder, around)
    began = time.time()
    demo_s, told = wait_for(["make", "demo"], clone, around)
    ready = next((clone / ".venv").glob(".demo-*")).stat().st_mtime
    warm_demo_s, _ = wait_for(["make", "demo"], clone, around)
    python = clone / ".venv" / "bin" / "python"
    caches = {
        name: {"NUMBA_CACHE_DIR": str(folder / name)} for name in ("warmup", "reset")
    }
    warmup = [str(python.with_name("nics")), "warmup", "--json"]
    if control == "compiled":
        wait_for(warmup, clone, around | caches["warmup"])
    _, compiled = wait_for(warmup, clone, around | caches["warmup"])
    found = json.loads(compiled)
    _, first = wait_for(
        [str(python), "-c", FIRST_RESET], clone, around | caches["reset"]
    )
    return {
        "setup_s": ready - began,
        "compile_s": found["cpu_s"],
        "kernels": found["kernels"],
        "first_reset_s": float(first),
        "demo_s": demo_s,
        "warm_demo_s": warm_demo_s,
        "told": told.strip().splitlines()[-1],
        "cores": os.cpu_count(),
    }


def judge(result: Result) -> list[str]:
    """The bars that were missed."""
    missed = missed_bars(result, BARS)
    if not result["told"].startswith("demo: "):
        missed.append(f"the demo ended with {result['told']!r}")
    if not result["warm_demo_s"] < result["demo_s"]:
        missed.append("the second demo took as long as the first")
    return missed


if __name__ == "__main__":
    run_campaign(measure, judge)
