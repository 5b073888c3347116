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
from nics_drl_bridge.sim.simulator import map_field
from nics_drl_bridge.sim.state import NO_FIELD, allocate_touches

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
LISTED = allocate_touches()


def radius(shape):
    return shape.radius if isinstance(shape, Circle) else 0.0


def body(index, pose):
    return place(pose, OUTLINES.radii[index], index)


def solid(index, pose):
    return kernels.solid_of(0, body(index, pose), ARRAYS)


def gap(one, other, limit=np.inf):
    pair = (kernels.solid_of(0, body, ARRAYS) for body in (one, other))
    return kernels.find_gap(*pair, limit, 0.0, LISTED)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("one", "other"), combinations_with_replacement(range(len(SHAPES)), 2)
)
def test_the_clearance_of_two_bodies_is_that_of_shapely(one, other):
    rng = np.random.default_rng(10 * one + other)
    overlaps = 0
    for _ in range(100):
        a, b = (rng.uniform(-0.8, 0.8, 3) * [1.0, 1.0, 4.0] for _ in range(2))
        expected = solid_of(SHAPES[one], a).distance(solid_of(SHAPES[other], b))
        expected -= radius(SHAPES[one]) + radius(SHAPES[other])
        found = gap(body(one, a), body(other, b))
        at_once = gap(body(one, a), body(other, b), 0.0)
        if expected > 0.0:
            assert found == pytest.approx(expected, abs=1e-9)
            assert found == pytest.approx(gap(body(other, b), body(one, a)), abs=1e-9)
            assert at_once == 0.0
        else:
            overlaps += 1
            assert max(found, at_once) < 0.0
    assert overlaps > 8


def test_bodies_that_share_the_lines_of_their_edges_overlap():
    one = body(1, [0.0, 0.0, 0.0])
    other = body(1, [0.5, 0.0, 0.0])
    assert gap(one, other) < 0.0
    assert gap(one, body(1, [0.6 + 1e-6, 0.0, 0.0])) > 0.0


@pytest.mark.parametrize("index", range(len(SHAPES)))
def test_the_clearance_to_a_straight_wall_is_that_of_shapely(index):
    rng = np.random.default_rng(index)
    for _ in range(150):
        pose = rng.uniform(-0.8, 0.8, 3) * [1.0, 1.0, 4.0]
        wall = rng.uniform(-1.0, 1.0, 4)
        line = geometry.LineString([wall[:2], wall[2:]])
        expected = solid_of(SHAPES[index], pose).distance(line) - radius(SHAPES[index])
        found = kernels.wall_gap(solid(index, pose), wall[None], np.inf, 0.0, LISTED)
        if expected > 0.0:
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
        there = solid(index, pose)
        found, at_once = (
            kernels.map_gap(there, known, limit, 0.0, LISTED) for limit in (np.inf, 0.0)
        )
        assert kernels.map_bound(body(index, pose), known) <= max(expected, 0.0) + 1e-6
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
    solid_there = solid(0, [0.0, 0.0, 0.0])
    assert kernels.map_gap(solid_there, NO_FIELD, 1.0, 0.0, LISTED) == 1.0


@pytest.mark.parametrize("index", range(len(SHAPES) - 1))
def test_touches_are_nearest_points_and_lead_away_from_what_is_touched(index):
    rng = np.random.default_rng(index)
    skin = 0.05
    touches = 0
    for _ in range(60):
        pose = rng.uniform(-0.6, 0.6, 3) * [1.0, 1.0, 4.0]
        wall = np.array([-1.0, -0.5, 1.0, -0.5])
        LISTED.number[0] = 0
        least = kernels.wall_gap(solid(index, pose), wall[None], 1.0, skin, LISTED)
        count = LISTED.number[0]
        listed = LISTED.touches[:count]
        assert (listed["gap"] >= least).all()
        assert (listed["ny"] * (listed["y"] + 0.5) >= 0.0).all()
        assert (count > 0) == (0.0 < least < skin)
        touches += count
    assert touches > 0
