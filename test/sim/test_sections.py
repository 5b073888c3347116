from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from lidar_scenes import solid_of
from scipy.spatial.transform import Rotation
from shapely import affinity

from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle
from nics_drl_bridge.sim.sdf import (
    Box,
    Capsule,
    Cylinder,
    Prism,
    ShapelessError,
    Sphere,
    Standing,
    section,
)

L = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))


def at(x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


def drawn(placed):
    """The outline of a placed shape in the world."""
    shape, pose = placed
    return solid_of(shape, np.array(pose))


def same_area(one, other):
    return one.symmetric_difference(other).area == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("solid", "height", "radius"),
    [
        (Cylinder(0.3, 1.0), 1.4, 0.3),
        (Cylinder(0.3, 1.0), 1.51, None),
        (Cylinder(0.3, 1.0), 0.49, None),
        (Sphere(0.5), 0.7, 0.4),
        (Sphere(0.5), 1.6, None),
        (Capsule(0.5, 1.0), 1.4, 0.5),
        (Capsule(0.5, 1.0), 1.8, 0.4),
        (Capsule(0.5, 1.0), 2.1, None),
    ],
)
def test_what_is_round_and_upright_is_a_circle_between_its_ends(solid, height, radius):
    placed = section(solid, at(1.0, 2.0, 1.0, pitch=9e-4), height)
    expected = radius and (Circle(radius=radius), (1.0, 2.0, 0.0))
    assert placed == expected


def test_a_cylinder_on_its_side_is_a_rectangle_as_wide_as_the_height_has_it():
    lying = at(1.0, 2.0, 0.3, pitch=math.pi / 2.0, yaw=0.4)
    shape, (x, y, heading) = section(Cylinder(0.3, 2.0), lying, 0.48)
    assert shape.size == pytest.approx((2.0, 0.48))  # 0.18 m above its axis
    assert (x, y, math.tan(heading)) == pytest.approx((1.0, 2.0, math.tan(0.4)))
    assert section(Cylinder(0.3, 2.0), lying, 0.61) is None


QUARTER = math.pi / 2.0
UPRIGHT = [(0, 0, 0), (0, 0, 0.7), (QUARTER, 0, 0), (0, QUARTER, 0.2), (math.pi, 0, 0)]


def test_a_box_is_the_rectangle_or_where_it_leans_the_polygon_that_the_height_cuts():
    rng = np.random.default_rng(0)
    cut = 0
    for turn in [*UPRIGHT, *rng.uniform(-3.0, 3.0, (20, 3))]:
        size = rng.uniform(0.5, 2.0, 3)
        height = rng.uniform(-0.4, 0.4)
        pose = at(1.0, -2.0, 0.0, *turn)
        placed = section(Box(tuple(size)), pose, height)
        # Points of the plane, and whether they lie in the box.
        plane = rng.uniform(-2.0, 2.0, (2000, 2))
        points = np.column_stack([plane, np.full(2000, height)])
        own = (np.abs(points @ pose[:3, :3]) - size / 2.0).max(axis=1)
        outline = shapely.Polygon() if placed is None else drawn(placed)
        found = shapely.contains_xy(outline, plane + np.array([1.0, -2.0]))
        clear = np.abs(own) > 1e-4
        assert np.array_equal(found[clear], own[clear] < 0.0)
        kind = Rectangle if tuple(turn) in UPRIGHT else Polygon
        cut += isinstance(placed and placed[0], kind)
    assert cut > 18


def test_a_polyline_stands_on_its_own_ground_and_may_hang_upside_down():
    placed = section(Prism(L, 1.0), at(1.0, 1.0, 0.1, yaw=0.5), 0.2)
    turned = affinity.rotate(shapely.Polygon(L), 0.5, (0, 0), use_radians=True)
    assert same_area(drawn(placed), affinity.translate(turned, 1.0, 1.0))
    assert section(Prism(L, 1.0), at(z=0.3), 0.2) is None
    hanging = section(Prism(L, 1.0), at(z=1.0, roll=math.pi), 0.2)
    assert same_area(
        drawn(hanging), affinity.scale(shapely.Polygon(L), 1, -1, origin=(0, 0))
    )
    assert section(Prism(L, 1.0), at(z=1.0, roll=math.pi), 1.2) is None


@pytest.mark.parametrize(
    "solid", [Cylinder(0.1, 1.0), Capsule(0.1, 1.0), Prism(L, 1.0)]
)
def test_what_leans_and_is_round_or_has_an_outline_has_no_shape(solid):
    with pytest.raises(ShapelessError, match="tilted"):
        section(solid, at(pitch=0.3), 0.0)


def test_equal_shapes_are_one_group_and_the_bounds_hold_all_and_room_around_places():
    disc = Circle(radius=0.5)
    bar = Rectangle(size=(2.0, 0.2))
    placed = (
        (disc, (0.0, 0.0, 0.0)),
        (bar, (4.0, 0.0, math.pi / 2.0)),
        (disc, (1.0, 1.0, 0.0)),
    )
    standing = Standing(placed, ())
    assert [len(group.at) for group in standing.obstacles] == [2, 1]
    assert standing.bounds() == pytest.approx((-0.5, -1.0, 4.1, 1.5))
    assert standing.bounds((9.0, 0.0, 1.57)) == pytest.approx((-0.5, -1.0, 10.0, 1.5))
