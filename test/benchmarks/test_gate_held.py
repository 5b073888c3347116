from __future__ import annotations

import pytest

from .runs import asked, fails


@pytest.mark.campaign
@pytest.mark.timeout(3600)
def test_a_held_body_is_stopped_and_ten_hours_of_free_driving_are_not():
    code, result = asked("gate_held.py", "--hours", "10", timeout_s=3500.0)
    assert (code, result["failures"]) == (0, [])
    assert result["trips"] == 0


@pytest.mark.slow
def test_a_held_body_is_stopped_and_free_driving_is_not():
    few = ("--hours", "0.1", "--holds", "20", "--case", "0")
    code, result = asked("gate_held.py", *few)
    assert (code, result["failures"]) == (0, [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("rule_off", "of the held bodies were stopped in time"),
        (
            "zero_thresholds",
            "robots that drove freely were stopped by body_held, bar 0",
        ),
    ],
)
def test_a_rule_for_held_bodies_that_is_none_is_noticed(control, bar):
    missed = fails(
        "gate_held.py", control, "--hours", "0.01", "--holds", "4", "--case", "7"
    )
    assert any(bar in line for line in missed)
