from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from nics_drl_bridge.policy.policies import shipped_policies

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "transfer.py"
missing = [name for name in ("rclpy", "mujoco") if find_spec(name) is None]
ready = not missing and "differential" in shipped_policies()


@pytest.fixture
def transfer(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return import_module("transfer")


def test_success_may_be_two_points_off_over_dds_and_five_in_mujoco(transfer):
    assert transfer.passes({"fast": 0.97, "dds": 0.95, "mujoco_dds": 0.92})
    assert not transfer.passes({"fast": 0.97, "dds": 0.94, "mujoco_dds": 0.97})
    assert not transfer.passes({"fast": 0.97, "dds": 0.97, "mujoco_dds": 0.91})


def test_rates_are_the_success_of_each_world(transfer):
    places = {place: {"success": [share, 0.0, 1.0]} for place, share in zip(
        ("fast", "dds", "mujoco_dds"), (0.9, 0.8, 0.7), strict=True
    )}  # fmt: skip
    told = transfer.rates({"robots": {"mecanum": places}})
    assert told == {"robots": {"mecanum": {"fast": 0.9, "dds": 0.8, "mujoco_dds": 0.7}}}


@pytest.mark.ros
@pytest.mark.skipif(not ready, reason="needs ROS 2, MuJoCo and the shipped policies")
def test_it_prints_one_json_object_with_all_worlds():
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--json", "--episodes", "1", "--robots", "differential"],
        capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.stdout, done.stderr
    told = json.loads(done.stdout)
    assert set(told) == {"robots", "without_randomisation"}
    for robots in told.values():
        assert set(robots["differential"]) == {"fast", "dds", "mujoco_dds"}
        assert set(robots["differential"].values()) <= {0.0, 1.0}
