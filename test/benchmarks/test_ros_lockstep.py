"""The benchmark of lock-step in small."""

from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.campaign, pytest.mark.ros, pytest.mark.timeout(300)]
SCRIPT = "ros_lockstep.py"
SHORT = ("--chunks", "2", "--size", "20")


def test_steps_and_echoes_are_measured_in_the_same_run():
    code, result = asked(SCRIPT, *SHORT)
    assert set(result) == {
        "steps_per_s",
        "bare_echo_per_s",
        "ratio",
        "p50_ms",
        "p99_ms",
        "driven_m",
        "failures",
    }
    assert result["ratio"] == pytest.approx(
        result["steps_per_s"] / result["bare_echo_per_s"], rel=0.02
    )
    assert 0.0 < result["p50_ms"] <= result["p99_ms"]
    assert [line.split()[0] for line in result["failures"]] == ["ratio"] * code


def test_an_env_that_rests_in_each_step_is_too_slow():
    assert any(line.startswith("ratio 0.") for line in fails(SCRIPT, "slow", *SHORT))


def test_a_robot_that_stands_has_measured_nothing():
    missed = fails(SCRIPT, "standing", *SHORT)
    assert any(line.startswith("driven_m 0.0") for line in missed)
