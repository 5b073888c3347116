from __future__ import annotations

import json

import pytest
from command_line import nics

from nics_drl_bridge.generator import load_model
from nics_drl_bridge.recording.readers import open_drive
from nics_drl_bridge.recording.recording import load_recording
from nics_drl_bridge.robot.spec import load_robot

NARROW = """
name: mine
kind: differential
footprint_radius: 0.1
lidar: rplidar_a1
lidar_mount: [0.05, 0.0, 0.0]
parameters: {wheel_radius: 0.05, track: 0.2}
state:
  - {name: left_wheel, unit: rad/s, min: -10.0, max: 10.0}
  - {name: right_wheel, unit: rad/s, min: -10.0, max: 10.0}
"""


@pytest.mark.slow
def test_a_robots_file_becomes_a_model_and_a_recording_by_a_textbook_drive(tmp_path):
    (tmp_path / "mine.yaml").write_text(NARROW, encoding="utf-8")
    words = "drive --robot mine.yaml --out mine --recording drive.npz"
    done = nics(words, "--duration 20", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("next: nics train --robot mine\n")
    first = " ".join(done.stdout.partition("\n\n")[0].split())
    assert "the commands require" in first
    assert "beyond its limits -10 and 10" in first
    model = load_model(tmp_path / "mine")
    assert model.lidar.mount == (0.05, 0.0, 0.0)
    assert model.control_period == pytest.approx(
        0.18
    )  # that of the lidar, which scans at 5.5 Hz
    assert load_recording(tmp_path / "drive.npz").command.t[-1] == pytest.approx(
        20.0, abs=0.1
    )
    spec, _ = open_drive(tmp_path / "drive.npz", None, None)
    assert spec == load_robot(tmp_path / "mine.yaml")  # a recording tells its robot
    words = "drive --robot mine.yaml --out again --duration 10 --json"
    told = json.loads(nics(words, cwd=tmp_path).stdout)
    assert told == {
        "model": "again",
        "robot": "mine",
        "lidar": model.lidar.name,
        "recording": None,
    }
    done = nics("drive --robot mine.yaml --duration 10", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert load_model(tmp_path / "mine_model").robot == spec
