from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.files import write_sums
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.shapes import SQUARE, Circle, Polygon
from nics_drl_bridge.lidar.table import (
    ABOUT_FILE,
    ARRAYS,
    Density,
    LidarTable,
)

SPEC = lidar(beams=90)
TRIANGLE = Polygon(points=((0.0, 0.0), (0.4, 0.0), (0.1, 0.2)))


@pytest.fixture(scope="module")
def table():
    return bake(
        SPEC, (Circle(radius=0.25), SQUARE, TRIANGLE), Density(distances=9, rotations=8)
    )


@pytest.fixture
def folder(table, tmp_path):
    table.save(tmp_path / "table")
    return tmp_path / "table"


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def refused(folder):
    """The one sentence with which a table is refused."""
    with pytest.raises(BridgeError) as caught:
        LidarTable.load(folder)
    sentence = str(caught.value)
    assert sentence.startswith(str(folder))
    assert "\n" not in sentence
    return sentence


def test_a_table_reads_back_to_the_same_bits(table, folder, tmp_path):
    back = LidarTable.load(folder)
    assert (back.shapes, back.density) == (table.shapes, table.density)
    assert back.beam_angle == table.beam_angle
    assert np.array_equal(np.load(folder / "rows.npy"), table.rows)
    for name in ARRAYS:
        assert np.array_equal(getattr(back, name), getattr(table, name))
        assert getattr(back, name).dtype == getattr(table, name).dtype
    assert back.fingerprint == table.fingerprint
    for n, same in enumerate((back, bake(SPEC, table.shapes, table.density))):
        same.save(tmp_path / str(n))
        assert contents(tmp_path / str(n)) == contents(folder)


def test_a_loaded_table_is_mapped_and_writing_to_it_leaves_the_files(folder):
    before = contents(folder)
    back = LidarTable.load(folder)
    for name in ARRAYS:
        array = getattr(back, name)
        assert array.ctypes.data % 64 == 0
        base = array
        while not isinstance(base, np.memmap):
            base = base.base
        assert base.mode == "c"
        array[...] = 0
    assert contents(folder) == before


def npy(descr, shape, data=b"", order="False"):
    """The content of an `.npy` file with a header that need not be true."""
    head = (
        f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    )
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + data


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no array",
        b"PK\x05\x06" + bytes(18),
        npy("'<f4'", f"({10**15},)"),
        npy("'<f4'", f"({2**32}, {2**32})"),
        npy("'<f4'", "(-1,)"),
        npy("'|O'", "(3,)", b"cos\nsystem\n(S'true'\ntR."),
        npy("'<f4'", "(" * 3000 + ")" * 3000),
        npy("[('a', '<f4')]", "(1,)", bytes(4)),
        npy("'<f4'", "()", bytes(4)),
    ],
    ids=range(10),
)
def test_a_hostile_array_is_refused_although_its_checksum_is_right(folder, content):
    (folder / "rows.npy").write_bytes(content)
    write_sums(folder)
    refused(folder)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {"format": "nics_drl_bridge/lidar_table/3"}, "its format is not"),
        (lambda t: {"rows": t.rows[:-1]}, "a row is outside"),
        (
            lambda t: {"rows": t.rows.astype(np.float64)},
            "an array has another number type",
        ),
        (lambda t: {"start": t.start[:-1]}, "the number of cells"),
        (lambda t: {"cell": t.cell[:, :5]}, "the number of cells"),
        (lambda t: {"cell": t.cell * np.int16(30)}, "a "),
        (
            lambda t: {"cell": np.where(np.arange(6) == 3, np.int16(-9), t.cell)},
            "a cell refers to a corner",
        ),
        (lambda t: {"grid": t.grid[0]}, "the grid"),
        (lambda t: {"grid": t.grid * np.nan}, "the grid"),
        (lambda t: {"grid": t.grid[::-1].copy()}, "the grid"),
        (lambda t: {"beam_angle": 0.0}, "key 'beam_angle'"),
        (lambda t: {"density": {"distances": 8}}, "the grid"),
        (lambda t: {"shapes": [{"kind": "blob"}]}, "unknown kind 'blob'"),
        (lambda t: {"shapes": []}, "the grid"),
        (lambda t: {"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_a_table_with_entries_that_do_not_fit_is_refused(table, folder, change, reason):
    about = json.loads((folder / ABOUT_FILE).read_text())
    for name, value in change(table).items():
        if name in ARRAYS:
            np.save(folder / f"{name}.npy", value)
        else:
            (folder / ABOUT_FILE).write_text(json.dumps(about | {name: value}))
    write_sums(folder)
    assert reason in refused(folder)


@pytest.mark.parametrize("array", ARRAYS)
def test_every_change_of_an_array_changes_the_fingerprint(table, array):
    values = getattr(table, array).copy()
    values.view(np.uint8).ravel()[-1] ^= 1
    assert replace(table, **{array: values}).fingerprint != table.fingerprint
