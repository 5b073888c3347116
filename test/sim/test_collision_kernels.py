from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest
from shapely import affinity, geometry

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


def solid(shape, pose):
    """A shape at a pose (3,) as shapely knows it; a circle is its centre."""
    if isinstance(shape, Circle):
        return geometry.Point(pose[0], pose[1])
    outline = shape.outline
    plain = (
        geometry.LineString(outline) if len(outline) == 2 else geometry.Polygon(outline)
    )
    turned = affinity.rotate(plain, pose[2], origin=(0, 0), use_radians=True)
    return affinity.translate(turned, pose[0], pose[1])


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
        expected = solid(SHAPES[one], a).distance(solid(SHAPES[other], b))
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


@pytest.mark.slow
@pytest.mark.parametrize("one", range(len(SHAPES) - 1))
@pytest.mark.parametrize("other", range(len(SHAPES)))
def test_who_comes_in_gets_deeper_and_who_leaves_gets_less_deep(one, other):
    rng = np.random.default_rng(one)
    for _ in range(60):
        a = rng.uniform(-3.0, 3.0, 3)
        heading = rng.uniform(-np.pi, np.pi)
        way = np.array([np.cos(heading), np.sin(heading), 0.0])
        far = 3.0
        near = 0.0
        for _ in range(50):  # where it begins to touch
            middle = 0.5 * (far + near)
            apart = gap(body(one, middle * way), body(other, [0.0, 0.0, a[2]])) > 0.0
            far, near = (middle, near) if apart else (far, middle)
        depths = [
            gap(body(one, (far - 1e-3 * step) * way), body(other, [0.0, 0.0, a[2]]))
            for step in (1, 2, 3)
        ]
        if depths[0] < 0.0 and depths[1] < 0.0:
            assert depths[1] <= depths[0] + 1e-12
        assert depths[0] > -0.02


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
        expected = solid(SHAPES[index], pose).distance(line) - radius(SHAPES[index])
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
    squares = []
    for row, column in np.argwhere(cells > 0):
        x = 0.3 * column
        y = 0.3 * row
        corners = np.array([(x, y), (x + 0.3, y), (x + 0.3, y + 0.3), (x, y + 0.3)])
        c = np.cos(0.4)
        s = np.sin(0.4)
        squares.append(geometry.Polygon(corners @ [[c, s], [-s, c]] + (-1.0, -2.0)))
    known = map_field(grid)
    overlaps = 0
    for _ in range(150):
        pose = rng.uniform(-3.0, 4.0, 3)
        shape = solid(SHAPES[index], pose)
        expected = min(shape.distance(square) for square in squares) - radius(
            SHAPES[index]
        )
        there = body(index, pose)
        found = kernels.map_gap(there, known, ARRAYS, np.inf, SPARE)
        at_once = kernels.map_gap(there, known, ARRAYS, 0.0, SPARE)
        assert kernels.map_bound(there, known) <= max(expected, 0.0) + 1e-6
        if expected > 0.0:
            assert found == pytest.approx(expected, abs=1e-6)
            assert at_once == 0.0
        else:
            overlaps += 1
            assert found < 0.0
            assert at_once < 0.0
    assert overlaps >= 4


def test_where_there_is_no_map_nothing_is_near():
    there = body(0, [0.0, 0.0, 0.0])
    assert kernels.map_bound(there, NO_FIELD) == np.inf
    assert kernels.map_gap(there, NO_FIELD, ARRAYS, 1.0, SPARE) == 1.0
