from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "env_throughput.py"
FEW = ("--worlds", "4", "--threads", "1", "--repeats", "1", "--without-peers")


@pytest.mark.timeout(300)  # a cold start compiles
def test_the_throughput_of_envs_is_one_json_object_with_every_figure():
    command = [sys.executable, str(SCRIPT), *FEW, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert set(found) == {
        "single_thread_env_steps_per_s",
        "all_threads_env_steps_per_s",
        "threads",
        "single_env_gym_steps_per_s",
        "single_env_with_estimator_steps_per_s",
        "peers",
        "peers_with_one_scan",
        "memory_bytes_per_env",
    }
    assert found["peers"] == {"ir_sim": None, "irsim_x": None}
    assert all(value > 0 for name, value in found.items() if not name.startswith("peers"))
