from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import check_out, write_drive
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")


@pytest.mark.parametrize("name", ["drive.npz", "drive", "new/drive"])
def test_a_drive_comes_back_from_a_file_and_from_a_bag(tmp_path, name):
    if not name.endswith(".npz"):
        pytest.importorskip("rosbags")
    drive = record(CAR, np.random.default_rng(0), duration=20.0)
    path = check_out(tmp_path / name)
    write_drive(drive, path, CAR)
    back = read_recording(path, CAR)
    assert back.command.values == pytest.approx(drive.command.values)
    assert back.pose.values == pytest.approx(drive.pose.values)
    assert np.diff(back.pose.t) == pytest.approx(np.diff(drive.pose.t), abs=1e-8)
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_place_that_is_taken_or_of_no_kind_is_refused(tmp_path):
    (tmp_path / "drive.npz").write_text("mine")
    with pytest.raises(ConfigError, match=r"drive.npz: is there already"):
        check_out(tmp_path / "drive.npz")
    with pytest.raises(ConfigError, match=r"drive.csv: unknown kind of recording '.csv'"):
        check_out(tmp_path / "drive.csv")


def test_a_bag_that_can_not_be_written_leaves_nothing(tmp_path):
    pytest.importorskip("rosbags")
    drive = record(CAR, np.random.default_rng(0), duration=20.0)
    with pytest.raises(ValueError, match=r"shape|broadcast|operands"):
        write_drive(drive, tmp_path / "drive", load_robot("mecanum"))
    assert list(tmp_path.iterdir()) == []
