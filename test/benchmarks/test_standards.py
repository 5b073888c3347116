"""The benchmark of the standards in small."""

from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip("simulation_interfaces", reason="needs what `make test-messages` builds")

pytestmark = [pytest.mark.ros, pytest.mark.campaign, pytest.mark.timeout(900)]
SCRIPT = "standards.py"
SHORT = ("--parts", "simulation_interfaces", "--chunks", "2", "--size", "20")


def test_every_feature_is_called_and_a_step_is_compared():
    _, result = asked(SCRIPT, *SHORT)
    assert result["sim_features"] == 30
    assert result["sim_conformance_failed"] == 0, result["failed"]
    assert result["client_overhead"] > -1.0


def test_a_feature_that_is_only_claimed_fails():
    missed = fails(SCRIPT, "claims", *SHORT)
    assert any(line.startswith("sim_conformance_failed 1") for line in missed)


def test_a_client_that_rests_in_each_step_is_too_slow():
    assert any(line.startswith("client_overhead") for line in fails(SCRIPT, "slow", *SHORT))
