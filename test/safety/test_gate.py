from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.safety.gate import Limits, Request, decide

LIMITS = Limits(low=np.array([0.0, -0.1, -0.5]), high=np.array([1.0, 0.1, 0.5]), scan_age_s=0.35)
GOOD = np.array([0.5, 0.0, -0.2])


def test_a_fresh_command_within_limits_passes_unchanged():
    decision = decide(10.0, Request(GOOD, 9.9), LIMITS)
    assert np.array_equal(decision.twist, GOOD)
    assert decision.cause == ""


def test_a_command_beyond_the_limits_is_cut_to_them():
    decision = decide(10.0, Request(np.array([3.0, -2.0, 0.7]), 9.9), LIMITS)
    assert decision.twist.tolist() == [1.0, -0.1, 0.5]
    assert decision.cause == ""


@pytest.mark.parametrize(
    ("request_", "cause"),
    [
        (None, "no command yet"),
        (Request(GOOD, None), "never arrived here"),
        (Request(np.array([np.nan, 0.0, 0.0]), 9.9), "NaN or inf"),
        (Request(np.array([0.0, 0.0, np.inf]), 9.9), "NaN or inf"),
        (Request(GOOD, 9.6), "is 0.400 s old, the limit is 0.35 s"),
        (Request(GOOD, 10.5), "is -0.500 s old"),
        (Request(GOOD, np.nan), "is nan s old"),
        (Request(GOOD, -np.inf), "is inf s old"),
    ],
)
def test_anything_else_stops_the_robot_and_says_why(request_, cause):
    decision = decide(10.0, request_, LIMITS)
    assert not decision.twist.any()
    assert cause in decision.cause


@pytest.mark.parametrize(("age", "moves"), [(0.0, True), (0.35, True), (0.3501, False)])
def test_the_age_limit_is_inclusive(age, moves):
    assert decide(age, Request(GOOD, 0.0), LIMITS).twist.any() == moves


def test_whatever_comes_in_what_goes_out_is_finite_and_within_limits_or_zero():
    rng = np.random.default_rng(0)
    odd = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, 5e-324])
    for _ in range(3000):
        twist = np.where(rng.random(3) < 0.3, rng.choice(odd, 3), rng.normal(size=3) * 3.0)
        arrival = rng.choice([None, np.nan, np.inf, 9.0, 9.8, 10.0, 11.0])
        now = rng.choice([10.0, np.nan, np.inf, -1.0])
        decision = decide(float(now), Request(twist, arrival), LIMITS)
        assert np.isfinite(decision.twist).all()
        inside = (decision.twist >= LIMITS.low).all() and (decision.twist <= LIMITS.high).all()
        assert inside
        if decision.cause:
            assert not decision.twist.any()
        else:
            assert 0.0 <= now - arrival <= 0.35


def test_the_request_is_not_changed():
    twist = np.array([3.0, 0.0, 0.0])
    decide(10.0, Request(twist, 9.9), LIMITS)
    assert twist[0] == 3.0
