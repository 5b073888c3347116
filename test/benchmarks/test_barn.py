"""BARN in small: the worlds of a folder are those of the package, and scores the benchmark's."""

from __future__ import annotations

import csv
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.policy.training_settings import load_training
from nics_drl_bridge.sim import barn as worlds

from .runs import BENCHMARKS, asked, fails

NUMBERS = (1, 150 - 1, 299)
SDF = """<sdf version="1.6"><world name="default">{}</world></sdf>"""
CYLINDER = """<model name="c{}"><pose frame="">{} {} 0 0 0 0</pose><static>1</static><link name="l">
<collision name="c"><geometry><cylinder><radius>0.075</radius><length>1</length></cylinder>
</geometry><pose>0 0 0.5 0 0 0</pose></collision></link></model>"""


@pytest.fixture
def barn(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("barn")


def cylinders(number):
    (group,) = worlds.barn_world(number).obstacles
    return [(x, y) for x, y, _ in group.at]


def write(file, points, numbers=NUMBERS):
    with file.open("w", newline="") as lines:
        rows = csv.writer(lines)
        rows.writerow(("world", "x_m", "y_m"))
        rows.writerows((n, x, y) for n in numbers for x, y in points(n))


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "cylinders.csv", cylinders)
    write(tmp_path / "reference_paths.csv", lambda n: worlds.barn_path(n).tolist())
    return tmp_path


def test_worlds_of_a_folder_are_those_that_come_with_the_package(barn, folder):
    own = barn.courses(None)
    given = barn.courses(folder)
    assert tuple(given) == NUMBERS
    for number, course in given.items():
        assert course.length == pytest.approx(own[number].length)
        assert course.world.obstacles == own[number].world.obstacles


def test_a_folder_of_gazebo_worlds_is_read_without_paths(barn, tmp_path):
    text = "".join(CYLINDER.format(k, *at) for k, at in enumerate(cylinders(1)))
    (tmp_path / "world_1.world").write_text(SDF.format(text))
    (number, course), *_ = barn.courses(tmp_path).items()
    own = barn.courses(None)[1]
    assert number == 1
    assert sorted(course.world.obstacles[0].at) == sorted(own.world.obstacles[0].at)
    assert course.length == pytest.approx(own.length, rel=0.15)


def test_own_shortest_paths_are_a_little_shorter_than_those_of_the_benchmark(barn):
    from measuring.shortest_path import shortest_path

    shares = [
        barn.length_of(shortest_path(np.array(cylinders(n))))
        / barn.length_of(worlds.barn_path(n))
        for n in worlds.barn_numbers()[::25]
    ]
    assert 0.85 < min(shares) <= max(shares) < 1.02


def test_a_folder_without_worlds_is_refused(barn, tmp_path):
    with pytest.raises(
        ConfigError, match=r"holds neither cylinders\.csv nor world files"
    ):
        barn.courses(tmp_path)


def test_a_world_of_other_shapes_is_refused(barn, tmp_path):
    wide = CYLINDER.format(0, 1.0, 5.0).replace("0.075", "0.5")
    (tmp_path / "world_7.world").write_text(SDF.format(wide))
    with pytest.raises(
        ConfigError, match=r"world_7\.world: holds something else than cylinders"
    ):
        barn.courses(tmp_path)


def test_a_score_is_half_for_twice_the_best_time_and_falls_with_more(barn):
    course = barn.courses(None)[1]
    times = [course.best_s * k for k in (1.0, 2.0, 4.0, 20.0, 2.0)]
    flags = [True, True, True, True, False]
    told = barn.judged(
        dict.fromkeys(range(5), course), 1, [flags, flags, [False] * 5], times
    )
    np.testing.assert_allclose(told.score, [0.5, 0.5, 0.25, 0.125, 0.0])


@pytest.mark.slow
def test_a_robot_that_stands_misses_every_bar(folder):
    missed = fails(
        "barn.py", "standing", "--worlds", str(folder), "--policy", "straight"
    )
    assert [line.split(": ")[1].split()[0] for line in missed] == ["success", "score"]


@pytest.mark.slow
def test_each_world_has_its_figures(folder):
    _, told = asked(
        "barn.py", "--worlds", str(folder), "--policy", "straight", "--runs", "2"
    )
    assert set(told["worlds"]) == {str(n) for n in NUMBERS}
    keys = {"success", "believed", "collision", "time_out", "time_s", "score"}
    assert keys == set(told["worlds"]["1"]) < set(told)
    means = np.mean(
        [[one[key] for key in ("success", "score")] for one in told["worlds"].values()],
        axis=0,
    )
    np.testing.assert_allclose(means, [told["success"], told["score"]])


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(600)
def test_each_fold_learns_anew_and_is_judged_in_worlds_that_it_did_not_see(tmp_path):
    pytest.importorskip("torch", reason="needs the extra train")
    numbers = worlds.barn_numbers()[:6]
    write(tmp_path / "cylinders.csv", cylinders, numbers)
    write(
        tmp_path / "reference_paths.csv",
        lambda n: worlds.barn_path(n).tolist(),
        numbers,
    )
    shipped = load_training("shipped_jackal")
    given = {"worlds": {"barn": 4, "circles": 2}, "steps": 192, "hidden": (8,)}
    ppo = shipped.ppo.model_copy(update={"batch": 96})
    tiny = shipped.model_copy(update={**given, "ppo": ppo})
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny.model_dump(mode="json")))
    words = ("--five-fold", str(tmp_path / "tiny.yaml"), "--worlds", str(tmp_path))
    code, told = asked("barn.py", *words)
    assert code == 1  # it has hardly learnt
    assert set(told["worlds"]) == set(map(str, numbers))
    assert 0.0 < told["training_s"] < 600.0


@pytest.mark.ros
@pytest.mark.process
def test_a_planner_that_heeds_no_obstacle_misses_the_score_in_mujoco(folder):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    pytest.importorskip("mujoco", reason="needs the extra mujoco")
    words = ("--in", "mujoco_dds", "--policy", "straight", "--worlds", str(folder))
    code, told = asked("barn.py", *words)
    assert (code, list(told["worlds"])) == (1, [str(NUMBERS[0])])
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


@pytest.mark.parametrize("text", ["world,x_m\n1,2.0\n", "world,x_m,y_m\n1,2.0,near\n"])
def test_a_table_of_cylinders_that_lacks_numbers_is_refused(barn, tmp_path, text):
    (tmp_path / "cylinders.csv").write_text(text)
    with pytest.raises(
        ConfigError, match=r"cylinders\.csv: line 2 lacks numbers in the columns"
    ):
        barn.courses(tmp_path)


def test_settings_whose_worlds_no_fold_could_leave_out_are_refused(barn):
    with pytest.raises(ConfigError, match="replaces the world 'barn'"):
        barn.drive_folds("navigation_differential", {}, 1, None)


def test_folds_of_too_few_worlds_are_refused(barn, folder):
    with pytest.raises(ConfigError, match="needs 5 worlds, not 3"):
        barn.drive_folds("shipped_jackal", barn.courses(folder), 1, None)
