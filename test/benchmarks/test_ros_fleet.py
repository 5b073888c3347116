"""The benchmark of a fleet in small: it drives, and each robot is heard."""

from __future__ import annotations

import pytest

from .runs import CAMPAIGNS, asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.campaign, pytest.mark.ros, pytest.mark.timeout(300)]
SCRIPT = "ros_fleet.py"
SHORT = ("--robots", "2", "--seconds", "2")


def test_every_robot_of_a_fleet_drives_and_is_heard():
    code, result = asked(SCRIPT, *SHORT)
    assert set(result["each"]) == {"robot1", "robot2"}
    assert result["scan_hz"] == pytest.approx(
        min(r["scan"] for r in result["each"].values()), 0.01
    )
    assert 0.0 < result["scan_hz"] < result["odom_hz"]
    assert result["driven_m"] >= 0.1
    # Rates are a matter of speed.
    assert all(": scan " in line or ": odom " in line for line in result["failures"])
    assert code == bool(result["failures"])


def test_a_fleet_that_nobody_commands_is_found_to_stand():
    missed = fails(SCRIPT, "standing", *SHORT)
    assert any(
        ": driven_m 0.0" in line and "must be 0.1 at least" in line for line in missed
    )


def test_one_robot_that_nobody_hears_is_named():
    missed = fails(SCRIPT, "deaf", *SHORT, "--patience", "15")
    for topic in ("scan", "odom", "driven_m"):
        assert any(line.startswith(f"robot2 of 2: {topic} 0,") for line in missed)


def test_a_rate_that_is_nan_is_missed(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import ros_fleet

    nan = float("nan")
    each = {"robot1": {"scan": nan, "odom": nan, "driven_m": nan}}
    assert len(ros_fleet.bars(ros_fleet.Run(1, nan, nan, nan, 0.1, 1.0, each))) == 3
