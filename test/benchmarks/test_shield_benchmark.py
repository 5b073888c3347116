"""The shield's benchmark in small: over DDS, in process, and with what it measures taken out."""

from __future__ import annotations

import pytest

from .runs import asked, fails

SHORT = ("--in-process", "--episodes", "18")


@pytest.mark.timeout(300)
def test_no_adversary_makes_a_shielded_robot_touch_anything():
    code, result = asked("shield.py", *SHORT)
    assert (code, result["failures"]) == (0, [])
    assert (result["episodes"], result["contacts"]) == (18, 0)
    assert {one["episodes"] for one in result["by_world"].values()} == {6}
    assert result["contacts_without"] > result["tried_without"] / 2
    assert result["goals_reached"] > 0


@pytest.mark.ros
@pytest.mark.timeout(600)
def test_over_dds_and_in_real_time_nothing_is_touched():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    _, result = asked(
        "shield.py", "--episodes", "6", "--place", "mecanum/crowd", "--place", "ackermann/clutter",
        timeout_s=580.0,
    )  # fmt: skip
    assert (result["driven"], result["episodes"], result["contacts"]) == ("over DDS", 6, 0)
    assert result["path_m"] > 3.0
    # A busy machine may hold up a heartbeat, or a robot on its way; it may not touch anything.
    assert [line for line in result["failures"] if not line.startswith(("latched", "goals"))] == []


@pytest.mark.timeout(300)
def test_without_the_shield_there_are_contacts():
    assert any(line.startswith("contacts of") for line in fails("shield.py", "no_shield", *SHORT))


@pytest.mark.timeout(300)
def test_robots_that_stand_measure_nothing():
    missed = fails("shield.py", "standing", *SHORT)
    assert any(line.startswith("path driven") for line in missed)
    assert any(line.startswith("contacts without") for line in missed)


@pytest.mark.timeout(300)
def test_a_shield_that_thinks_the_robot_stops_at_once_touches_something():
    missed = fails("shield.py", "no_braking_distance", *SHORT)
    assert any(line.startswith("contacts of") for line in missed)
    assert any(line.startswith("braking distance") for line in missed)
