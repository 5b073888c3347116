import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import table_files
from nics_drl_bridge.recording.readers import open_source
from nics_drl_bridge.recording.table import read_numbers
from nics_drl_bridge.recording.table_files import read_arrays, read_text_table

from .tables import drive, read

NUMBERS = [(0.0, 1.5, -2.0), (0.1, 1.6, -2.5), (0.2, 1.7, -3.0)]


def table(tmp_path, text, name="log.csv", encoding="utf-8"):
    (tmp_path / name).write_text(text, encoding=encoding)
    return read_text_table(tmp_path / name)


@pytest.mark.parametrize(
    ("separator", "point"),
    [
        (",", "."),
        (";", "."),
        (";", ","),
        ("\t", "."),
        ("\t", ","),
        (" | ", "."),
        ("  ", "."),
    ],
)
@pytest.mark.parametrize("header", [("t", "x", "y"), None])
def test_any_separator_is_found_with_header_or_without(
    tmp_path, separator, point, header
):
    rows = [header] if header else []
    rows += [[f"{v}".replace(".", point) for v in row] for row in NUMBERS]
    found = table(tmp_path, "\n".join(separator.join(row) for row in rows))
    assert np.array_equal(
        np.stack([read_numbers(found, k) for k in range(3)], axis=1), NUMBERS
    )
    assert found.names == (header or ("", "", ""))


def test_titles_a_separator_at_the_end_and_repeated_headers_are_no_rows(tmp_path):
    head = "Camera & ticks\n time | pose.x | cov[1,1]\t|\tLeft\n"
    rows = "1 | 2.5 | 3 | 4 |\n2 | 2.6 | 3 | 5 |\n"
    found = table(tmp_path, head + rows + head + rows)
    assert found.names == ("time", "pose.x", "cov[1,1]", "Left")
    assert read_numbers(found, "Left").tolist() == [4, 5, 4, 5]
    assert found.notes == ("log.csv: 2 lines repeat the header, and were left out.",)
    assert found.row(2) == "line 7"


TUM = "10.0 1 2 0 0 0 0.6 0.8\n10.1 1 2 0 0 0 0.6 0.8\n"
# A table; the names of its columns, and the numbers in the last one.
FORMS = {
    "a header in a comment": ("# t x\n0 1\n1 2\n", "t x", [1, 2]),
    "a comment of Matlab": ("% t, x\n0,1\n1,2\n", "t x", [1, 2]),
    "fewer names than columns": ("a,b\n1,2,3\n4,5,6\n", "a b ", [3, 6]),
    "a column without a name": (",s,ns\n0,1,2\n0,3,4\n", " s ns", [2, 4]),
    "a TUM trajectory": (TUM, "timestamp tx ty tz qx qy qz qw", [0.8, 0.8]),
    "a row of units": ("Log, robot 3\nt,x,y\ns,m,m\n0,1,2\n1,2,3\n", "t x y", [2, 3]),
    "quoted numbers": ('t,x\n"0,5","1,25"\n"0,6","1,75"\n', "t x", [1.25, 1.75]),
    "odd separators": ("t~x\n0~1.5\n1~2.5\n", "t x", [1.5, 2.5]),
    "colons": ("t:x\n0:1.5\n1:2.5\n", "t x", [1.5, 2.5]),
    "an old Windows tool, in latin-1": ("t;[°]\n0;1,5\n1;2,5\n", "t [°]", [1.5, 2.5]),
    "Excel, in utf-16": ("t\tx\n0\t1\n", "t x", [1]),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_of_this_form_is_read(tmp_path, form):
    text, names, last = FORMS[form]
    encoding = form.partition(", in ")[2] or "utf-8"
    found = table(tmp_path, text, "drive.txt", encoding)
    assert found.names == tuple(names.split(" "))
    assert read_numbers(found, len(found.names) - 1).tolist() == last


def test_labels_within_the_rows_name_the_columns(tmp_path):
    row = "time: {t} ticks: {t} 4294859756 tracker_pose: 0.2 1.5 -0.1\n"
    found = table(
        tmp_path, "#kinematics: 0.1 0.01\n" + row.format(t=1) + row.format(t=2)
    )
    poses = tuple(f"tracker_pose[{k}]" for k in range(3))
    assert found.names == ("time", "ticks[0]", "ticks[1]", *poses)
    assert read_numbers(found, "ticks[1]").tolist() == [4294859756.0] * 2


def test_flags_may_be_words_and_cells_empty(tmp_path):
    found = table(
        tmp_path, "t,on,mode,x\n0,True,AUTO,1\n1,False,MANUAL,\n2,True,AUTO,3\n"
    )
    assert read_numbers(found, "on").tolist() == [1.0, 0.0, 1.0]
    assert found.column("mode").tolist() == ["AUTO", "MANUAL", "AUTO"]
    assert np.isnan(read_numbers(found, "x")[1])


def test_a_row_that_was_cut_short_is_left_out_and_told(tmp_path):
    found = table(tmp_path, "t,x\n0,1\n1,2\n2\n")
    assert len(found.column("t")) == 2
    assert "1 lines of another length (line 4)" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "t,x\n" + "0,1\n" * 9 + "0\n1,2,3\n",
            "line 11 has 1 fields where most lines have 2",
        ),
        ("speed,angle\nfast,left\n", "contains no row of numbers"),
        ("0,1\n" + "2" * 30_000, "line 2 has 30000 characters"),
        ("0,1\0\n", "is not text"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, text, sentence):
    with pytest.raises(RecordingError) as refused:
        table(tmp_path, text)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    ("which", "sentence"),
    [
        ("tme", "has no column 'tme'; did you mean 'time'?"),
        ("x", "2 columns are called 'x'; choose one by number: 1 or 2."),
        (7, "has no column 7; its columns are 0 to 3."),
        ("word", "line 3: column 'word' is 'oops', which is not a number"),
    ],
)
def test_a_column_that_is_not_there_is_named(tmp_path, which, sentence):
    found = table(tmp_path, "time,x,x,word\n0,1,2,3\n1,2,3,oops\n")
    with pytest.raises(RecordingError) as refused:
        read_numbers(found, which)
    assert sentence in str(refused.value)


@pytest.mark.parametrize("word", ["NA", "null", "None", "-", "nan", ""])
def test_words_for_a_missing_value_are_none(tmp_path, word):
    assert np.isnan(read_numbers(table(tmp_path, f"t,x\n0,{word}\n1,2\n"), "x")[0])


def test_an_archive_that_unpacks_to_gigabytes_is_refused_packed(monkeypatch, tmp_path):
    path = tmp_path / "drive.npz"
    np.savez_compressed(path, t=np.arange(1000.0), x=np.zeros(1000))
    assert read_arrays(path).names == ("t", "x")
    monkeypatch.setattr(table_files, "MAX_UNPACKED_BYTES", 10_000)
    with pytest.raises(RecordingError, match="unpacked it is larger than 0 MB; split"):
        read_arrays(path)


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
