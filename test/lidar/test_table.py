from __future__ import annotations

import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.files import sha256, write_bytes
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import SQUARE, Circle, Polygon
from nics_drl_bridge.lidar.table import Density, LidarTable
from nics_drl_bridge.npz import npz_arrays, npz_bytes

SPEC = lidar(beams=90)
ARRAYS = ("grid", "start", "cell", "rows")
TRIANGLE = Polygon(points=((0.0, 0.0), (0.4, 0.0), (0.1, 0.2)))


@pytest.fixture(scope="module")
def table():
    return bake(SPEC, (Circle(radius=0.25), SQUARE, TRIANGLE), Density(distances=9, rotations=8))


@pytest.fixture
def path(table, tmp_path):
    write_bytes(tmp_path / "table.npz", table.dump())
    return tmp_path / "table.npz"


def refused(path, **options):
    """The one sentence with which a file is refused."""
    with pytest.raises(ModelError) as caught:
        LidarTable.load(path, **options)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    assert "\n" not in sentence
    return sentence


def test_a_table_reads_back_to_the_same_bits(table, path):
    back = LidarTable.load(path, sha256(table.dump()))
    assert (back.shapes, back.density) == (table.shapes, table.density)
    assert back.beam_angle == table.beam_angle
    for name in ARRAYS:
        assert np.array_equal(getattr(back, name), getattr(table, name))
        assert getattr(back, name).dtype == getattr(table, name).dtype
    assert back.dump() == table.dump()
    assert bake(SPEC, table.shapes, table.density).dump() == table.dump()


def test_a_table_read_back_gives_the_same_scans(table, path):
    poses = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 3, 3))
    scans = []
    for one in (table, LidarTable.load(path)):
        scanner = Scanner(SPEC, one, "baked")
        scans.append(scanner.scan(np.zeros((50, 3)), scanner.place(table.shapes, poses)))
    assert np.array_equal(*scans)
    assert np.isfinite(scans[0]).any()


def test_a_table_without_shapes_reads_back(tmp_path):
    write_bytes(tmp_path / "table.npz", bake(SPEC, ()).dump())
    assert LidarTable.load(tmp_path / "table.npz").shapes == ()


def test_a_loaded_table_is_mapped_and_writing_to_it_leaves_the_file(table, path):
    back = LidarTable.load(path)
    base = back.rows
    while not isinstance(base, np.memmap):
        base = base.base
    assert base.mode == "c"
    back.rows[:] = 0.0
    assert path.read_bytes() == table.dump()


def test_two_processes_share_the_pages_of_a_table(tmp_path):
    big = bake(lidar(beams=720), (SQUARE,), Density(distances=100, rotations=240))
    path = tmp_path / "table.npz"
    write_bytes(path, big.dump())
    script = f"""
import re, sys
from pathlib import Path
from nics_drl_bridge.lidar.table import LidarTable
table = LidarTable.load(Path({str(path)!r}))
table.rows.sum()
print("ready", flush=True)
sys.stdin.readline()
parts = Path("/proc/self/smaps").read_text().split("table.npz")[1:]
for key in ("Shared_Clean", "Private_Dirty"):
    print(sum(int(re.search(key + r":\\s+(\\d+)", part)[1]) for part in parts) * 1024)
"""
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    assert [process.stdout.readline() for process in pair] == ["ready\n"] * 2
    told = pair[0].communicate("go\n", timeout=60)[0]
    pair[1].communicate("go\n", timeout=60)
    shared, dirty = map(int, told.split())
    assert shared > 0.9 * big.rows.nbytes
    assert dirty < 0.1 * big.rows.nbytes


def test_another_checksum_is_refused(table, path):
    assert "does not match its checksum" in refused(path, checksum=sha256(b""))


def test_a_file_cut_off_anywhere_is_refused(table, path):
    content = table.dump()
    for length in np.linspace(0, len(content) - 1, 60).astype(int):
        path.write_bytes(content[:length])
        assert "is no lidar table (" in refused(path)


def test_a_flipped_bit_is_refused_or_changes_nothing(table, path):
    content, rng, found = table.dump(), np.random.default_rng(0), 0
    for trial in range(300):
        damaged = bytearray(content)
        # The heads of files and arrays make up little of the content; half of the trials go there.
        place = rng.integers(600) if trial % 2 else rng.integers(len(content))
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            back = LidarTable.load(path)
        except ModelError:
            refused(path)
            found += 1
        else:
            assert back.dump() == content
        refused(path, checksum=sha256(content))
    assert found > 200


@pytest.mark.parametrize(
    "content",
    [b"", b"no table", npz_bytes({"rows": np.zeros(1)}), npz_bytes({"about": np.ones(3)})],
)
def test_what_is_no_table_is_refused_with_the_files_name(content, tmp_path):
    path = tmp_path / "here.npz"
    path.write_bytes(content)
    assert "is no lidar table (" in refused(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    assert "can't be read (No such file" in refused(tmp_path / "none.npz")
    assert "can't be read (" in refused(tmp_path)


def changed(table, **changes):
    """The content of a table's file with other entries."""
    arrays = npz_arrays(table.dump())
    about = json.loads(arrays["about"].tobytes())
    for name, value in changes.items():
        if name in arrays:
            arrays[name] = value
        else:
            about[name] = value
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    return npz_bytes(arrays, packed=False)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {"format": "nics_drl_bridge/lidar_table/2"}, "its format is"),
        (lambda t: {"rows": t.rows[:-1]}, "a row lies outside"),
        (lambda t: {"rows": t.rows.astype(np.float64)}, "an array has another"),
        (lambda t: {"rows": t.rows + np.float32(1.0)}, "its numbers were damaged"),
        (lambda t: {"start": t.start[:-1]}, "the number of cells"),
        (lambda t: {"start": t.start - 1}, "a row lies outside"),
        (lambda t: {"cell": t.cell[:, :5]}, "the number of cells"),
        (lambda t: {"cell": t.cell * np.int16(30)}, "a "),
        (
            lambda t: {"cell": np.where(np.arange(6) == 3, np.int16(-9), t.cell)},
            "a cell names a corner",
        ),
        (lambda t: {"grid": t.grid[0]}, "the grid"),
        (lambda t: {"grid": t.grid * np.nan}, "the grid"),
        (lambda t: {"grid": t.grid * 1e300}, "the "),
        (lambda t: {"grid": t.grid[::-1].copy()}, "the grid"),
        (lambda t: {"beam_angle": 0.0}, "the grid"),
        (lambda t: {"beam_angle": None}, ""),
        (lambda t: {"density": {"distances": 8}}, ""),
        (lambda t: {"density": 3}, ""),
        (lambda t: {"shapes": [{"kind": "blob"}]}, ""),
        (lambda t: {"shapes": []}, ""),
    ],
)
def test_a_table_with_entries_that_do_not_fit_is_refused(table, tmp_path, change, reason):
    path = tmp_path / "table.npz"
    path.write_bytes(changed(table))
    LidarTable.load(path)
    path.write_bytes(changed(table, **change(table)))
    assert f"is no lidar table ({reason}" in refused(path)


def test_an_archive_of_other_things_is_refused(tmp_path):
    path = tmp_path / "table.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("about.npy", "text")
    assert "is no lidar table (" in refused(path)


def test_memory_is_the_sum_of_the_arrays(table):
    assert table.memory == sum(getattr(table, name).nbytes for name in ARRAYS)


@pytest.mark.parametrize("phases", [0, 3, 16])
def test_phases_are_a_power_of_two(phases):
    with pytest.raises(ValueError, match="phases must be 1, 2, 4 or 8"):
        Density(phases=phases)
