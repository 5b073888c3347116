from __future__ import annotations

import math

import pytest

from nics_drl_bridge.report.pictures import Point, training_curve


@pytest.mark.parametrize(
    "points", [[Point(8192, math.nan, math.nan)], [Point(8192, 0.1, 0.9), Point(16384, 0.6, 0.4)]]
)
def test_a_training_is_drawn_from_its_first_rollout_on(points):
    assert training_curve(points).startswith(b"\x89PNG")
