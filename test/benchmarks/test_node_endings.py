"""The benchmark of endings in small: two nodes, once each."""

from __future__ import annotations

import pytest

from .runs import CAMPAIGNS, asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]
SCRIPT = "node_endings.py"
PHASES = ("starting", "compiling", "native")
SHORT = ("--times", "2", "--loops", "0", "--nodes", "middleware_node")


def test_a_node_ends_at_once_also_while_it_starts_or_compiles():
    code, result = asked(SCRIPT, *SHORT, "--phases", *PHASES)
    assert set(result["endings"]) == {f"middleware_node {phase}" for phase in PHASES}
    assert not [
        each["failed"] for each in result["endings"].values() if each["failed"]
    ], result
    # The time is a matter of speed.
    assert all(" took " in line for line in result["failures"])
    assert code == bool(result["failures"])


def test_without_the_handler_of_its_own_a_node_ends_after_a_step_of_the_compiler():
    missed = fails(SCRIPT, "late", *SHORT, "--phases", "native")
    assert any("middleware_node native: took " in line for line in missed)


def test_a_node_that_was_killed_or_took_too_long_is_named(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import node_endings

    good = {"reached_s": 3.0, "median_s": 0.1, "longest_s": 0.2, "failed": []}
    bad = good | {"longest_s": 9.0, "failed": [{"code": -11}]}
    endings = {"a running": good, "b running": bad}
    missed = node_endings.missed_of({"loops": 0, "endings": endings})
    assert len(missed) == 2
    assert all(line.startswith("b running") for line in missed)
    assert "-11" in missed[1]


@pytest.mark.parametrize(("loops", "count"), [(0, 1), (2, 0)])
def test_a_first_line_that_comes_late_on_quiet_cores_is_named(
    monkeypatch, loops, count
):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import node_endings

    late = {"reached_s": 1.2, "median_s": 0.1, "longest_s": 0.2, "failed": []}
    missed = node_endings.missed_of({"loops": loops, "endings": {"a starting": late}})
    assert len(missed) == count
    assert all("a starting: its first line took 1.20 s" in line for line in missed)
