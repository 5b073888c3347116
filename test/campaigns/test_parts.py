"""The parts of the campaigns: what they count, and that they see what is wrong."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from importlib import import_module

import numpy as np
import pytest

from .campaign import FOLDER, find_missed


@pytest.fixture
def module(monkeypatch):
    folders = [FOLDER, FOLDER.parents[1] / "benchmarks"]
    monkeypatch.setattr(sys, "path", [*map(str, folders), *sys.path])
    return import_module


@pytest.fixture
def ros_module(module):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    return module


NAN = float("nan")


@pytest.mark.parametrize(
    "change",
    [
        {"n": 4},
        {"unsafe_commands": 1},
        {"p50_s": 0.31},
        {"p50_s": NAN},
        {"max_s": 0.41},
        {"max_s": NAN},
        {"max_s": math.inf},
    ],
)
def test_a_fault_that_is_late_unsafe_or_not_measured_misses_one_bar(ros_module, change):
    set_bars = ros_module("gate_faults").set_bars
    good = {
        "n": 5,
        "asked": 5,
        "p50_s": 0.2,
        "max_s": 0.3,
        "limit_s": 0.4,
        "unsafe_commands": 0,
    }
    few = good | {"n": 1, "asked": 1, "p50_s": 0.31}  # no median, but chance
    for figures, missed in ((good, 0), (few, 0), (good | change, 1)):
        result = {"x": figures}
        assert len(find_missed(result, set_bars(result))) == missed


def test_every_rule_of_the_gate_has_a_name_by_which_it_is_taken_out(module):
    rules = module("gate_rules")
    names = rules.list_rules()
    assert len(names) == len(set(names)) > 30
    assert {"stop/disarmed", "refusal/check_finite", "shaping/bound"} <= set(names)
    with pytest.raises(SystemExit, match="stop/nothing"):
        rules.take_out("stop/nothing")


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([1.0, NAN], [1.0, NAN], math.inf),
        ([1.0, 2.0], [1.0, NAN], math.inf),
        ([np.inf], [np.inf], math.inf),
        ([1.0, 2.0], [[1.0, 2.0]], math.inf),
        ([1.0, 2.0], [1.0], math.inf),
        ([1.0, 2.5], [1.0, 2.0], 0.5),
        (True, False, 1.0),
        ([], [], 0.0),
    ],
)
def test_a_difference_is_never_nan(ros_module, one, other, expected):
    assert ros_module("parity").compute_difference(one, other) == expected


def test_what_info_tells_is_compared_by_name(ros_module):
    parity = ros_module("parity")
    info = {"pose": np.zeros(3), "reward_terms": {"time": -0.01}, "is_success": False}
    assert parity.compare_infos(info, dict(info)) == 0.0
    assert parity.compare_infos(info, {**info, "is_success": True}) == 1.0
    assert parity.compare_infos(info, {**info, "reward_terms": {}}) == math.inf
    assert parity.compare_infos(info, {"pose": np.zeros(3)}) == math.inf


def test_what_nodes_of_nav2_say_to_each_other_is_not_asked_of_the_robot(
    ros_module, tmp_path
):
    nav2_names = ros_module("parts.nav2_names")
    file = tmp_path / "nav2.yaml"
    file.write_text(
        "collision_monitor:\n  ros__parameters:\n    cmd_vel_in_topic: cmd_vel_raw\n"
        "    odom_topic: /odometry/filtered\n    polygon: {polygon_pub_topic: polygon_stop}\n"
    )
    topics, _ = nav2_names.read_wanted(file)
    assert topics - nav2_names.ALWAYS == {"odometry/filtered"}
    assert topics <= nav2_names.TYPES.keys()


def test_the_shipped_values_keep_room_to_brake_at_all_speeds(module):
    braking = module("parts.braking")
    assert 0.1 in braking.SHARES
    for robot in ("ackermann", "differential", "mecanum"):
        assert 0.8 < braking.measure_braking(robot, {}) <= 1.0
    assert braking.measure_braking("ackermann", {"latency": 0.17}) > 1.0


def drove(engine: str, seed: int, result: str, world: str = "room") -> dict:
    """A row of the campaign `transfer`."""
    return {
        "robot": "rover",
        "engine": engine,
        "seed": seed,
        "world": world,
        "result": result,
        "believed": result,
    }


def test_engines_are_compared_by_the_episodes_that_all_have_driven(module):
    transfer = module("transfer")
    rows = [drove("fast", seed, "success") for seed in range(5)]
    rows += [drove("dart", seed, "success") for seed in range(1, 4)]
    rows += [drove("dart", 4, "collision")]
    told = transfer.compare_engines(rows, ["rover"], ["fast", "dart"])["rover"]
    assert told["fast"]["episodes"] == told["dart"]["episodes"] == 4
    assert told["dart"]["points"] == -25.0
    assert (told["dart"]["lost"], told["dart"]["gained"]) == (1, 0)
    result = {"engines": {"rover": told}}
    missed = find_missed(result, transfer.set_bars(result))
    assert len(missed) == 2
    assert all(line.startswith("engines: rover: dart: ") for line in missed)


def test_a_run_goes_on_where_the_file_ends(module, tmp_path):
    transfer = module("transfer")
    open_book = module("parts.book").Book
    file = tmp_path / "rows.jsonl"
    asked = {"worlds": ["room"], "randomisation": "mild", "control": None}
    seed = transfer.FIRST_SEED
    first, second = (drove("fast", seed + k, "success") for k in (0, 1))
    open_book(file, asked).add([second])
    with file.open("a") as torn:
        torn.write('{"robot": "rov')
    given = Namespace(episodes=3, robots=["rover"], **asked)
    book = open_book(file, asked)
    (job,) = transfer.plan_jobs(given, ["fast"], book)
    assert job.seeds == [seed, seed + 2]
    book.add([first])
    assert open_book(file, asked).rows == [second, first]
    with pytest.raises(SystemExit, match="another run"):
        open_book(file, asked | {"control": "ice"})
