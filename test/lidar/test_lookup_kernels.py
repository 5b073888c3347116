from __future__ import annotations

import numpy as np
import pytest
from lidar_scenes import convex, star

from nics_drl_bridge.lidar import lookup_kernels as kernels
from nics_drl_bridge.lidar.beam_kernels import arctan2
from nics_drl_bridge.lidar.shapes import find_convex_hull


@pytest.mark.parametrize("corners", [3, 7, 1000])
@pytest.mark.parametrize("make", [convex, star])
def test_climbing_along_a_hull_ends_at_its_silhouette_from_wherever_it_begins(
    make, corners
):
    rng = np.random.default_rng(corners)
    hull = find_convex_hull(make(rng, corners).outline)
    count = len(hull)
    for _ in range(50):
        distance = np.hypot(*hull.T).max() * (1.0 + 10.0 ** rng.uniform(-6.0, 1.0))
        turn = rng.uniform(-np.pi, np.pi)
        first, stride = rng.integers([0, 1], [count, count])
        view = kernels.ShapeView(
            distance**2, distance * np.cos(turn), distance * np.sin(turn)
        )
        along, across = kernels.view_corner.py_func(view, hull.T)
        angles = np.arctan2(across, along)
        for side, edge in ((1.0, angles.min()), (-1.0, angles.max())):
            x, y = kernels.climb_hull(view, first, stride, 0, hull, count, side)
            assert np.arctan2(y, x) == pytest.approx(edge, abs=1e-9)


def test_the_fast_arc_tangent_agrees_with_the_exact_one_all_around():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, 20_000)
    sines = 3.0 * np.sin(angles)
    cosines = 3.0 * np.cos(angles)
    found = [arctan2(y, x) for y, x in zip(sines, cosines, strict=True)]
    assert found == pytest.approx(angles, abs=3e-10)
