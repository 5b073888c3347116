from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import npz_bytes
from nics_drl_bridge.lidar.table import FINE, LidarTable, bake


@pytest.fixture(scope="module")
def table():
    return bake(lidar(beams=90), (0.25, 0.1), distances=20)


def test_radii_ascend_and_stand_once():
    assert bake(lidar(), (0.4, 0.1, 0.4), distances=3).radii.tolist() == [0.1, 0.4]


def test_a_row_holds_the_exact_ranges_of_a_circle_straight_ahead(table):
    spec = lidar(beams=90)
    step = spec.angle_increment / FINE
    for h, radius in enumerate(table.radii):
        for d in (1, 7, 19):
            distance = table.grid[h, 0] + d * table.grid[h, 1]
            row = table.rows[table.start[h, d] : table.start[h, d + 1]]
            angle = (table.first[h, d] + np.arange(len(row))) * step
            across = distance * np.sin(angle)
            assert row == pytest.approx(
                distance * np.cos(angle) - np.sqrt(radius**2 - across**2), abs=1e-3
            )
            assert len(row) == 2 * int(np.arcsin(radius / distance) / step) + 1


def test_rows_reach_from_touching_the_circle_to_out_of_range(table):
    for h, radius in enumerate(table.radii):
        nearest, step, count = table.grid[h]
        assert nearest == radius
        assert nearest + step * (count - 1) == pytest.approx(3.0 + radius)


def test_a_table_reads_back_to_the_same_bits(table):
    data = table.dump()
    back = LidarTable.parse(data, "table.npz")
    for name, array in vars(table).items():
        assert np.array_equal(getattr(back, name), array)
        assert getattr(back, name).dtype == array.dtype
    assert back.dump() == data
    assert bake(lidar(beams=90), (0.1, 0.25), distances=20).dump() == data


def test_memory_is_the_sum_of_the_arrays(table):
    assert table.memory == sum(array.nbytes for array in vars(table).values())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no table",
        npz_bytes({"radii": np.zeros(1)}),
        npz_bytes({"nonsense": np.zeros(1)}),
    ],
)
def test_what_is_no_table_is_refused_with_the_files_name(data):
    with pytest.raises(ModelError, match=r"^here\.npz: is no lidar table \("):
        LidarTable.parse(data, "here.npz")


def test_a_damaged_table_is_refused_or_reads_as_it_was(table):
    content = table.dump()
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(200):
        damaged = bytearray(content)
        if trial < 40:
            damaged = damaged[: rng.integers(len(content))]
        else:
            damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        try:
            back = LidarTable.parse(bytes(damaged), "table.npz")
        except ModelError:
            refused += 1
        else:
            assert np.array_equal(back.rows, table.rows)
    assert refused > 120


def test_a_radius_is_found_within_rounding_only(table):
    assert table.shape_of(0.25 + 1e-12) == 1
    with pytest.raises(ModelError, match="generate the model for this world"):
        table.shape_of(0.2501)
