"""The soak of the whole stack in small: everything runs beside everything, and tells its use."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "soak.py"


@pytest.mark.ros
@pytest.mark.timeout(300)
def test_the_whole_stack_drives_and_begins_episodes_and_keeps_its_files_and_threads():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--json", "--minutes", "0.2", "--warm-up", "0.1"],
        capture_output=True, text=True, check=True, timeout=280,
    )  # fmt: skip
    result = json.loads(done.stdout)
    assert result["resets"] > 0
    assert result["steps"] > result["resets"]
    assert set(result) >= {"rss_growth_mb", "unexplained_stops"}
    assert (result["fds_growth"], result["threads_growth"]) == (0, 0)
