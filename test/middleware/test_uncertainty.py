"""How much certainty an estimate has lost is told in metres and radians."""

from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.middleware.uncertainty import compute_uncertainty_gain


def test_what_an_estimate_gained_in_uncertainty_is_told():
    before = np.diag([0.01, 0.01, 0.0004])
    after = before + np.diag([0.09, 0.04, 0.0025])
    gained = compute_uncertainty_gain(before, after)
    assert gained == pytest.approx((0.3, 0.05))
    told = gained.describe_since("the start")
    assert told == "position uncertain by 0.3 m, heading by 0.05 rad since the start"


def test_a_localiser_leaves_no_uncertainty_since_the_start():
    assert compute_uncertainty_gain(np.eye(3), np.eye(3) * 0.1) == (0.0, 0.0)
