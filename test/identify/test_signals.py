from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.identify.signals import resample


@pytest.mark.parametrize("rate_hz", [20.0, 200.0, 1000.0])
def test_a_window_of_many_poses_is_used_on_both_sides_of_its_time(rate_hz):
    t = np.arange(0.0, 4.0, 1.0 / rate_hz)
    pose = np.stack([np.sin(t), np.cos(t), 0.3 * t], axis=1)
    at = np.linspace(1.0, 3.0, 9)
    smoothed = resample(t, pose, at, half_width=0.2)
    expected = np.stack([np.sin(at), np.cos(at), 0.3 * at], axis=1)
    assert np.abs(smoothed - expected).max() < 2e-4
