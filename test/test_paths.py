"""Whatever takes a place in the file system takes it as a Path and as plain text."""

from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.config import load_yaml, read_text, share_folder
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import (
    TABLE_FOLDER,
    builtin_model,
    check_place,
    load_model,
    open_model,
    save_model,
)
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import check_out, write_drive
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.world import load_world

CAR = load_robot("ackermann")
CONFIG = share_folder() / "config"
KINDS = pytest.mark.parametrize("kind", [str, lambda path: path], ids=["text", "path"])


@pytest.mark.slow
@KINDS
@pytest.mark.parametrize("name", ["drive.npz", "drive"])
def test_a_drive_is_written_and_read_at_either(tmp_path, kind, name):
    if not name.endswith(".npz"):
        pytest.importorskip("rosbags")
    place = kind(tmp_path / name)
    drive = record(CAR, np.random.default_rng(0), duration=20.0)
    assert check_out(place) == tmp_path / name
    write_drive(drive, place, CAR)
    assert len(read_recording(place, CAR).pose.t) == len(drive.pose.t)


@KINDS
def test_a_model_is_saved_and_opened_at_either(tmp_path, kind):
    place = kind(tmp_path / "model")
    model = builtin_model("ackermann")
    check_place(place)
    save_model(model, place)
    assert load_model(place).fingerprint == model.fingerprint
    assert open_model(place).fingerprint == model.fingerprint
    table = LidarTable.load(kind(tmp_path / "model" / TABLE_FOLDER))
    table.save(kind(tmp_path / "table"))


@KINDS
@pytest.mark.parametrize(
    ("load", "file"),
    [
        (load_policy, "policies/differential.onnx"),
        (load_robot, "robots/ackermann.yaml"),
        (load_lidar, "lidars/paper.yaml"),
        (load_world, "worlds/arena.yaml"),
        (load_map, "maps/room.yaml"),
        (load_randomisation, "randomisation/mild.yaml"),
        (load_training, "training/navigation_differential.yaml"),
        (lambda name: load_limits(name, CAR), "limits/ackermann.yaml"),
        (lambda name: load_yaml(name, RobotSpec), "robots/ackermann.yaml"),
        (read_text, "robots/ackermann.yaml"),
    ],
)
def test_a_configuration_is_loaded_from_either(kind, load, file):
    assert load(kind(CONFIG / file))
