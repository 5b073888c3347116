"""The gate's share of a core in small. How large it is, is for the benchmark to say."""

from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
SCRIPT = "gate_load.py"
SHORT = ("--seconds", "4", "--burst", "4")


@pytest.mark.campaign
def test_the_gate_passes_commands_and_leaves_the_first_stop_of_a_burst_behind():
    _, result = asked(SCRIPT, *SHORT)
    assert result["moving"] > 0.0
    assert result["gate_share"] > 0.0
    assert result["bare_share"] > 0.0
    assert result["stops"] > 0
    assert result["files"] >= 1
    assert result["replayed"]


@pytest.mark.campaign
def test_a_gate_that_does_everything_ten_times_takes_too_much():
    assert any(
        "times what the bare node takes" in line
        for line in fails(SCRIPT, "busy", *SHORT)
    )


@pytest.mark.campaign
def test_a_gate_that_waits_for_its_disk_ends_too_late():
    missed = fails(SCRIPT, "slow_disk", *SHORT)
    assert any("s after SIGINT, bar 2.0 s" in line for line in missed)
    assert "the first stop of the burst is not in the black box" in missed
