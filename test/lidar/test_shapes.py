from __future__ import annotations

import numpy as np
import pytest
import shapely
from lidar_scenes import POLYGONS, random_shapes
from pydantic import ValidationError

from nics_drl_bridge.lidar.shapes import (
    SQUARE,
    STRIP,
    Circle,
    Polygon,
    Rectangle,
    Segment,
    describe,
    find_convex_hull,
    find_rotational_order,
)
from nics_drl_bridge.sim.world import Obstacles


def regular(corners, reach=0.3, shift=0.0):
    angles = np.arange(corners) * 2.0 * np.pi / corners + 0.3
    return Polygon(
        points=reach * np.stack([np.cos(angles), np.sin(angles)], axis=1) + shift
    )


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (Circle, {"radius": 0.0}),
        (Circle, {"radius": 1e17}),
        (Rectangle, {"size": (0.3, 0.0)}),
        (Segment, {"ends": ((0.1, 0.2), (0.1, 0.2))}),
        (Polygon, {"points": ((0, 0), (1, 0), (0, 0), (1, 0))}),
        (Polygon, {"points": ((0, 0), (1, 0), (float("nan"), 1))}),
    ],
)
def test_a_shape_without_extent_is_refused(kind, values):
    with pytest.raises(ValidationError):
        kind(**values)


def test_outlines_run_counter_clockwise_whichever_way_they_were_given():
    points = ((0.0, 0.0), (0.4, 0.0), (0.3, 0.2))
    for given in (points, points[::-1]):
        assert shapely.LinearRing(Polygon(points=given).outline).is_ccw


@pytest.mark.parametrize("make", POLYGONS)
def test_hulls_are_those_of_plane_geometry(make):
    for corners in (3, 10, 100):
        outline = make(np.random.default_rng(corners), corners).outline
        hull = find_convex_hull(outline)
        expected = shapely.MultiPoint(outline).convex_hull
        assert shapely.Polygon(hull).symmetric_difference(expected).area < 1e-12
        assert shapely.LinearRing(hull).is_ccw
        assert len(hull) <= len(outline)


def test_a_hull_has_no_corner_on_its_edges_and_of_a_line_only_the_ends():
    square = np.array([(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (0, 2), (0, 1)], float)
    assert len(find_convex_hull(square)) == 4
    assert find_convex_hull(np.array([(0, 0), (3, 3), (1, 1)], float)).tolist() == [
        [0, 0],
        [3, 3],
    ]


@pytest.mark.parametrize(
    ("shape", "order"),
    [
        (SQUARE, 4),
        (STRIP, 2),
        (regular(5), 5),
        (regular(5, shift=0.01), 1),
        (Segment(ends=((0.0, 0.0), (1.0, 0.0))), 1),
        (Circle(radius=0.2), 1),
        (Polygon(points=((0.2, 0.2), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2))), 2),
    ],
)
def test_how_often_a_shape_looks_the_same_in_a_turn(shape, order):
    outline = shape.outline
    hull = find_convex_hull(outline) if len(outline) else outline
    assert order % find_rotational_order(outline, hull) == 0
    if order > 2 or shape is STRIP:
        assert find_rotational_order(outline, hull) == order


def test_every_shape_is_read_back_from_plain_data_and_has_a_description():
    shapes = random_shapes(0)
    plain = Obstacles(shapes=shapes, count=1).model_dump(mode="json")
    assert Obstacles.model_validate(plain).shapes == shapes
    assert describe(Segment(ends=((0.0, 0.0), (3.0, 4.0)))) == "segment of 5 m"
    assert len({describe(shape) for shape in shapes}) > 7
