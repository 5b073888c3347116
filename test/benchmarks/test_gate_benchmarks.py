"""The benchmarks of the gate in small: their JSON has all keys, and nothing is violated."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from .runs import CAMPAIGNS, asked, fails, path_of


def result_of(script: str, *options: str) -> dict:
    """The one JSON object that a benchmark prints."""
    done = subprocess.run(
        [sys.executable, str(path_of(script)), "--json", *options],
        capture_output=True,
        text=True,
        check=True,
        timeout=250,
    )
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


@pytest.mark.campaign
def test_no_random_command_at_any_interval_leaves_the_envelope():
    code, result = asked("gate_envelope.py", "--steps", "6000")
    assert (code, result["failures"]) == (0, [])
    assert (result["steps"], result["violations"]) == (6000, 0)
    assert result["in_motion_with_random_limits"] > 0


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("no_limits", "violations, bar 0"),
        ("nan", "violations"),
        ("standing", "in motion at 0 of"),
    ],
)
def test_an_envelope_that_is_none_is_noticed(control, bar):
    assert bar in fails("gate_envelope.py", control, "--steps", "6000")[0]


def best_of_three(fault):
    """A fault's summary; this machine may be busy with other tests, and then it is tried again."""
    for _ in range(3):
        code, result = asked("gate_faults.py", "--repeats", "2", "--fault", fault)
        assert result[fault]["unsafe_commands"] == 0, result
        if code == 0:
            break
    assert (code, result["failures"]) == (0, [])
    return result[fault]


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("fault", "limit_s"),
    [
        ("scan_silent", 0.40),
        ("e_stop", 0.10),
        ("policy_hung", 0.40),
        ("odom_teleports", 0.40),
        ("stamps_run_ahead", 0.40),
        ("scan_alternates", 1.50),
        ("gate_frozen", 0.90),
        ("no_motion", 1.10),
    ],
)
def test_a_fault_around_a_real_gate_leads_to_zero_in_time(fault, limit_s):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    result = best_of_three(fault)
    assert (result["n"], result["limit_s"]) == (2, limit_s)
    assert 0.0 < result["max_s"] <= limit_s


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("slow_gate", "scan_silent: zero after"),
        ("no_gate", "scan_silent: zero after inf s"),
        ("standing", "scan_silent: 0 of 1 were measured: the robot did not move"),
    ],
)
def test_a_gate_that_does_not_stop_the_robot_is_noticed(control, bar):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    missed = fails(
        "gate_faults.py", control, "--repeats", "1", "--fault", "scan_silent"
    )
    assert missed[0].startswith(bar)


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.timeout(300)
def test_a_gate_that_stopped_many_times_ends_at_once_and_keeps_the_first_stop():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    words = ("--fault", "end_after_stops", "--seconds", "5")
    code, result = asked("gate_faults.py", *words)
    assert (code, result["failures"]) == (0, [])
    assert result["end_after_stops"]["exit_s"] <= 2.0


def test_bars_of_a_fault_are_missed_by_what_is_no_number_late_unsafe_or_not_measured(
    monkeypatch,
):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import gate_faults

    good = {"n": 2, "p50_s": 0.2, "max_s": 0.3, "limit_s": 0.4, "unsafe_commands": 0}
    assert gate_faults.missed_by("x", good, 2) == []
    worse = [{"n": 1}, {"unsafe_commands": 1}]
    worse += [{"p50_s": value} for value in (0.31, float("nan"))]
    worse += [{"max_s": value} for value in (0.41, float("nan"), float("inf"))]
    for change in worse:
        assert len(gate_faults.missed_by("x", good | change, 2)) == 1, change


def test_a_rule_that_is_taken_out_is_missed_by_a_test(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import gate_rules

    names = gate_rules.names()
    assert len(names) == len(set(names)) > 30
    assert {"stop/disarmed", "refusal/check_finite", "shaping/bound"} <= set(names)
    with pytest.raises(SystemExit, match="there is no rule 'stop/nothing'"):
        gate_rules.take_out("stop/nothing")


ONE_RULE = ("--tests", "test/gate/test_arming.py", "--rule", "arming/one_publisher")


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_a_rule_that_a_test_misses_is_found():
    code, result = asked("gate_rules.py", *ONE_RULE)
    assert (code, result["failures"], result["looked_at"]) == (0, [], 1)


@pytest.mark.campaign
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("no_tests", "rule arming/one_publisher"),
        ("untested_rule", "rule stop/_covers_nothing"),
    ],
)
def test_a_rule_that_no_test_misses_is_reported(control, bar):
    assert bar in fails("gate_rules.py", control, *ONE_RULE)[0]


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
