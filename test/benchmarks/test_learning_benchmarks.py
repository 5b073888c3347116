"""Benchmarks of policies in small: each misses a bar when nothing is driven or learnt."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import pytest

from nics_drl_bridge.policy.policies import shipped_policies

from .runs import BENCHMARKS, asked, fails

missing = [name for name in ("rclpy", "mujoco") if find_spec(name) is None]
ready = not missing and "differential" in shipped_policies()
over_ros = pytest.mark.skipif(
    not ready, reason="needs ROS 2, MuJoCo and the shipped policies"
)
no_torch = pytest.mark.skipif(
    find_spec("stable_baselines3") is None, reason="needs training"
)
BASELINES = (
    "--robot",
    "differential",
    "--policy",
    "dynamic_window",
    "--episodes",
    "20",
)


@pytest.mark.campaign
def test_a_baseline_reaches_its_goals():
    code, told = asked("baselines.py", *BASELINES)
    assert (code, told["failures"]) == (0, [])
    assert told["circles/differential/dynamic_window"]["success"]["value"] >= 0.7


@pytest.mark.campaign
def test_a_baseline_that_stands_still_misses_its_floor():
    missed = fails("baselines.py", "standing", *BASELINES)
    assert any("dynamic_window: 0% success" in line for line in missed)


@pytest.mark.campaign
@no_torch
def test_a_net_that_has_not_learnt_misses_the_success():
    missed = fails("training.py", "untrained", "--episodes", "20")
    assert any("success after training" in line for line in missed)


@no_torch
@pytest.mark.parametrize("name", ["success_rate", "wall_s", "steps_per_s"])
def test_a_figure_of_training_that_is_no_number_misses_its_bar(monkeypatch, name):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    training = import_module("training")
    good = {"success_rate": 0.99, "wall_s": 10.0, "steps_per_s": 2e5}
    assert training.missed("differential", good) == []
    assert len(training.missed("differential", good | {name: float("nan")})) == 1


@pytest.mark.campaign
@pytest.mark.ros
@over_ros
@pytest.mark.parametrize("control", ["standing", "lying"])
def test_a_picture_of_robots_that_never_arrive_fails(tmp_path, control):
    words = ("--episodes", "1", "--robots", "differential", "--out", str(tmp_path))
    missed = fails("paper_fig7.py", control, *words)
    assert sum("0% of the goals were truly reached" in line for line in missed) == 3


@pytest.mark.campaign
@pytest.mark.ros
@over_ros
def test_the_picture_is_of_goals_that_were_truly_reached(tmp_path):
    words = ("--episodes", "1", "--robots", "differential", "--out", str(tmp_path))
    code, told = asked("paper_fig7.py", *words)
    assert (code, told["failures"]) == (0, [])
    assert (tmp_path / "fig7_differential.png").is_file()
