"""BARN in small."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.train.settings import load_training

from .runs import BENCHMARKS, asked, fails


@pytest.fixture
def barn(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("barn")


def test_a_score_is_half_for_twice_the_best_time_and_falls_with_more(barn):
    course = barn.courses()[1]
    times = [course.best_s * k for k in (1.0, 2.0, 4.0, 20.0, 2.0)]
    flags = [True, True, True, True, False]
    told = barn.judged(
        dict.fromkeys(range(5), course), 1, [flags, flags, [False] * 5], times
    )
    np.testing.assert_allclose(told.score, [0.5, 0.5, 0.25, 0.125, 0.0])


@pytest.mark.slow
def test_a_robot_that_stands_misses_every_bar():
    missed = fails("barn.py", "standing", "--every", "100", "--policy", "straight")
    assert [line.split(": ")[1].split()[0] for line in missed] == ["success", "score"]


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(600)
def test_each_fold_learns_anew_and_is_judged_in_worlds_that_it_did_not_see(tmp_path):
    pytest.importorskip("torch", reason="needs the extra train")
    shipped = load_training("shipped_jackal")
    given = {"worlds": {"barn": 4, "circles": 2}, "steps": 192, "hidden": (8,)}
    ppo = shipped.ppo.model_copy(update={"batch": 96})
    tiny = shipped.model_copy(update={**given, "ppo": ppo})
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny.model_dump(mode="json")))
    words = ("--five-fold", str(tmp_path / "tiny.yaml"), "--every", "45")
    code, told = asked("barn.py", *words)
    assert code == 1  # it has hardly learnt
    assert 0.0 < told["training_s"] < 600.0


@pytest.mark.ros
@pytest.mark.process
def test_a_planner_that_heeds_no_obstacle_misses_the_score_in_mujoco():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    words = ("--in", "mujoco_dds", "--policy", "straight", "--every", "250")
    code, told = asked("barn.py", *words)
    assert code == 1
    assert told["failures"][0].startswith("straight: score")


@pytest.mark.parametrize("word", ["--control", "--five-fold"])
def test_what_is_not_done_in_mujoco_is_refused(word):
    words = (word, "--in", "mujoco_dds")
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "barn.py"), *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=100.0,
    )
    assert done.returncode == 2
    assert "in fast alone; leave out --in" in done.stderr


def test_each_bar_can_be_missed_in_each_place(barn):
    good = {"success": 0.97, "collision": 0.01, "score": 0.46}
    bad = (0.94, 0.03, 0.39)
    for place, bars in barn.BARS.items():
        assert barn.missed(place, good, "jackal") == []
        for name, value in zip(good, bad, strict=True):
            said = barn.missed(place, good | {name: value}, "jackal")
            assert bool(said) == (name in bars)
    for seconds, told in ((599.0, 0), (601.0, 1), (float("nan"), 1)):
        assert len(barn.missed("fast", good, "jackal", seconds)) == told


def test_settings_whose_worlds_no_fold_could_leave_out_are_refused(barn):
    with pytest.raises(ConfigError, match="replaces the world 'barn'"):
        barn.drive_folds("navigation_differential", {}, 1, None)


def test_folds_of_too_few_worlds_are_refused(barn):
    with pytest.raises(ConfigError, match="needs 5 worlds, not 3"):
        barn.drive_folds("shipped_jackal", barn.courses(100), 1, None)
