from __future__ import annotations

import re

import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.readers import open_drive, read_recording
from nics_drl_bridge.recording.recording import Recording, Stream, save_recording
from nics_drl_bridge.robot import DEFAULT_ROBOT


@pytest.fixture
def folder(tmp_path):
    """Ten seconds of a drive that turns left by 0.1 rad a sample."""
    t = np.arange(100) * 0.1
    write(tmp_path / "cmd.csv", np.stack([t * 0.1, t * 0.0 - 0.5, t + 0.2], axis=1))
    yaw = np.arange(100) * 0.1
    zero = np.zeros(100)
    pose = [
        t,
        -t,
        zero,
        zero,
        zero,
        np.sin(yaw / 2),
        np.cos(yaw / 2),
        np.round(t * 1e9),
    ]
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
    recording = read_recording(folder)
    assert recording.command.values.shape == (100, 2)
    assert recording.command.t[0] == pytest.approx(0.2)
    assert recording.pose.t[-1] == pytest.approx(9.9)
    assert np.allclose(np.unwrap(recording.pose.values[:, 2]), np.arange(100) * 0.1)
    assert np.array_equal(recording.wheels.values[0], [3.0, 5.0])
    clocks = {name: stream.clock for name, stream in recording.streams.items()}
    assert clocks == {"command": "robot", "pose": "mocap", "wheels": "robot"}


def test_a_folder_tells_its_robot_and_a_drive_that_tells_none_is_of_the_default(
    folder, tmp_path
):
    def robot_of(path, named=None):
        return open_drive(path, named, None)[0].name

    assert robot_of(folder) == "ackermann"
    assert robot_of(folder, "tricycle") == "tricycle"
    save_recording(read_recording(folder), tmp_path / "drive.npz")
    assert robot_of(tmp_path / "drive.npz") == DEFAULT_ROBOT


def test_wheels_and_acceleration_may_be_missing(folder):
    (folder / "L_wheel.csv").unlink()
    (folder / "acceleration.csv").unlink()
    assert read_recording(folder).wheels is None


@pytest.mark.parametrize(
    ("file", "row", "text", "sentence"),
    [
        (
            "cmd.csv",
            3,
            "0.1,inf,0.4",
            "cmd.csv: line 3: column '1' is infinite; mend or remove",
        ),
        (
            "cmd.csv",
            7,
            "0.1,fast,0.4",
            "line 7: column '1' is 'fast', which is no number; mend",
        ),
        (
            "vrpn.csv",
            2,
            "0,0,0,0,0,0,3,100000000",
            "0.100 s from the start the quaternion has",
        ),
    ],
)
def test_a_bad_row_is_named_with_place_and_fix_and_the_mapping(
    folder, file, row, text, sentence
):
    spoil(folder / file, row, text)
    with pytest.raises(RecordingError, match=sentence) as caught:
        read_recording(folder)
    assert re.search(
        r" The mapping is .*\.yaml; choose another with --map\.$", str(caught.value)
    )


@pytest.mark.parametrize(
    ("file", "row", "text", "repair"),
    [
        ("cmd.csv", 3, "0.1,nan,0.4", "1 of 100 rows have no value, and were left out"),
        (
            "cmd.csv",
            7,
            "0.1,0.4",
            "cmd.csv: 1 lines of another length (line 7) were left out",
        ),
        ("L_wheel.csv", 5, "3,0.1", "L_wheel.csv: 1 of 100 rows came after later ones"),
        ("vrpn.csv", 2, "0,0,0,0,0,0,0,100000000", "1 of 100 rows without orientation"),
    ],
)
def test_a_row_that_can_be_spared_is_mended_and_told(folder, file, row, text, repair):
    spoil(folder / file, row, text)
    assert any(repair in told for told in read_recording(folder).repairs)


def test_titles_and_what_no_stream_needs_do_not_matter(folder):
    whole = read_recording(folder)
    cmd = folder / "cmd.csv"
    cmd.write_text("linear,angular,time\n" + cmd.read_text())
    (folder / "acceleration.csv").write_text("no table")
    assert np.array_equal(read_recording(folder).command.values, whole.command.values)


@pytest.mark.parametrize("file", ["cmd.csv", "vrpn.csv"])
def test_a_folder_that_lacks_a_file_names_those_that_are_needed(folder, file):
    (folder / file).unlink()
    with pytest.raises(
        RecordingError, match=r"a folder with cmd.csv and vrpn.csv .* --map"
    ):
        read_recording(folder)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00\x81"])
def test_a_file_without_numbers_is_named(folder, content):
    (folder / "cmd.csv").write_bytes(content)
    with pytest.raises(
        RecordingError, match=r"cmd.csv: holds no row of numbers; give a table"
    ):
        read_recording(folder)


@pytest.mark.parametrize("name", ["cmd.csv", "L_wheel.csv"])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_of_stamps_in_another_unit_the_file_is_named_and_the_line(
    folder, name, factor, unit
):
    table = np.loadtxt(folder / name, delimiter=",")
    table[:, -1] *= factor
    write(folder / name, table)
    with pytest.raises(
        RecordingError, match=f"write `time: {{from: ., unit: {unit}}}`"
    ) as caught:
        read_recording(folder)
    assert str(caught.value).startswith(str(folder / name))


@pytest.mark.parametrize("factor", [1e-9, 1e-6, 1e-3])
def test_of_pose_stamps_in_another_unit_the_pose_is_named(folder, factor):
    table = np.loadtxt(folder / "vrpn.csv", delimiter=",")
    table[:, 7] *= factor
    write(folder / "vrpn.csv", table)
    with pytest.raises(RecordingError, match=r"the pose lasts .* s; give the `unit:`"):
        read_recording(folder)


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
        (
            "cmd.csv",
            "is neither a bag nor a folder with cmd.csv .* nor an .npz file; say what is",
        ),
    ],
)
def test_a_path_that_holds_no_recording_is_refused(folder, name, sentence):
    with pytest.raises(RecordingError, match=sentence):
        read_recording(folder / name)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1" * 2_000_000, "line 3 has 2000000 characters"),
        ("0.5," * 500_000, "line 3 has 2000000 characters"),
        ("9" * 900 + ",0,0", "line 3: column '0' is infinite"),
        ("x" * 900 + ",0,0", "which is no number"),
    ],
)
def test_a_row_of_very_many_characters_is_refused_and_not_told(tmp_path, row, words):
    (tmp_path / "cmd.csv").write_text(f"0,0,0\n0,0,1\n{row}\n")
    (tmp_path / "vrpn.csv").write_text("0,0,0,0,0,0,1,0\n")
    with pytest.raises(RecordingError, match=words) as told:
        read_recording(tmp_path)
    assert len(str(told.value)) < 400


def test_more_rows_or_bytes_than_any_drive_has_are_refused(tmp_path):
    (tmp_path / "cmd.csv").write_text("1,1,1\n" * 2_100_000)
    (tmp_path / "vrpn.csv").write_text("0,0,0,0,0,0,1,0\n")
    with pytest.raises(RecordingError, match="has 2100000 rows"):
        read_recording(tmp_path)
    with (tmp_path / "cmd.csv").open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(
        RecordingError, match=r"larger than 256 MB; cut it"
    ):
        read_recording(tmp_path)
