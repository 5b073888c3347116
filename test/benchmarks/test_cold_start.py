"""The wait of a newcomer, measured on a clone of what is committed."""

from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("rclpy", reason="the demo needs ROS 2: rclpy is not installed")

pytestmark = [
    pytest.mark.ros,
    pytest.mark.process,
    pytest.mark.campaign,
    pytest.mark.timeout(3600),
]
SCRIPT = "cold_start.py"


def test_a_newcomer_has_a_result_in_minutes_and_the_next_time_sooner():
    code, result = asked(SCRIPT, timeout_s=3000.0)
    assert code == 0, result["failures"]
    assert 0.0 < result["setup_s"] < result["demo_s"]
    assert result["first_reset_s"] > 0.0


def test_processes_that_find_no_kernels_keep_a_newcomer_waiting():
    assert fails(SCRIPT, "no_cache", timeout_s=3000.0)


def test_what_was_compiled_before_is_no_measurement():
    missed = fails(SCRIPT, "compiled", timeout_s=3000.0)
    assert any("nothing was measured" in line for line in missed)
