from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest
from lidar_scenes import solid_of
from shapely import geometry

from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import (
    Circle,
    Outlines,
    Polygon,
    Rectangle,
    Segment,
    place,
)
from nics_drl_bridge.sim import collision_kernels as kernels
from nics_drl_bridge.sim.allocation import map_field
from nics_drl_bridge.sim.state import NO_FIELD

L = Polygon(points=((0, 0), (1, 0), (1, 0.3), (0.3, 0.3), (0.3, 1), (0, 1)))
FORK = Polygon(
    points=(
        (0.3, 0.2),
        (-0.2, 0.2),
        (-0.2, -0.2),
        (0.3, -0.2),
        (0.3, -0.1),
        (0, -0.1),
        (0, 0.1),
        (0.3, 0.1),
    )
)
WEDGE = Polygon(points=((0.3, 0.0), (-0.2, 0.2), (-0.2, -0.2)))
SHAPES = (
    Circle(radius=0.3),
    Rectangle(size=(0.6, 0.2)),
    L,
    FORK,
    WEDGE,
    Segment(ends=((-0.4, 0.1), (0.5, 0.0))),
)
OUTLINES = Outlines.of(SHAPES)
ARRAYS = OutlineArrays(*OUTLINES.arguments)
SPARE = np.zeros((16, 2))


def radius(shape):
    return shape.radius if isinstance(shape, Circle) else 0.0


def body(index, pose):
    return place(pose, OUTLINES.radii[index], index)


def gap(one, other, limit=np.inf):
    return kernels.body_gap(one, other, ARRAYS, limit, SPARE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("one", "other"), combinations_with_replacement(range(len(SHAPES)), 2)
)
def test_the_clearance_of_two_bodies_is_that_of_shapely(one, other):
    rng = np.random.default_rng(10 * one + other)
    lines = isinstance(SHAPES[one], Segment) and isinstance(SHAPES[other], Segment)
    overlaps = 0
    for _ in range(150):
        a, b = (rng.uniform(-0.8, 0.8, 3) * [1.0, 1.0, 4.0] for _ in range(2))
        expected = solid_of(SHAPES[one], a).distance(solid_of(SHAPES[other], b))
        expected -= radius(SHAPES[one]) + radius(SHAPES[other])
        found = gap(body(one, a), body(other, b))
        assert found == pytest.approx(gap(body(other, b), body(one, a)), abs=1e-9)
        at_once = gap(body(one, a), body(other, b), 0.0)
        if expected > 0.0 or lines:
            assert found == pytest.approx(expected, abs=1e-9)
            assert at_once == 0.0
        else:
            overlaps += 1
            assert found < 0.0
            assert at_once == pytest.approx(found, abs=1e-9)
    assert overlaps > 8 or lines


def test_bodies_that_share_the_lines_of_their_edges_overlap():
    one = body(1, [0.0, 0.0, 0.0])
    other = body(1, [0.5, 0.0, 0.0])
    assert gap(one, other) < -0.01
    assert gap(one, body(1, [0.6 + 1e-6, 0.0, 0.0])) > 0.0


@pytest.mark.parametrize("index", range(len(SHAPES)))
def test_the_clearance_to_a_straight_wall_is_that_of_shapely(index):
    rng = np.random.default_rng(index)
    for _ in range(150):
        pose = rng.uniform(-0.8, 0.8, 3) * [1.0, 1.0, 4.0]
        wall = rng.uniform(-1.0, 1.0, 4)
        line = geometry.LineString([wall[:2], wall[2:]])
        expected = solid_of(SHAPES[index], pose).distance(line) - radius(SHAPES[index])
        found = kernels.wall_gap(body(index, pose), wall, ARRAYS, np.inf, SPARE)
        if expected > 0.0 or isinstance(SHAPES[index], Segment):
            assert found == pytest.approx(expected, abs=1e-9)
        else:
            assert found < 0.0


@pytest.mark.parametrize("index", range(len(SHAPES) - 1))
def test_the_clearance_to_a_map_is_that_of_shapely(index):
    rng = np.random.default_rng(index)
    cells = np.where(rng.random((12, 15)) < 0.12, 100, 0).astype(np.int8)
    grid = GridMap(cells, 0.3, (-1.0, -2.0, 0.4))
    square = Rectangle(size=(0.3, 0.3))
    centres = grid.cell_to_world(np.argwhere(cells > 0))
    squares = geometry.MultiPolygon([solid_of(square, [x, y, 0.4]) for x, y in centres])
    known = map_field(grid)
    overlaps = 0
    for _ in range(150):
        pose = rng.uniform(-3.0, 4.0, 3)
        expected = solid_of(SHAPES[index], pose).distance(squares)
        expected -= radius(SHAPES[index])
        there = body(index, pose)
        found, at_once = (
            kernels.map_gap(there, known, ARRAYS, limit, SPARE)
            for limit in (np.inf, 0.0)
        )
        assert kernels.map_bound(there, known) <= max(expected, 0.0) + 1e-6
        if expected > 0.0:
            assert found == pytest.approx(expected, abs=1e-6)
            assert at_once == 0.0
        else:
            overlaps += 1
            assert max(found, at_once) < 0.0
    assert overlaps >= 4


def test_where_there_is_no_map_nothing_is_near():
    there = body(0, [0.0, 0.0, 0.0])
    assert kernels.map_bound(there, NO_FIELD) == np.inf
    assert kernels.map_gap(there, NO_FIELD, ARRAYS, 1.0, SPARE) == 1.0
