from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.lidar.beam_kernels import arctan2


def test_the_fast_arc_tangent_agrees_with_the_exact_one_all_around():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, 20_000)
    sines = 3.0 * np.sin(angles)
    cosines = 3.0 * np.cos(angles)
    found = [arctan2(y, x) for y, x in zip(sines, cosines, strict=True)]
    assert found == pytest.approx(angles, abs=3e-10)
