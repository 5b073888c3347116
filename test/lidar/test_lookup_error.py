"""What `auto` looks up is right within 1 cm, by rays that are cast here."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from nics_drl_bridge.geometry import rotate
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle, Segment
from nics_drl_bridge.lidar.spec import load_lidar

BAR = 0.01
BANDS = (0.0, 0.1, 0.3, 0.6, 1.0, 2.0, 4.0, 8.0, 16.0)
FEWEST = 2000
"""Beams that a band must have for its error to say something."""


def cast(shape, poses, directions, high):
    """(N, B) ranges from the origin to a shape at poses (N, 3); inf beyond `high`."""
    ranges = np.full((len(poses), len(directions)), np.inf)
    for n, pose in enumerate(poses):
        if shape.kind == "circle":
            along = directions @ pose[:2]
            inside = shape.radius**2 - pose[:2] @ pose[:2] + along**2
            hit = along - np.sqrt(np.where(inside >= 0.0, inside, np.nan))
            ranges[n] = np.where((inside >= 0.0) & (hit > 0.0), hit, np.inf)
            continue
        corners = rotate(np.asarray(shape.outline), pose[2]) + pose[:2]
        a, b = (
            (corners[:1], corners[1:])
            if len(corners) == 2
            else (
                corners,
                np.roll(corners, -1, axis=0),
            )
        )
        e = b - a
        cross = directions[:, :1] * e[:, 1] - directions[:, 1:] * e[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
            along = (a[:, 0] * directions[:, 1:] - a[:, 1] * directions[:, :1]) / cross
        hit = (far > 0.0) & (along >= 0.0) & (along <= 1.0)
        ranges[n] = np.where(hit, far, np.inf).min(axis=1)
    return np.where(ranges <= high, ranges, np.inf)


def shapes_of(rng):
    """Segments, strips, needles, polygons and circles of random sizes."""
    length = 10.0 ** rng.uniform(-1.0, 0.7)
    corners = np.sort(rng.uniform(-np.pi, np.pi, rng.integers(3, 8)))
    star = rng.uniform(0.1, 0.6, len(corners))[:, None] * np.stack(
        [np.cos(corners), np.sin(corners)], axis=1
    )
    return [
        Segment(ends=((-length / 2.0, 0.0), (length / 2.0, 0.0))),
        Rectangle(
            size=(10.0 ** rng.uniform(-1.0, 0.4), 10.0 ** rng.uniform(-2.3, -1.0))
        ),
        Polygon(
            points=(
                (0.0, 0.0),
                (rng.uniform(0.2, 2.0), 0.02),
                (rng.uniform(0.1, 0.2), 0.05),
            )
        ),
        Polygon(points=tuple(map(tuple, star))),
        Circle(radius=10.0 ** rng.uniform(-1.3, 0.3)),
    ]


def places(shape, high, number, rng):
    """Poses from touching on to out of range: half of them near."""
    gap = np.concatenate(
        [
            10.0 ** rng.uniform(-3.0, np.log10(high), number // 2),
            rng.uniform(0.0, high, number // 2),
        ]
    )
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, len(gap)))
    away = shape.radius + gap
    return gap, np.stack(
        [away * np.cos(bearing), away * np.sin(bearing), heading], axis=1
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "paper",
        "hokuyo_ust_10lx",
        pytest.param("paper_12m", marks=pytest.mark.campaign),
        pytest.param("rplidar_a1", marks=pytest.mark.campaign),
    ],
)
@pytest.mark.timeout(600)  # a cold start compiles
def test_auto_is_right_within_a_centimetre_in_every_band_for_every_shape(name):
    spec = load_lidar(name)
    rng = np.random.default_rng(11)
    looked_up = 0
    for _ in range(3):
        for shape in shapes_of(rng):
            scanner = make_scanner(spec, [shape])
            gap, poses = places(shape, spec.range_max, 800, rng)
            found = scanner.scan(
                np.zeros((len(poses), 3)), scanner.place([shape], poses[:, None])
            )
            true = cast(shape, poses, spec.directions, spec.range_max)
            both = np.isfinite(found) & np.isfinite(true)
            error = np.where(both, found, 0.0) - np.where(both, true, 0.0)
            looked_up += (np.abs(error) > 1e-4).any()
            by_place = np.repeat(gap[:, None], spec.beams, axis=1)
            for which in (true, by_place):
                for low, high in itertools.pairwise(BANDS):
                    chosen = both & (which >= low) & (which < high)
                    if chosen.sum() >= FEWEST:
                        rmse = float(np.sqrt(np.mean(error[chosen] ** 2)))
                        assert rmse <= BAR, (shape, low, high, rmse)
    assert looked_up >= 5


def test_a_long_segment_near_the_lidar_is_scanned_exactly():
    spec = load_lidar("paper")
    shape = Segment(ends=((-1.0, 0.0), (1.0, 0.0)))
    scanner = make_scanner(spec, [shape])
    rng = np.random.default_rng(1)
    _, poses = places(shape, 3.0, 2000, rng)
    found = scanner.scan(
        np.zeros((len(poses), 3)), scanner.place([shape], poses[:, None])
    )
    true = cast(shape, poses, spec.directions, spec.range_max)
    both = np.isfinite(found) & np.isfinite(true)
    assert np.abs(found[both] - true[both]).max() < 1e-4


@pytest.mark.slow
def test_a_star_that_the_lidar_all_but_touches_is_right_where_few_places_err():
    corners = np.arange(6) * np.pi / 3.0
    star = np.where(np.arange(6) % 2, 0.176, 0.402)[:, None] * np.stack(
        [np.cos(corners), np.sin(corners)], axis=1
    )
    spec = load_lidar("turtlebot3_lds_02")
    shape = Polygon(points=tuple(map(tuple, star)))
    scanner = make_scanner(spec, [shape])
    rng = np.random.default_rng(2)
    away = shape.radius + rng.uniform(0.001, 0.008, 4000)
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, len(away)))
    poses = np.stack([away * np.cos(bearing), away * np.sin(bearing), heading], axis=1)
    found = scanner.scan(
        np.zeros((len(poses), 3)), scanner.place([shape], poses[:, None])
    )
    true = cast(shape, poses, spec.directions, spec.range_max)
    both = np.isfinite(found) & np.isfinite(true)
    assert np.sqrt(np.mean((found[both] - true[both]) ** 2)) <= BAR
