from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

from nics_drl_bridge.calibration.identify import identify
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.bag_writer import write_bag
from nics_drl_bridge.kinematics.readers import read_recording
from nics_drl_bridge.kinematics.spec import load_robot
from nics_drl_bridge.kinematics.textbook import record


@pytest.fixture(scope="module")
def car():
    return load_robot("ackermann")


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_drive_that_went_through_a_bag_gives_the_same_model(car, tmp_path, storage):
    drive = record(car, np.random.default_rng(1), duration=30.0)
    write_bag(drive, tmp_path / "bag", car, storage)
    model = identify(read_recording(tmp_path / "bag", car), car).model
    x = drive.state.values[::50], drive.command.values[::50]
    rates = model.rates(np.concatenate(x, axis=1))
    expected = identify(drive, car).model.rates(np.concatenate(x, axis=1))
    assert np.abs(rates - expected).max() < 0.1


def test_a_bag_without_a_robot_is_refused(car, tmp_path):
    write_bag(record(car, np.random.default_rng(1), duration=5.0), tmp_path / "bag", car)
    with pytest.raises(RecordingError, match="RobotSpec"):
        read_recording(tmp_path / "bag")
