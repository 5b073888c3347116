"""The estimator's benchmark in small: it keeps its bars, and misses one under each control."""

from __future__ import annotations

import pytest

from .runs import asked, fails

SCRIPT = "estimator.py"
SMALL = ("--drives", "11")
TINY = ("--drives", "3")


@pytest.fixture(scope="module")
def result() -> dict:
    """The one JSON object that the benchmark prints."""
    code, found = asked(SCRIPT, *SMALL)
    assert (code, found["failures"]) == (0, [])
    return found


@pytest.mark.campaign
def test_the_estimate_is_off_by_a_small_share_of_what_odometry_is(result):
    assert result["ekf_rmse_m"] <= 0.2 * result["raw_rmse_m"]
    for each in result["robots"].values():
        assert each["raw_rmse_m"] > 0.05  # the drives are no stroll
        assert each["way_m"] > 3.0


@pytest.mark.campaign
def test_the_estimate_is_off_by_as_much_as_it_claims(result):
    low, high = result["nees_95_band"]
    assert low < result["nees_mean"] < high
    assert result["drives"] == 33


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [
        ("no_filter", "all robots: the estimate is off by"),
        ("overconfident", "NEES is"),
        ("nan", "all robots: the estimate is off by nan"),
        ("stands", "all robots: the estimate is off by"),
    ],
)
def test_a_control_misses_its_bar(control, bar):
    size = SMALL if control == "overconfident" else TINY
    assert any(bar in line for line in fails(SCRIPT, control, *size))
