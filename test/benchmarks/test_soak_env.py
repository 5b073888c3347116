from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
CASES = ("--cases", "arena", "crowd", "team")


@pytest.mark.timeout(300)  # a cold start compiles
def test_a_soak_finds_no_nan_and_no_world_that_is_stuck():
    command = [sys.executable, str(BENCHMARKS / "soak_env.py"), "--steps", "60000", *CASES]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found["steps"] >= 60_000
    assert found["nans"] == found["stuck_worlds"] == 0
    assert set(found["cases"]) == set(CASES[1:])
    for case in found["cases"].values():
        assert case["episodes"] > 0
        assert case["longest"] > 1


@pytest.mark.timeout(300)
def test_resets_of_a_single_env_leave_no_files_and_threads_behind():
    command = [sys.executable, str(BENCHMARKS / "soak_env.py"), "--resets", "300", "--json"]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert (found["resets"], found["nans"]) == (300, 0)
    assert found["fds_growth"] == found["threads_growth"] == 0
