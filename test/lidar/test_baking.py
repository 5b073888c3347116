from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.bake import add_shapes, bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle
from nics_drl_bridge.lidar.table import Density, LidarTable

SPEC = lidar(beams=360, range_min=0.0)
SMALL = Density(distances=12, rotations=16)
HERE = np.zeros((1, 3))


def at_the_grid(table, shape, t, d):
    """The pose of a shape straight ahead at a grid distance and rotation."""
    grid = table.grid[0]
    distance = np.linspace(shape.radius, grid[0], table.density.distances)[d]
    turns = grid[1] * table.outlines.orders[0]
    return np.array(
        [(distance * (1.0 + 1e-6 * (d == 0)), 0.0, t * 2.0 * np.pi / turns)]
    )


@pytest.mark.parametrize("shape", [Circle(radius=0.25), SQUARE, STRIP])
def test_on_the_grid_a_look_up_is_the_exact_scan(shape):
    table = bake(SPEC, [shape], SMALL)
    exact = Scanner(SPEC, table, "exact")
    baked = Scanner(SPEC, table, "baked")
    for t in range(5):
        for d in range(table.density.distances - 1):
            body = exact.place([shape], at_the_grid(table, shape, t, d))
            one = baked.scan(HERE, body)[0]
            other = exact.scan(HERE, body)[0]
            differ = np.isfinite(one) != np.isfinite(other)
            assert (
                differ.sum() <= 2
            )  # only beams that graze a corner, decided by rounding
            both = np.isfinite(one) & np.isfinite(other)
            assert (np.abs(one[both] - other[both]) > 2e-4).sum() <= 2
            assert both.any() or d == 10


def test_equal_shapes_are_baked_once_and_circles_at_one_rotation():
    table = bake(SPEC, (SQUARE, Circle(radius=0.2), SQUARE), SMALL)
    assert table.shapes == (SQUARE, Circle(radius=0.2))
    assert table.grid[:, 1].tolist() == [4.0, 1.0]  # a quarter of 16; none


@pytest.mark.parametrize(
    "make", [partial(bake, density=SMALL), LidarTable.without_rows]
)
def test_shapes_are_added_as_the_others_were(make):
    table = make(SPEC, [SQUARE, SQUARE])
    assert add_shapes(SPEC, table, [SQUARE]) is table
    more = add_shapes(SPEC, table, [STRIP])
    assert more.shapes == (SQUARE, STRIP)
    assert (more.density, more.has_rows) == (table.density, table.has_rows)


def test_a_table_that_no_index_can_reach_is_refused(monkeypatch):
    monkeypatch.setattr("nics_drl_bridge.lidar.bake.MOST_NUMBERS", 1000)
    with pytest.raises(ConfigError, match="is too large; lower `distances`"):
        bake(SPEC, [SQUARE], Density(distances=50, rotations=40))


def test_a_shape_that_covers_more_beams_than_a_row_has_is_refused_with_the_way_out():
    narrow = lidar(beams=100_000, angle_min=-0.5, angle_max=0.7)
    with pytest.raises(
        ConfigError, match=r"radius 0.2 m covers too many beams .* 1.2e-05 rad"
    ):
        bake(narrow, [Circle(radius=0.2)])
