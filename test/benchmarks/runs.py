"""Runs a benchmark as a user would, in small."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def asked(
    script: str, *options: str, timeout_s: float = 280.0
) -> tuple[int, dict[str, Any]]:
    """The exit code of a benchmark and the one JSON object that it prints."""
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / script), "--json", *options],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )
    assert done.stdout.count("\n") == 1, done.stdout + done.stderr
    return done.returncode, json.loads(done.stdout, parse_constant=_no_json)


def _no_json(word: str) -> None:
    raise ValueError(f"{word} is no JSON")


def fails(
    script: str, control: str, *options: str, timeout_s: float = 280.0
) -> list[str]:
    """The bars that a benchmark misses under a control, which has to be at least one."""
    code, result = asked(script, "--control", control, *options, timeout_s=timeout_s)
    assert (code, bool(result["failures"])) == (1, True), result
    missed: list[str] = result["failures"]
    return missed
