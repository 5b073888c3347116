import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import os

import numpy as np

from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.recording.readers import open_drive, read_recording
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.topic_roles import TopicRoles
from nics_drl_bridge.recording.write import check_out, write_bag, write_drive
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")


def stream(width: int, clock: str = "robot", start: float = 3.0) -> Stream:
    t = start + np.arange(200) * 0.05
    return Stream(t, 0.1 * np.sin(t[:, None] * np.arange(1, width + 1)), clock)


DRIVES = {
    "all": Recording(stream(2), stream(3, "mocap", 40.0), stream(2), None, stream(3)),
    "wheels": Recording(stream(2), stream(3), wheels=stream(2)),
    "odometry": Recording(stream(2), stream(3), odometry=stream(3, start=3.01)),
}


@pytest.mark.parametrize(
    ("name", "storage"),
    [("all", "mcap"), ("all", "sqlite3"), ("wheels", "mcap"), ("odometry", "mcap")],
)
def test_every_stream_comes_back_on_its_clock(tmp_path, name, storage):
    drive = DRIVES[name]
    write_bag(drive, tmp_path / "bag", CAR, storage)
    roles = TopicRoles(odom="/odom" if drive.odometry else None)
    back = read_recording(tmp_path / "bag", CAR, roles)
    assert set(back.streams) == set(drive.streams)
    for key, one in drive.streams.items():
        other = back.streams[key]
        assert np.allclose(other.values, one.values)
        assert np.allclose(np.diff(other.t), np.diff(one.t))
        is_same = one.clock == drive.command.clock
        assert (other.clock == back.command.clock) == is_same
        if is_same:
            apart = one.t[0] - drive.command.t[0]
            assert other.t[0] - back.command.t[0] == pytest.approx(apart)


def test_a_folder_that_is_there_is_left_alone(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(RecordingError, match="already exists"):
        write_bag(Recording(stream(2), stream(3)), tmp_path / "bag", CAR)
    assert os.listdir(tmp_path / "bag") == []


@pytest.mark.parametrize("name", ["drive.npz", "new/drive"])
def test_a_drive_comes_back_from_a_file_and_from_a_bag(tmp_path, name):
    drive = record(CAR, np.random.default_rng(0), duration=2.0)
    path = check_out(tmp_path / name)
    write_drive(drive, path, CAR)
    if path.suffix == ".npz":  # which tells its robot, too
        spec, _ = open_drive(path, None, None)
        assert spec == CAR
    back = read_recording(path, CAR)
    assert back.command.values == pytest.approx(drive.command.values)
    assert back.pose.values == pytest.approx(drive.pose.values)
    assert np.diff(back.pose.t) == pytest.approx(np.diff(drive.pose.t), abs=1e-8)
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_place_that_is_taken_or_of_no_kind_is_refused(tmp_path):
    (tmp_path / "drive.npz").write_text("mine")
    with pytest.raises(ConfigError, match=r"drive.npz: already exists"):
        check_out(tmp_path / "drive.npz")
    with pytest.raises(
        ConfigError, match=r"drive.csv: unknown kind of recording '.csv'"
    ):
        check_out(tmp_path / "drive.csv")
