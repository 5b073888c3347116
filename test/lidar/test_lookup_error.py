"""What `auto` looks up is right within 1 cm of the exact scan."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from lidar_scenes import poses_around, random_shapes

from nics_drl_bridge.lidar.scanner import Scanner, make_scanner
from nics_drl_bridge.lidar.shapes import Polygon
from nics_drl_bridge.lidar.spec import load_lidar

BAR = 0.01
BANDS = (0.0, 0.1, 0.3, 0.6, 1.0, 2.0, 4.0, 8.0, 16.0)
FEWEST = 2000
"""Beams that a band must have for its error to say something."""


def errors(spec, shape, gap, rng):
    """True ranges and errors of the beams that return, and how far away the shape is."""
    poses = poses_around(rng, shape.radius + gap[:, None])
    auto = make_scanner(spec, [shape])
    found, true = (
        scanner.scan(np.zeros((len(gap), 3)), scanner.place([shape], poses))
        for scanner in (auto, Scanner(spec, auto.table, "exact"))
    )
    both = np.isfinite(found) & np.isfinite(true)
    return true[both], (found - true)[both], np.repeat(gap, both.sum(axis=1))


@pytest.mark.slow
@pytest.mark.timeout(600)  # a cold start compiles
@pytest.mark.filterwarnings("ignore:invalid value")
def test_auto_is_right_within_a_centimetre_in_every_band_for_every_shape():
    spec = load_lidar("hokuyo_ust_10lx")
    rng = np.random.default_rng(11)
    looked_up = 0
    for shape in random_shapes(11):
        near = 10.0 ** rng.uniform(-3.0, np.log10(spec.range_max), 250)
        gap = np.concatenate([near, rng.uniform(0.0, spec.range_max, 250)])
        true, error, away = errors(spec, shape, gap, rng)
        looked_up += (np.abs(error) > 1e-4).any()
        for which in (true, away):
            for low, high in itertools.pairwise(BANDS):
                chosen = error[(which >= low) & (which < high)]
                if len(chosen) >= FEWEST:
                    assert np.sqrt(np.mean(chosen**2)) <= BAR, (shape, low, high)
    assert looked_up >= 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_star_that_the_lidar_all_but_touches_is_right_where_few_places_err():
    turns = np.arange(6) * np.pi / 3.0
    reach = np.where(np.arange(6) % 2, 0.176, 0.402)
    corners = np.stack([reach * np.cos(turns), reach * np.sin(turns)], axis=1)
    rng = np.random.default_rng(2)
    gap = rng.uniform(0.001, 0.008, 2000)
    spec = load_lidar("turtlebot3_lds_02")
    _, error, _ = errors(spec, Polygon(points=tuple(map(tuple, corners))), gap, rng)
    assert np.sqrt(np.mean(error**2)) <= BAR
