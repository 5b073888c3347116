from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.csv_folder import load_csv_folder
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import Recording, Stream, save_recording


@pytest.fixture
def folder(tmp_path):
    """Ten seconds of a drive that turns left by 0.1 rad a sample."""
    t = np.arange(100) * 0.1
    write(tmp_path / "cmd.csv", np.stack([t * 0.1, t * 0.0 - 0.5, t + 0.2], axis=1))
    yaw, zero = np.arange(100) * 0.1, np.zeros(100)
    pose = [t, -t, zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2), np.round(t * 1e9)]
    write(tmp_path / "vrpn.csv", np.stack(pose, axis=1))
    for name, speed in (("L_wheel.csv", 3.0), ("R_wheel.csv", 5.0)):
        write(tmp_path / name, np.stack([zero + speed, t + 0.2], axis=1))
    write(tmp_path / "acceleration.csv", np.stack([zero, zero, zero + 9.8, t], axis=1))
    return tmp_path


def write(path, table):
    np.savetxt(path, table, delimiter=",", fmt="%.17g")


def spoil(path, row, text):
    lines = path.read_text().splitlines()
    lines[row - 1] = text
    path.write_text("\n".join(lines))


def test_it_reads_commands_poses_and_wheels_with_their_clocks(folder):
    recording = load_csv_folder(folder)
    assert recording.command.values.shape == (100, 2)
    assert recording.command.t[0] == pytest.approx(0.2)
    assert recording.pose.t[-1] == pytest.approx(9.9)
    assert np.allclose(np.unwrap(recording.pose.values[:, 2]), np.arange(100) * 0.1)
    assert np.array_equal(recording.wheels.values[0], [3.0, 5.0])
    clocks = {name: stream.clock for name, stream in recording.streams.items()}
    assert clocks == {"command": "robot", "pose": "mocap", "wheels": "robot"}


def test_wheels_and_acceleration_may_be_missing(folder):
    (folder / "L_wheel.csv").unlink()
    (folder / "acceleration.csv").unlink()
    assert load_csv_folder(folder).wheels is None


@pytest.mark.parametrize(
    ("file", "row", "text", "sentence"),
    [
        ("cmd.csv", 3, "0.1,nan,0.4", "cmd.csv: row 3 holds NaN or inf; remove the row"),
        ("cmd.csv", 7, "0.1,0.4", r"cmd.csv: row 7 has 2 columns where 3 are needed"),
        ("cmd.csv", 1, "linear,angular,time", "row 1: linear.x is 'linear', which is no number"),
        ("L_wheel.csv", 5, "3,0.1", "L_wheel.csv: row 5: time runs backwards"),
        ("vrpn.csv", 2, "0,0,0,0,0,0,0,100000000", "quaternion has the length 0.000"),
        ("acceleration.csv", 9, "0,0,9.8,", "acceleration.csv: row 9: time"),
    ],
)
def test_a_bad_row_is_named_with_file_row_and_fix(folder, file, row, text, sentence):
    spoil(folder / file, row, text)
    with pytest.raises(RecordingError, match=sentence):
        load_csv_folder(folder)


@pytest.mark.parametrize("file", ["cmd.csv", "vrpn.csv"])
def test_a_missing_file_is_named(folder, file):
    (folder / file).unlink()
    with pytest.raises(RecordingError, match=f"the file '{file}' is missing"):
        load_csv_folder(folder)


def test_an_empty_file_is_named(folder):
    (folder / "cmd.csv").write_text("")
    with pytest.raises(RecordingError, match="is empty; record the drive anew"):
        load_csv_folder(folder)


def test_bytes_that_are_no_text_are_refused(folder):
    (folder / "cmd.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(RecordingError, match="is not UTF-8 text"):
        load_csv_folder(folder)


def test_pose_stamps_in_seconds_are_refused(folder):
    table = np.loadtxt(folder / "vrpn.csv", delimiter=",")
    table[:, 7] *= 1e-9
    write(folder / "vrpn.csv", table)
    with pytest.raises(RecordingError, match="must be in nanoseconds"):
        load_csv_folder(folder)


def test_command_stamps_in_nanoseconds_are_refused(folder):
    table = np.loadtxt(folder / "cmd.csv", delimiter=",")
    table[:, 2] *= 1e9
    write(folder / "cmd.csv", table)
    with pytest.raises(RecordingError, match="must be in seconds"):
        load_csv_folder(folder)


@pytest.mark.parametrize("name", ["cmd.csv", "L_wheel.csv", "acceleration.csv"])
@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_of_stamps_in_mixed_units_the_right_file_is_named(folder, name, factor):
    if not (folder / name).exists():
        write(folder / name, np.column_stack([np.zeros((300, 3)), np.arange(300) * 0.1]))
    table = np.loadtxt(folder / name, delimiter=",")
    table[:, -1] *= factor
    write(folder / name, table)
    with pytest.raises(RecordingError, match="must be in seconds") as caught:
        load_csv_folder(folder)
    assert str(caught.value).startswith(str(folder / name))


@pytest.mark.parametrize("factor", [1e-9, 1e-6, 1e-3])
def test_of_pose_stamps_in_another_unit_the_pose_is_named(folder, factor):
    table = np.loadtxt(folder / "vrpn.csv", delimiter=",")
    table[:, 7] *= factor
    write(folder / "vrpn.csv", table)
    with pytest.raises(RecordingError, match="must be in nanoseconds") as caught:
        load_csv_folder(folder)
    assert str(caught.value).startswith(str(folder / "vrpn.csv"))


def test_the_reader_is_chosen_by_what_lies_there(folder, tmp_path):
    assert read_recording(folder).wheels is not None
    t = np.arange(30) * 0.1
    saved = Recording(Stream(t, np.zeros((30, 2))), Stream(t, np.zeros((30, 3))))
    save_recording(saved, tmp_path / "drive.npz")
    assert np.array_equal(read_recording(tmp_path / "drive.npz").pose.t, t)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nowhere", "no such file or folder"),
        ("nowhere.npz", "no such file"),
        ("cmd.csv", "is neither a bag nor a folder of CSV files nor an .npz file; say what is what"),
    ],
)
def test_a_path_that_holds_no_recording_is_refused(folder, name, sentence):
    with pytest.raises(RecordingError, match=sentence):
        read_recording(folder / name)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1" * 2_000_000, "row 3 has 2000000 characters"),
        ("0.5," * 500_000, "row 3 has 2000000 characters"),
        ("9" * 900 + ",0,0", "row 3 holds NaN or inf"),
        ("x" * 900 + ",0,0", "which is no number"),
    ],
)
def test_a_row_of_very_many_characters_is_refused_and_not_told(tmp_path, row, words):
    (tmp_path / "cmd.csv").write_text(f"0,0,0\n0,0,1\n{row}\n")
    (tmp_path / "vrpn.csv").write_text("0,0,0,0,0,0,1,0\n")
    with pytest.raises(RecordingError, match=words) as told:
        load_csv_folder(tmp_path)
    assert len(str(told.value)) < 400


def test_more_rows_or_bytes_than_any_drive_has_are_refused(tmp_path):
    (tmp_path / "cmd.csv").write_text("1,1,1\n" * 600_000)
    (tmp_path / "vrpn.csv").write_text("0,0,0,0,0,0,1,0\n")
    with pytest.raises(RecordingError, match="has 600001 rows"):
        load_csv_folder(tmp_path)
    with (tmp_path / "cmd.csv").open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(RecordingError, match="larger than 64 MB"):
        load_csv_folder(tmp_path)
