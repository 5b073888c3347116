"""The benchmark of the estimator in small: its JSON has all keys, its figures keep the bars."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "estimator.py"


@pytest.fixture(scope="module")
def result() -> dict:
    """The one JSON object that the benchmark prints."""
    options = ["--json", "--drives", "20", "--steps", "30000"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *options],
        capture_output=True, text=True, check=True, timeout=110,
    )  # fmt: skip
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def test_the_estimate_is_off_by_at_most_half_of_what_odometry_is(result):
    for each in (result, *result["robots"].values()):
        assert each["ekf_rmse_m"] <= 0.5 * each["raw_rmse_m"]
        assert each["raw_rmse_m"] > 0.05  # the drives are no stroll


def test_the_estimate_is_off_by_as_much_as_it_claims(result):
    low, high = result["nees_95_band"]
    assert low < result["nees_mean"] < high
    assert result["drives"] == 60


def test_every_random_step_leaves_the_covariance_positive_definite(result):
    assert result["random_steps"] == 30_000
    assert result["finite_and_positive_definite"] is True
    assert result["cycle_us"] > 0.0
