"""The benchmark of the standards in small."""

from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip(
    "simulation_interfaces", reason="needs what `nox -s messages` builds"
)

pytestmark = [pytest.mark.ros, pytest.mark.campaign, pytest.mark.timeout(900)]
SCRIPT = "standards.py"
SHORT = ("--parts", "simulation_interfaces", "--chunks", "2", "--size", "20")


def test_every_feature_is_called_and_a_step_is_compared():
    _, result = asked(SCRIPT, *SHORT)
    assert result["sim_features"] == 30
    assert result["sim_conformance_failed"] == 0, result["failed"]
    assert -0.5 < result["client_overhead"] < 5.0


def test_a_feature_that_is_only_claimed_fails():
    missed = fails(SCRIPT, "claims", *SHORT)
    assert any(line.startswith("sim_conformance_failed 1") for line in missed)


def test_what_is_answered_as_done_without_being_done_fails():
    missed = fails(SCRIPT, "idle", *SHORT)
    for name in (
        "SPAWNING",
        "ENTITY_STATE_SETTING",
        "SIMULATION_STATE_PAUSE",
        "WORLD_LOADING",
    ):
        assert f"{name} is announced, but does not do what the standard says" in missed


def test_a_client_that_rests_in_each_step_is_too_slow():
    code, result = asked(SCRIPT, "--control", "slow", *SHORT)
    assert code == 1
    assert result["standard_step_ms"] - result["own_step_ms"] > 1.5  # it rests for 2 ms


def test_a_bundle_that_is_given_something_else_differs():
    pytest.importorskip("leapp", reason="needs LEAPP")
    code, result = asked(SCRIPT, "--parts", "leapp")
    assert code == 0, result["failures"]
    (line,) = fails(SCRIPT, "coarse", "--parts", "leapp")
    assert line.startswith("leapp_max_abs_difference")
