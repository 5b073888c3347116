from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import nics

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.generator import load_model
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.mapping import UNITS, DriveMapping
from nics_drl_bridge.recording.recording import load_recording
from nics_drl_bridge.robot.spec import load_robot

DOCS = Path(__file__).resolve().parents[2] / "docs" / "recordings.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive of a car as one table, with the names that users give."""
    room = tmp_path_factory.mktemp("log")
    drive = textbook.record(
        load_robot("ackermann"), np.random.default_rng(0), duration=10.0
    )
    row = np.searchsorted(drive.command.t, drive.pose.t + 1e-9, side="right") - 1
    command = drive.command.values[np.clip(row, 0, None)]
    table = np.column_stack([drive.pose.t, drive.pose.values, command, drive.pose.t])
    head = "time,x,y,yaw,cmd_speed,cmd_steering,battery_volts"
    np.savetxt(room / "drive.csv", table, delimiter=",", header=head, comments="")
    return room


def test_a_log_becomes_a_mapping_a_recording_and_a_model(folder, tmp_path):
    done = nics("inspect", folder / "drive.csv", "--map my.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "cmd_steering" in done.stdout
    assert "\nnot used: battery_volts\n" in done.stdout
    assert "# guessed" in (tmp_path / "my.yaml").read_text()
    again = nics("inspect", folder / "drive.csv", "--map my.yaml", cwd=tmp_path)
    assert "already exists" in again.stderr

    words = ("import", folder / "drive.csv", "--map", "my.yaml", "--out")
    done = nics(*words, "drive.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "command" in done.stdout
    told = json.loads(nics(*words, "again.npz --json", cwd=tmp_path).stdout)
    assert (told["recording"], told["robot"]["kind"]) == ("again.npz", "ackermann")
    (pose,) = (stream for stream in told["streams"] if stream["stream"] == "pose")
    assert pose["rate_hz"] == pytest.approx(
        (pose["rows"] - 1) / (pose["to_s"] - pose["from_s"])
    )
    kept = load_recording(tmp_path / "drive.npz")
    assert kept.variables == ("speed_command", "steering_command")
    assert kept.robot == {"kind": "ackermann", "footprint_radius": 0.2}


@pytest.mark.slow
def test_a_log_with_its_mapping_becomes_a_simulator(folder, tmp_path):
    (tmp_path / "my.yaml").write_text(
        "robot: ackermann\ntime: time\npose: {x: x, y: y, heading: yaw}\n"
        "command: {steering_command: cmd_steering, speed_command: cmd_speed}\n"
    )
    words = "--map my.yaml --out model --json"
    done = nics("generate", folder / "drive.csv", words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert load_model(tmp_path / "model").robot.name == "ackermann"
    told = json.loads(done.stdout)
    assert (told["model"], told["robot"], told["ready"]) == ("model", "ackermann", True)
    assert any(equation.startswith("vx = ") for equation in told["equations"])
    assert told["accuracy"] in " ".join((tmp_path / told["report"]).read_text().split())
    assert all(each["model"]["position_m"] >= 0.0 for each in told["errors"])


def test_the_mapping_and_the_units_of_the_docs_are_those_of_the_code():
    text = DOCS.read_text()
    example = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    DriveMapping.model_validate(parse_yaml(example.group(1), "docs"))
    row = next(line for line in text.splitlines() if line.startswith("| `unit`"))
    listed = [
        unit for some in re.findall("`([^`]+)`", row)[1:] for unit in some.split()
    ]
    assert set(listed) <= set(UNITS)
    assert len(set(UNITS) - set(listed)) < 12  # rare ones and synonyms
