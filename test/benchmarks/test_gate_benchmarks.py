"""The benchmarks of the gate in small: their JSON has all keys, and nothing is violated."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def result_of(script: str, *options: str) -> dict:
    """The one JSON object that a benchmark prints."""
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / script), "--json", *options],
        capture_output=True, text=True, check=True, timeout=250,
    )  # fmt: skip
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def test_no_random_command_at_any_interval_leaves_the_envelope():
    result = result_of("gate_envelope.py", "--steps", "9000")
    assert (result["steps"], result["violations"]) == (9000, 0)
    assert result["in_motion"] > 8000


@pytest.mark.timeout(300)
@pytest.mark.parametrize("fault", ["scan_silent", "e_stop", "policy_hung"])
def test_a_fault_around_a_real_gate_leads_to_zero(fault):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "gate_faults.py"), "--json", "--repeats", "1",
         "--fault", fault],
        capture_output=True, text=True, check=False, timeout=250,
    )  # fmt: skip
    result = json.loads(done.stdout)[fault]
    assert result["n"] == 1
    assert 0.0 < result["max_s"] < 5.0  # a busy machine may be late; the benchmark says how late


def test_a_rule_that_is_taken_out_is_missed_by_a_test(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gate_rules

    names = gate_rules.names()
    assert len(names) == len(set(names)) > 30
    assert {"stop/disarmed", "refusal/command_not_finite", "shaping/follow"} <= set(names)
    assert gate_rules.tests_fail_without("stop/e_stop_pressed")
    with pytest.raises(SystemExit, match="there is no rule 'stop/nothing'"):
        gate_rules.take_out("stop/nothing")


@pytest.mark.timeout(300)
def test_no_command_moves_a_robot_on_old_data_when_packets_are_lost():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "packet_loss.py"), "--json", "--seconds", "8", "--loss",
         "20"],
        capture_output=True, text=True, check=False, timeout=280,
    )  # fmt: skip
    if done.returncode == 2:
        pytest.skip(done.stderr.strip())
    result = json.loads(done.stdout)
    assert result["loss_20"]["moving_commands"] > 0
    assert result["loss_20"]["scans_arrived"] < result["loss_20"]["scans_sent"]
    assert result["unsafe_commands"] == 0
