"""The benchmark of lock-step in small: its JSON has exactly its keys."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = pytest.mark.ros
SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "ros_lockstep.py"


def test_steps_and_echoes_are_measured_in_the_same_run():
    options = ["--json", "--chunks", "2", "--size", "20"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *options],
        capture_output=True, text=True, check=True, timeout=180,
    )  # fmt: skip
    assert done.stdout.count("\n") == 1
    result = json.loads(done.stdout)
    assert set(result) == {"steps_per_s", "bare_echo_per_s", "ratio", "p50_ms", "p99_ms"}
    assert result["ratio"] == pytest.approx(
        result["steps_per_s"] / result["bare_echo_per_s"], rel=0.02
    )
    assert 0.0 < result["p50_ms"] <= result["p99_ms"]
