from __future__ import annotations

import pytest

from .runs import asked, fails

pytest.importorskip("torch", reason="needs the extra 'train'")
pytest.importorskip("rosbags", reason="needs the extra 'bags'")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_what_an_attacker_hands_in_is_refused_in_a_sentence_and_what_is_good_is_taken():
    code, found = asked("abuse.py", "--only", "files", "--rounds", "12", "--seed", "5")
    assert (code, found["failures"]) == (0, []), found["told"]
    assert found["tries"] == 48
    assert found["good"] > 0
    assert {"policy", "yaml", "bag", "seed"} <= set(found["by_kind"])


@pytest.mark.timeout(600)
def test_without_the_checks_of_policies_and_yaml_bad_files_are_taken():
    missed = fails("abuse.py", "credulous", "--rounds", "12")
    assert any(
        "tracebacks" in line or "accepted" in line or "hangs" in line for line in missed
    )


@pytest.mark.ros
@pytest.mark.timeout(600)
def test_without_the_zero_behind_an_exception_a_robot_moves_on():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    assert any(
        "moved" in line for line in fails("abuse.py", "no_guard", "--rounds", "2")
    )
