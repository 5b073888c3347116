from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from nics_drl_bridge.policy.evaluation import mean, rate


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (1, 3), (7, 10), (480, 500), (500, 500)])
def test_the_interval_of_a_rate_is_wilsons(hits, trials):
    wanted = stats.binomtest(hits, trials).proportion_ci(method="wilson")
    found = rate(hits, trials)
    assert found.value == hits / trials
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), abs=1e-12)
    assert found.low <= found.value <= found.high


def test_the_interval_of_a_mean_is_students():
    seen = np.random.default_rng(0).normal(3.0, 2.0, 17)
    found = mean(seen)
    low, high = stats.t.interval(0.95, 16, loc=seen.mean(), scale=stats.sem(seen))
    assert (found.value, found.low, found.high) == pytest.approx((seen.mean(), low, high))


def test_nothing_observed_leaves_everything_open():
    assert (rate(0, 0).low, rate(0, 0).high) == (0.0, 1.0)
    assert math.isnan(mean([]).value)
    assert mean([2.0]).value == 2.0
    assert mean([2.0]).high == math.inf
