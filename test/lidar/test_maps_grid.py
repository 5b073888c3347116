from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import shapely

from nics_drl_bridge.lidar.maps import OCCUPIED, GridMap

TURNED = (1.0, -2.0, 0.7)


def grid(rows, **changes):
    """A map from its picture: the last line is row 0."""
    values = {".": 0, "#": 100, "?": -1, "5": 50}
    cells = np.array(
        [[values[letter] for letter in line] for line in rows[::-1]], np.int8
    )
    return GridMap(cells, **{"resolution": 0.5} | changes)


def test_row_0_is_the_lowest_and_the_origin_is_its_outer_corner():
    room = grid(["..", ".#", ".."], origin=(10.0, 20.0, 0.0))
    assert room.blocked[1, 1]
    assert list(room.cell_to_world([1, 1])) == [10.75, 20.75]
    assert list(room.world_to_cell([10.99, 20.51])) == [1, 1]


def test_a_turned_origin_turns_the_map_about_its_corner():
    quarter = grid([".."], origin=(1.0, 2.0, np.pi / 2.0))
    assert quarter.cell_to_world([0, 1]) == pytest.approx([0.75, 2.75])
    assert list(quarter.world_to_cell([0.75, 2.75])) == [0, 1]


def test_cells_come_back_from_their_centres():
    cells = np.argwhere(np.ones((7, 5)))
    turned = GridMap(np.zeros((7, 5), np.int8), 0.05, TURNED)
    assert (turned.world_to_cell(turned.cell_to_world(cells)) == cells).all()
    assert turned.world_to_cell(turned.cell_to_world([-1, 9])).tolist() == [-1, 9]


def test_what_is_unknown_stops_beams_when_asked():
    picture = [".?5#"]
    assert grid(picture).blocked.tolist() == [[False, False, False, True]]
    assert grid(picture, unknown_stops=True).blocked.tolist() == [
        [False, True, True, True]
    ]
    assert grid(picture).free.tolist() == [[True, False, False, False]]


def test_the_distance_field_is_the_distance_to_the_nearest_square():
    rng = np.random.default_rng(0)
    for chance in (0.02, 0.3):
        cells = (rng.random((20, 30)) < chance).astype(np.int8) * np.int8(100)
        room = GridMap(cells, 0.05)
        low = np.argwhere(room.blocked)[:, ::-1] * 0.05
        squares = shapely.union_all(shapely.box(*low.T, *(low + 0.05).T))
        centres = shapely.points(
            GridMap(cells, 0.05).cell_to_world(np.argwhere(cells > -9))
        )
        expected = shapely.distance(squares, centres).reshape(cells.shape)
        assert room.distance_field == pytest.approx(expected, abs=1e-6)


def test_the_distance_field_of_a_large_map_takes_few_bytes_for_a_cell():
    """A few kilobytes of PNG hold millions of cells, whose distances the first scene needs."""
    side = 1000
    cells = np.zeros((side, side), np.int8)
    cells[::97, ::83] = OCCUPIED
    large = GridMap(cells, 0.05)
    tracemalloc.start()
    try:
        distances = large.distance_field
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert distances.shape == (side, side)
    assert peak < 60 * side**2, f"{peak / side**2:.1f} bytes for a cell"
