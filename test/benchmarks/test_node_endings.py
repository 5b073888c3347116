"""The benchmark of endings in small: two nodes, once each."""

from __future__ import annotations

import pytest

from .runs import BENCHMARKS, asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]
SCRIPT = "node_endings.py"
PHASES = ("starting", "compiling", "native")
SHORT = ("--times", "2", "--loops", "0", "--nodes", "middleware_node")


def test_a_node_ends_at_once_with_0_also_while_it_starts_or_compiles():
    code, result = asked(SCRIPT, *SHORT, "--phases", *PHASES)
    assert set(result["endings"]) == {f"middleware_node {phase}" for phase in PHASES}
    assert not [each["failed"] for each in result["endings"].values() if each["failed"]], result
    # The time is a matter of speed.
    assert all(": took " in line for line in result["failures"])
    assert code == bool(result["failures"])


def test_without_the_handler_of_its_own_a_node_ends_after_a_step_of_the_compiler():
    missed = fails(SCRIPT, "late", *SHORT, "--phases", "native")
    assert any("middleware_node native: took " in line for line in missed)


def test_a_node_that_was_killed_or_took_too_long_is_named(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import node_endings

    good = {"median_s": 0.1, "longest_s": 0.2, "failed": []}
    bad = {"median_s": 0.1, "longest_s": 9.0, "failed": [{"code": -11}]}
    missed = node_endings.missed_of({"endings": {"a running": good, "b running": bad}})
    assert len(missed) == 2
    assert all(line.startswith("b running") for line in missed)
    assert "-11" in missed[1]
