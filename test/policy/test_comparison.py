from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.policy.evaluation import tallies


def episode(seed, result, points):
    path = np.zeros((len(points), 3))
    path[:, :2] = points
    return Episode(seed, result, path, path, np.zeros(2), np.zeros((0, 7)), 0.0)


def line(length, aside=0.0):
    return [(0.1 * k * length, aside * k / 10.0) for k in range(11)]


RUNS = {
    "fast": [episode(0, "success", line(2.0)), episode(1, "success", line(1.0))],
    "dds": [episode(0, "success", line(2.0, 0.3)), episode(1, "collision", line(1.0)[:6])],
}


def test_worlds_are_compared_with_the_first():
    told = tallies(RUNS, 0.1)
    assert told["fast"].success.value == 1.0
    assert told["fast"].same == 1.0
    assert told["fast"].greatest_deviation == 0.0
    assert told["dds"].success.value == told["dds"].collision.value == told["dds"].same == 0.5
    assert told["dds"].greatest_deviation == pytest.approx(0.3)
    assert told["dds"].deviation.value == pytest.approx(0.15)
    assert told["fast"].time.value == pytest.approx(1.0)
    assert told["fast"].length.value == pytest.approx(1.5)


def test_without_any_success_its_length_is_unknown_and_the_json_is_still_json():
    told = tallies({"fast": [episode(0, "time-out", line(0.0))]}, 0.1)["fast"]
    assert math.isnan(told.length.value)
    text = json.dumps(told.figures(), allow_nan=False)
    assert json.loads(text)["length"] == [None, None, None]


def test_what_the_robot_took_for_a_success_is_told_beside_what_was_one():
    lied = replace(episode(0, "elsewhere", line(2.0)), believed="success")
    told = tallies({"fast": [lied, episode(1, "success", line(1.0))]}, 0.1)["fast"]
    assert (told.success.value, told.believed.value, told.time_out.value) == (0.5, 1.0, 0.5)
    assert lied.plain()["believed"] == "success"
    assert lied.plain()["goal_distance_m"] == pytest.approx(2.0)


def test_an_episode_as_plain_data_keeps_its_path():
    told = json.loads(json.dumps(RUNS["dds"][0].plain()))
    assert told["seed"] == 0
    assert told["steps"] == 10
    assert np.allclose(told["path"], RUNS["dds"][0].path)
