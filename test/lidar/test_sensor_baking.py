from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.lidar.bake import bake, with_shapes
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.sensor_models import IncidenceDropout, Intensity
from nics_drl_bridge.lidar.shapes import SQUARE, STRIP, Circle
from nics_drl_bridge.lidar.table import Density, LidarTable

SPEC = lidar(beams=720, range_min=0.0)
SMALL = Density(distances=12, rotations=16)
BRIGHT = Intensity(gain=2.0, reflectivity=0.4)
HERE = np.zeros((1, 3))


def ahead(table, shape, distance, walls=()):
    """The scan of one shape straight ahead."""
    scanner = Scanner(SPEC, table, "baked")
    return scanner.scan(HERE, scanner.place([shape], [[distance, 0.0, 0.0]]), walls)[0]


@pytest.mark.parametrize("greatest", [0.5, 1.0, 1.4])
def test_of_a_circle_that_part_returns_which_is_met_steeply_enough(greatest):
    shape = Circle(radius=0.3)
    table = bake(
        SPEC, [shape], sensor_model=[IncidenceDropout(greatest_incidence=greatest)]
    )
    for distance in (0.8, 1.23, 2.0):
        seen = np.isfinite(ahead(table, shape, distance))
        # A ray at angle a passes the centre at distance * sin(a) = radius * sin(incidence).
        edge = np.arcsin(shape.radius * np.sin(greatest) / distance)
        off = seen != (np.abs(SPEC.angles) < edge)
        assert (
            np.abs(np.abs(SPEC.angles[off]) - edge) < 1.5 * SPEC.angle_increment
        ).all()
        assert seen.sum() > 10


def test_a_dark_surface_returns_from_near_and_a_bright_one_from_afar():
    model = Intensity(gain=1.0, threshold=0.1)
    dark, bright = (Circle(radius=0.2, reflectivity=white) for white in (0.1, 0.8))
    table = bake(SPEC, [dark, bright], sensor_model=[model])
    behind = [[2.9, -2.0, 2.9, 2.0]]
    middle = np.argmin(np.abs(SPEC.angles))
    for shape, farthest in ((dark, 1.0), (bright, 8.0**0.5)):
        for gap in (0.9, 1.1, 2.6, 2.85):
            value = ahead(table, shape, gap + shape.radius, behind)[middle]
            lost = gap > farthest
            assert value == pytest.approx(2.9 if lost else gap, abs=0.01), (shape, gap)


def test_two_models_together_lose_what_either_loses():
    grazing = IncidenceDropout(greatest_incidence=0.6)
    dim = Intensity(threshold=0.1)
    rows = [
        bake(SPEC, [SQUARE], SMALL, model).rows
        for model in ((), (grazing,), (dim,), (grazing, dim))
    ]
    lost = [np.isinf(each) for each in rows]
    assert not lost[0].any()
    assert 0 < lost[1].sum() < lost[3].sum()
    assert 0 < lost[2].sum() < lost[3].sum()
    assert np.array_equal(lost[1] | lost[2], lost[3])
    assert np.array_equal(rows[3][~lost[3]], rows[0][~lost[3]])


def test_a_function_and_a_named_model_that_say_the_same_bake_the_same_rows():
    named = bake(SPEC, [STRIP], SMALL, [IncidenceDropout(greatest_incidence=1.0)])
    free = bake(
        SPEC, [STRIP], SMALL, lambda r, incidence: np.where(incidence > 1.0, np.inf, r)
    )
    assert np.array_equal(named.rows, free.rows)
    assert np.isinf(named.rows).any()


def test_the_sensor_model_of_the_lidar_is_baked_unless_another_is_given():
    spec = SPEC.model_copy(update={"sensor_model": (BRIGHT,)})
    assert bake(spec, [SQUARE], SMALL).sensor_model == (BRIGHT,)
    assert bake(spec, [SQUARE], SMALL, ()).sensor_model == ()


def test_shapes_are_added_with_the_sensor_model_of_the_table():
    table = bake(SPEC, [SQUARE], SMALL, [BRIGHT])
    more = with_shapes(SPEC, table, [STRIP])
    assert more.sensor_model == (BRIGHT,)
    assert np.array_equal(more.rows, bake(SPEC, (SQUARE, STRIP), SMALL, [BRIGHT]).rows)


@pytest.mark.parametrize("model", [[BRIGHT], []])
def test_a_table_reads_back_with_its_sensor_model(tmp_path, model):
    table = bake(SPEC, (SQUARE, Circle(radius=0.2, reflectivity=0.9)), SMALL, model)
    table.save(tmp_path / "table")
    back = LidarTable.load(tmp_path / "table")
    assert back.shapes == table.shapes
    assert back.sensor_model == tuple(model)
    assert back.fingerprint == table.fingerprint
