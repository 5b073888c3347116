import math

import numpy as np
import pytest
from scipy import stats

from nics_drl_bridge.confidence import bound_rate, estimate_mean, estimate_rate


@pytest.mark.parametrize(
    ("hits", "trials"), [(0, 10), (1, 3), (7, 10), (480, 500), (500, 500)]
)
def test_the_interval_of_a_rate_is_wilsons(hits, trials):
    wanted = stats.binomtest(hits, trials).proportion_ci(method="wilson")
    found = estimate_rate(hits, trials)
    assert found.value == hits / trials
    assert (found.low, found.high) == pytest.approx(
        (wanted.low, wanted.high), abs=1e-12
    )
    assert found.low <= found.value <= found.high


def test_the_interval_of_a_mean_is_students():
    seen = np.random.default_rng(0).normal(3.0, 2.0, 17)
    found = estimate_mean(seen)
    low, high = stats.t.interval(0.95, 16, loc=seen.mean(), scale=stats.sem(seen))
    assert (found.value, found.low, found.high) == pytest.approx(
        (seen.mean(), low, high)
    )


def test_nothing_observed_leaves_everything_open():
    assert (estimate_rate(0, 0).low, estimate_rate(0, 0).high) == (0.0, 1.0)
    assert math.isnan(estimate_mean([]).value)
    assert estimate_mean([2.0]).value == 2.0
    assert estimate_mean([2.0]).high == math.inf


@pytest.mark.parametrize(
    ("failures", "trials", "low", "high"),
    [
        (0, 1, 0.0, 0.95),
        (0, 10, 0.0, 0.2589),
        (1, 10, 0.0025, 0.4450),
        (5, 10, 0.1871, 0.8129),
        (10, 10, 0.6915, 1.0),
        (2, 100, 0.0024, 0.0704),
        (50, 1000, 0.0373, 0.0654),
        (0, 0, 0.0, 1.0),
    ],
)
def test_the_bounds_are_those_of_published_tables(failures, trials, low, high):
    assert bound_rate(failures, trials) == pytest.approx((low, high), abs=6e-5)


@pytest.mark.parametrize("trials", [100, 1000, 30_000])
def test_without_failures_the_upper_bound_is_three_in_so_many_trials(trials):
    _, high = bound_rate(0, trials)
    assert 0.98 * 3.0 / trials < high <= 3.0 / trials
