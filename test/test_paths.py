"""Whatever takes a place in the file system takes it as a Path and as plain text."""

import numpy as np
import pytest
from robots import direct_model

from nics_drl_bridge.config import load_yaml, read_text, share_folder
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import (
    TABLE_FOLDER,
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


def test_a_drive_and_a_model_are_written_and_read_at_a_place_in_text(tmp_path):
    drive = record(CAR, np.random.default_rng(0), duration=2.0)
    place = str(tmp_path / "drive.npz")
    assert check_out(place) == tmp_path / "drive.npz"
    write_drive(drive, place, CAR)
    assert len(read_recording(place, CAR).pose.t) == len(drive.pose.t)
    place = str(tmp_path / "model")
    save_model(direct_model(), place)
    assert load_model(place).fingerprint == open_model(place).fingerprint
    LidarTable.load(f"{place}/{TABLE_FOLDER}").save(str(tmp_path / "table"))


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
