import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import table_files
from nics_drl_bridge.recording.readers import open_source

from .tables import drive, read


@pytest.fixture
def columns():
    return drive()


def test_arrays_of_an_archive_are_columns_those_of_a_matrix_by_index(tmp_path, columns):
    pose = np.stack([columns["x"], columns["y"], columns["yaw"]], axis=1)
    few = {"ct": columns["t"][::5], "c": columns["v"][::5]}
    np.savez(tmp_path / "log.npz", t=columns["t"], pose=pose, **few)
    changes = "pose: {x: 'pose[0]', y: 'pose[1]', heading: 'pose[2]'}\ncommand: {v: %s}"
    found = read(tmp_path / "log.npz", changes % "{from: c, time: ct}")
    assert np.allclose(found.pose.values[:, 0], columns["x"])
    assert found.command.values.shape == (40, 1)
    with pytest.raises(RecordingError, match="has 200 stamps for 40 values"):
        read(tmp_path / "log.npz", changes % "c")


def test_a_matrix_has_numbers_and_records_have_names(tmp_path, columns):
    np.save(tmp_path / "matrix.npy", np.stack(list(columns.values()), axis=1))
    by_number = "{time: 0, pose: {x: 1, y: 2, heading: 3}, command: {v: 4, w: 5}}"
    plain = read(tmp_path / "matrix.npy", by_number)
    records = np.rec.fromarrays(list(columns.values()), names=list(columns))
    np.save(tmp_path / "records.npy", np.asarray(records))
    assert np.array_equal(read(tmp_path / "records.npy").pose.values, plain.pose.values)


def test_objects_and_damage_are_refused(tmp_path):
    np.save(
        tmp_path / "objects.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True
    )
    (tmp_path / "damaged.npz").write_bytes(b"PK\x03\x04 and nothing else")
    for name in ("objects.npy", "damaged.npz"):
        with pytest.raises(RecordingError, match="write numbers with numpy"):
            read(tmp_path / name)


def test_parquet_without_its_library_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(table_files, "find_spec", lambda _: None)
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    with pytest.raises(RecordingError, match="Parquet needs the library pyarrow"):
        read(tmp_path / "log.parquet")


def write_parquet(path, columns):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns), path)
    return path


def test_parquet_is_read_with_its_stamps(tmp_path, columns):
    ns = (np.round(columns["t"] * 1e9) + 1.7e18).astype(np.int64)
    dates = {"date": ns.astype("datetime64[ns]")}
    path = write_parquet(tmp_path / "log.parquet", columns | dates)
    assert np.allclose(read(path, "time: date").pose.t, columns["t"], atol=1e-6)


@pytest.mark.parametrize("each", [["a"], b"\xff\xfe", {"deg": 1.5}, [1.0, 2.0], None])
def test_a_column_of_parquet_that_holds_no_numbers_is_let_be(tmp_path, columns, each):
    other = {"other": [each] * len(columns["t"])}
    path = write_parquet(tmp_path / "log.parquet", columns | other)
    assert np.allclose(read(path).pose.values[:, 0], columns["x"])


def test_a_folder_without_tables_and_a_path_that_is_none_are_refused(tmp_path):
    (tmp_path / "notes.md").write_text("none")
    for path, sentence in (
        (tmp_path, "contains no file of a known"),
        (tmp_path / "x", "no such"),
    ):
        with pytest.raises(RecordingError, match=sentence), open_source(path):
            pass
