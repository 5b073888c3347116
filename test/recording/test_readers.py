import re

import numpy as np
import pytest

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording import table_files
from nics_drl_bridge.recording.readers import open_drive, read_recording
from nics_drl_bridge.recording.recording import save_recording
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
            "cmd.csv: line 3: column '1' is infinite; correct or remove",
        ),
        (
            "cmd.csv",
            7,
            "0.1,fast,0.4",
            "line 7: column '1' is 'fast', which is not a number; correct",
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


@pytest.mark.parametrize("file", ["cmd.csv", "vrpn.csv"])
def test_a_folder_that_lacks_a_file_names_those_that_are_needed(folder, file):
    (folder / file).unlink()
    with pytest.raises(
        RecordingError, match=r"a folder with cmd.csv and vrpn.csv .* --map"
    ):
        read_recording(folder)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nowhere", "no such file or folder"),
        ("nowhere.npz", "no such file"),
        (
            "cmd.csv",
            "is neither a bag nor a folder with cmd.csv .* nor an .npz file; describe its",
        ),
    ],
)
def test_a_path_that_holds_no_recording_is_refused(folder, name, sentence):
    with pytest.raises(RecordingError, match=sentence):
        read_recording(folder / name)


def test_a_row_without_orientation_is_left_out_and_told(folder):
    spoil(folder / "vrpn.csv", 2, "0,0,0,0,0,0,0,100000000")
    repairs = read_recording(folder).repairs
    assert any("1 of 100 rows without orientation" in told for told in repairs)


@pytest.mark.parametrize(
    ("limit", "most", "sentence"),
    [("MOST_ROWS", 50, "has 100 rows"), ("MAX_TABLE_BYTES", 100, "larger than 0 MB")],
)
def test_more_rows_or_bytes_than_any_drive_has_are_refused(
    folder, monkeypatch, limit, most, sentence
):
    monkeypatch.setattr(table_files, limit, most)
    with pytest.raises(RecordingError, match=f"{sentence}.*cut it"):
        read_recording(folder)
