"""How long does a newcomer wait: from a clean clone and nothing compiled to the end of the demo?

Clones this repository into a temporary folder and runs `make demo` there, twice. Then `nics warmup`
compiles into an empty cache, and a script makes a first env and resets it, in an empty
cache of its own. What is not committed is not in the clone.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from measuring.environments import inherit_for_newcomer
from measuring.verdict import answer, parser_of

ROOT = Path(__file__).resolve().parents[1]
CONTROLS = {
    "no_cache": "every process finds an empty cache of kernels",
    "compiled": "all kernels were compiled before the time is taken",
}
DEMO_S = 180.0
COMPILE_S = 60.0
TIMEOUT_S = 1800.0
FIRST_RESET = """
import time
begin = time.monotonic()
import gymnasium
name = "nics_drl_bridge:NicsBridge/Navigation-v0"
env = gymnasium.make(name, model="differential", world="arena")
env.reset(seed=0)
print(time.monotonic() - begin)
"""
FORGET = """
import os, tempfile
os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()
"""


def environment(folder: Path, control: str | None) -> dict[str, str]:
    """The environment variables of a newcomer, with temporary files in a folder."""
    kept = inherit_for_newcomer() | {"TMPDIR": str(folder)}
    kept.pop("MAKEFLAGS", None)
    if control == "no_cache":
        (folder / "sitecustomize.py").write_text(FORGET)
        kept["PYTHONPATH"] = str(folder)
    return kept


def waited(
    command: list[str], folder: Path, environment: dict[str, str]
) -> tuple[float, str]:
    """Runs a command that must not fail; returns how long it took [s] and what it printed."""
    begin = time.monotonic()
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    if done.returncode:
        end = done.stderr[-2000:]
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{end}")
    return time.monotonic() - begin, done.stdout


def measure(folder: Path, control: str | None) -> dict[str, Any]:
    """All figures, see the head of this file."""
    clone = folder / "clone"
    around = environment(folder, control)
    waited(["git", "clone", "--quiet", str(ROOT), str(clone)], folder, around)
    began = time.time()
    demo_s, told = waited(["make", "demo"], clone, around)
    ready = next((clone / ".venv").glob(".demo-*")).stat().st_mtime
    warm_demo_s, _ = waited(["make", "demo"], clone, around)
    python = clone / ".venv" / "bin" / "python"
    caches = {
        name: {"NUMBA_CACHE_DIR": str(folder / name)} for name in ("warmup", "reset")
    }
    warmup = [str(python.with_name("nics")), "warmup", "--json"]
    if control == "compiled":
        waited(warmup, clone, around | caches["warmup"])
    _, compiled = waited(warmup, clone, around | caches["warmup"])
    found = json.loads(compiled)
    _, first = waited([str(python), "-c", FIRST_RESET], clone, around | caches["reset"])
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


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    if not result["demo_s"] <= DEMO_S:
        missed.append(f"the demo took {result['demo_s']:.0f} s, bar {DEMO_S:g} at most")
    if not result["compile_s"] <= COMPILE_S:
        missed.append(
            f"compiling took {result['compile_s']:.0f} s of CPU, bar {COMPILE_S:g}"
        )
    if not result["kernels"] >= 100:
        missed.append(
            f"{result['kernels']} kernels were compiled: nothing was measured"
        )
    if not result["told"].startswith("demo: "):
        missed.append(f"the demo ended with {result['told']!r}")
    if not result["warm_demo_s"] < result["demo_s"]:
        missed.append("the second demo took as long as the first")
    return missed


def table_of(result: dict[str, Any]) -> str:
    """The figures, one in a line."""
    rows = {
        "make demo, all of it": f"{result['demo_s']:.0f} s",
        "of which set-up": f"{result['setup_s']:.0f} s",
        "make demo, again": f"{result['warm_demo_s']:.0f} s",
        f"compiling {result['kernels']} kernels": f"{result['compile_s']:.0f} s of CPU",
        "first reset, nothing compiled": f"{result['first_reset_s']:.0f} s",
    }
    return "".join(f"{name:<32}{value:>14}\n" for name, value in rows.items())


def main() -> None:
    """Prints a table, or one JSON object."""
    given = parser_of(__doc__, CONTROLS).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder), given.control)
    answer(result, missed_of(result), table_of(result), given.json)


if __name__ == "__main__":
    main()
