"""The benchmark of parity in small, and what it must not let through."""

from __future__ import annotations

import math

import numpy as np
import pytest

from .runs import CAMPAIGNS, asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
SCRIPT = "parity.py"
SHORT = ("--steps", "25", "--robot", "ackermann")
DIFFERENT = "max_abs_observation_difference"


@pytest.fixture
def parity(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import parity

    return parity


@pytest.mark.campaign
@pytest.mark.parametrize("options", [SHORT, (*SHORT, "--robots", "2", "--seed", "5")])
def test_an_env_over_topics_is_the_env_in_process(options):
    code, result = asked(SCRIPT, *options)
    assert (code, result["failures"]) == (0, [])
    assert (result[DIFFERENT], result["late_observations"]) == (0.0, 0)
    assert result["episodes"] >= 1
    assert result["driven_m"] > 0.2


@pytest.mark.campaign
def test_one_nan_among_all_observations_is_found():
    assert f"{DIFFERENT} inf: must be 0" in fails(SCRIPT, "nan", *SHORT)


@pytest.mark.campaign
def test_the_last_bit_of_one_number_is_found():
    (missed,) = fails(SCRIPT, "noise", *SHORT)
    assert missed.startswith(f"{DIFFERENT} ")
    assert "inf" not in missed


@pytest.mark.campaign
def test_an_observation_that_is_told_twice_is_late_and_different():
    missed = fails(SCRIPT, "late", *SHORT)
    assert [line.split()[0] for line in missed] == [DIFFERENT, "late_observations"]


@pytest.mark.campaign
def test_robots_that_stand_have_shown_nothing():
    (missed,) = fails(SCRIPT, "standing", *SHORT)
    assert missed.startswith("driven_m 0.0")
    assert missed.endswith("must be 0.2 at least in every run")


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([1.0, np.nan], [1.0, np.nan], math.inf),
        ([1.0, 2.0], [1.0, np.nan], math.inf),
        ([np.inf], [np.inf], math.inf),
        ([1.0, 2.0], [[1.0, 2.0]], math.inf),
        ([1.0, 2.0], [1.0], math.inf),
        ([1.0, 2.5], [1.0, 2.0], 0.5),
        (True, False, 1.0),
        ([], [], 0.0),
    ],
)
def test_a_difference_is_never_nan(parity, one, other, expected):
    assert parity.difference(one, other) == expected


def test_what_info_tells_is_compared_by_name(parity):
    info = {"pose": np.zeros(3), "reward_terms": {"time": -0.01}, "is_success": False}
    assert parity.told_differently(info, dict(info)) == 0.0
    assert parity.told_differently(info, {**info, "is_success": True}) == 1.0
    assert parity.told_differently(info, {**info, "reward_terms": {}}) == math.inf
    assert parity.told_differently(info, {"pose": np.zeros(3)}) == math.inf


def test_a_figure_that_is_nan_misses_every_bar(parity):
    nan = float("nan")
    result = {parity.DIFFERENCE: nan, parity.LATE: nan, parity.DRIVEN: nan}
    assert len(parity.bars(result)) == 3
