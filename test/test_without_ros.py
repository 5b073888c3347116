"""Training, evaluation and generating where there is no ROS 2: nothing of it can be imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.process, pytest.mark.slow]
ROOT = Path(__file__).resolve().parents[1]
ROS = (
    "rclpy",
    "rosidl_runtime_py",
    "ament_index_python",
    "launch",
    "tf2_ros",
    "builtin_interfaces",
)
WITHOUT_ROS = f"""
import sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        absent = top in {ROS} or top.endswith(("_msgs", "_srvs"))
        return None if absent else self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""
NICS = "from nics_drl_bridge.commands.cli import main\nmain()"
SETTINGS = (
    "{worlds: {empty: 32}, steps: 2048, hidden: [16], ppo: {rollout: 16, batch: 256}}"
)


def without_ros(code: str, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A process in which no part of ROS 2 can be imported."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])
    }
    command = [sys.executable, "-c", f"{WITHOUT_ROS}\n{code}", *words]
    return subprocess.run(
        command,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=800,
        check=False,
    )


def test_ros_can_not_be_imported_in_these_tests(tmp_path):
    for name in ("rclpy", "sensor_msgs.msg", "std_srvs"):
        done = without_ros(f"import {name}", cwd=tmp_path)
        assert f"No module named '{name.partition('.')[0]}" in done.stderr


@pytest.mark.timeout(900)  # a cold start compiles
def test_a_policy_is_trained_and_evaluated(tmp_path):
    (tmp_path / "short.yaml").write_text(SETTINGS, encoding="utf-8")
    words = [
        "train",
        "--settings",
        "short.yaml",
        "--seeds",
        "0",
        "--episodes",
        "8",
        "--out",
        "run",
    ]
    done = without_ros(NICS, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    policy = "run/seed_0/policy.onnx"
    words = f"evaluate {policy} --in fast --world empty --episodes 2 --out seen".split()
    done = without_ros(NICS, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(
        (tmp_path / "seen" / "evaluation.json").read_text(encoding="utf-8")
    )


def test_a_world_over_dds_is_refused_in_one_sentence(tmp_path):
    words = ["evaluate", "differential", "--in", "dds", "--episodes", "1"]
    done = without_ros(NICS, *words, cwd=tmp_path)
    assert done.returncode == 2
    *progress, sentence = done.stderr.splitlines()
    assert all(line.endswith(" s)") for line in progress)  # of a slow machine
    assert sentence.startswith("nics: ")
    assert "rclpy" in sentence
