from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation
from shapely import affinity

from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle
from nics_drl_bridge.sim.sections import (
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
    shape, (x, y, heading) = placed
    turned = affinity.rotate(
        shapely.Polygon(shape.outline), heading, (0.0, 0.0), use_radians=True
    )
    return affinity.translate(turned, x, y)


def same_area(one, other):
    return one.symmetric_difference(other).area == pytest.approx(0.0, abs=1e-5)


def test_an_upright_cylinder_is_a_circle_between_its_ends_alone():
    pose = at(1.0, 2.0, 0.5)
    assert section(Cylinder(0.3, 1.0), pose, 0.9) == (
        Circle(radius=0.3),
        (1.0, 2.0, 0.0),
    )
    assert section(Cylinder(0.3, 1.0), pose, 1.01) is None
    assert section(Cylinder(0.3, 1.0), pose, -0.01) is None


def test_a_cylinder_on_its_side_is_a_rectangle_as_wide_as_the_height_has_it():
    lying = at(1.0, 2.0, 0.3, pitch=math.pi / 2.0, yaw=0.4)
    shape, (x, y, heading) = section(Cylinder(0.3, 2.0), lying, 0.3)
    assert shape.size == pytest.approx((2.0, 0.6))
    assert (x, y, math.tan(heading)) == pytest.approx(
        (1.0, 2.0, math.tan(0.4)), abs=1e-6
    )
    higher = section(Cylinder(0.3, 2.0), lying, 0.48)[0]
    assert higher.size == pytest.approx(
        (2.0, 0.48)
    )  # 0.18 m up: 2 sqrt(0.3^2 - 0.18^2)
    assert section(Cylinder(0.3, 2.0), lying, 0.61) is None


def test_a_sphere_is_the_circle_that_the_height_cuts():
    ball = section(Sphere(0.5), at(1.0, 1.0, 0.5), 0.2)
    assert ball == (Circle(radius=0.4), (1.0, 1.0, 0.0))
    assert section(Sphere(0.5), at(z=0.5), 1.1) is None


def test_a_capsule_is_round_and_narrower_at_its_ends():
    upright = at(z=1.0)
    assert section(Capsule(0.5, 1.0), upright, 1.4)[0] == Circle(radius=0.5)
    assert section(Capsule(0.5, 1.0), upright, 1.8)[0] == Circle(radius=0.4)
    assert section(Capsule(0.5, 1.0), upright, 2.1) is None


@pytest.mark.parametrize(
    ("turn", "size"),
    [
        ({}, (1.0, 2.0)),
        ({"yaw": 0.7}, (1.0, 2.0)),
        ({"roll": math.pi / 2.0}, (1.0, 3.0)),
        ({"pitch": math.pi / 2.0, "yaw": 0.2}, (3.0, 2.0)),
        ({"roll": math.pi}, (1.0, 2.0)),
    ],
)
def test_a_box_on_any_of_its_sides_is_a_rectangle(turn, size):
    placed = section(Box((1.0, 2.0, 3.0)), at(5.0, 1.0, 0.2, **turn), 0.1)
    assert isinstance(placed[0], Rectangle)
    x = size[0] / 2.0
    y = size[1] / 2.0
    expected = affinity.rotate(
        shapely.box(-x, -y, x, y), turn.get("yaw", 0.0), (0, 0), use_radians=True
    )
    assert same_area(drawn(placed), affinity.translate(expected, 5.0, 1.0))


def test_a_box_that_leans_is_the_polygon_that_the_height_cuts():
    rng = np.random.default_rng(0)
    cut = 0
    for _ in range(20):
        size = rng.uniform(0.5, 2.0, 3)
        height = rng.uniform(-0.5, 0.5)
        pose = at(1.0, -2.0, 0.0, *rng.uniform(-3.0, 3.0, 3))
        placed = section(Box(tuple(size)), pose, height)
        # Points of the plane, and whether they lie in the box.
        points = np.column_stack(
            [rng.uniform(-2.0, 2.0, (2000, 2)), np.full(2000, height)]
        )
        own = np.abs(points @ pose[:3, :3]) - size / 2.0
        points = points[:, :2] + (1.0, -2.0)
        inside = (own < 0.0).all(axis=1)
        clear = np.abs(own.max(axis=1)) > 1e-4
        outline = shapely.Polygon() if placed is None else drawn(placed)
        found = shapely.contains_xy(outline, points)
        assert np.array_equal(found[clear], inside[clear])
        cut += isinstance(placed and placed[0], Polygon)
    assert cut > 15


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
    with pytest.raises(ShapelessError, match="leans"):
        section(solid, at(pitch=0.3), 0.0)


def test_a_thousandth_of_a_radian_is_upright():
    assert section(Cylinder(0.1, 1.0), at(pitch=9e-4), 0.0)[0] == Circle(radius=0.1)
    assert section(Box((1.0, 2.0, 1.0)), at(roll=9e-4), 0.0)[0] == Rectangle(
        size=(1.0, 2.0)
    )


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
