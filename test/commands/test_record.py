from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from command_line import split_words
from typer.testing import CliRunner

from nics_drl_bridge.commands import cli, model
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")
PNG = b"\x89PNG\r\n\x1a\n"


def nics(*words, cwd, **environment):
    command = [
        sys.executable,
        "-m",
        "nics_drl_bridge.commands.cli",
        "record",
        *split_words(*words),
    ]
    return subprocess.run(
        command,
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=100,
        input="n\n",
    )


@pytest.mark.slow
def test_a_preview_tells_and_draws_the_drive_and_does_no_more(tmp_path):
    # A module path without ROS 2: a preview needs none.
    (tmp_path / "rclpy.py").write_text("raise ModuleNotFoundError('no', name='rclpy')")
    done = nics("--preview --out new/drive.npz", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert told[0].startswith("preview of 60 s: a path of ")
    assert told[-1] == "its path is drawn in new/drive_preview.png"
    assert (tmp_path / "new" / "drive_preview.png").read_bytes().startswith(PNG)
    assert os.listdir(tmp_path / "new") == ["drive_preview.png"]
    words = "--preview --out new/drive.npz --json"
    facts = json.loads(nics(words, cwd=tmp_path, PYTHONPATH=str(tmp_path)).stdout)
    assert facts == {"out": "new/drive.npz", "robot": DEFAULT_ROBOT, "told": told}


@pytest.mark.ros
def test_it_asks_before_the_robot_moves(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    done = nics("--out drive.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("preview of ") == 1
    assert done.stdout.endswith(
        "Drive the robot now? [y/N]: nothing was driven or recorded.\n"
    )
    facts = json.loads(nics("--out drive.npz --json", cwd=tmp_path).stdout)
    assert facts == {"out": "drive.npz", "robot": DEFAULT_ROBOT, "recorded": False}


def test_the_summary_tells_each_command_and_the_next_step():
    given = {"robot": "ackermann", "out": "runs/drive.npz"}
    drive = record(CAR, np.random.default_rng(0), duration=30.0)
    measured, speed, steering, after = model.drive_summary(drive, given)
    assert measured.startswith("measured: a path of ")
    assert speed.startswith("speed_command: moved from -0.4")
    assert "on its own" in steering
    assert (
        after
        == "next: nics generate runs/drive.npz --robot ackermann --out drive_model"
    )


def test_options_become_arguments_of_the_node():
    assert model.make_node_arguments("", ()) == ["nics"]
    named = model.make_node_arguments("/bot/", ("odom:=/wheels",))
    assert named == ["nics", "--ros-args", "-r", "__ns:=/bot", "-r", "odom:=/wheels"]


@pytest.mark.ros
@pytest.mark.parametrize("complete", [True, False])
def test_an_outcome_becomes_lines_or_an_error(monkeypatch, tmp_path, complete):
    record_node = pytest.importorskip("nics_drl_bridge.nodes.record_node")
    order = ["record", "--yes", "--out", str(tmp_path / "drive.npz")]
    for failure, code in ((None, 0 if complete else 130), (BackendError("odom"), 2)):
        outcome = record_node.DriveResult(complete, failure, None, "over")
        monkeypatch.setattr(record_node, "record", lambda *_, outcome=outcome: outcome)
        done = CliRunner().invoke(cli.app, order)
        assert done.exit_code == code
        assert done.output.endswith("over\n")
