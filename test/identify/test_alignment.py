from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.identify.alignment import lag_behind, resample


@pytest.mark.parametrize("rate_hz", [20.0, 200.0, 1000.0])
def test_a_window_of_many_poses_is_used_on_both_sides_of_its_time(rate_hz):
    t = np.arange(0.0, 4.0, 1.0 / rate_hz)
    pose = np.stack([np.sin(t), np.cos(t), 0.3 * t], axis=1)
    at = np.linspace(1.0, 3.0, 9)
    smoothed = resample(t, pose, at, half_width=0.2)
    expected = np.stack([np.sin(at), np.cos(at), 0.3 * at], axis=1)
    assert np.abs(smoothed - expected).max() < 2e-4


def test_a_state_behind_a_held_target_approaches_it_exponentially():
    kept = 0.8
    states = lag_behind(np.full(20, 2.0), 0.5, kept)
    assert states == pytest.approx(2.0 - 1.5 * kept ** np.arange(20))


def test_a_target_acts_on_the_next_state():
    assert lag_behind(np.array([1.0, 5.0]), 0.0, 0.5).tolist() == [0.0, 0.5]
