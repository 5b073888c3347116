from __future__ import annotations

import json
import os
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


def invoke(*words):
    return CliRunner().invoke(cli.app, ["record", *split_words(*words)], input="n\n")


@pytest.mark.slow
def test_a_preview_tells_and_draws_the_drive_and_needs_no_ros(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.chdir(tmp_path)
    done = invoke("--preview --duration 20 --out new/drive.npz --json")
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    told = facts.pop("told")
    assert facts == {"out": "new/drive.npz", "robot": DEFAULT_ROBOT}
    assert told[0].startswith("preview of 20 s: a path of ")
    assert told[-1] == "its path is drawn in new/drive_preview.png"
    assert (tmp_path / "new" / "drive_preview.png").read_bytes().startswith(PNG)
    assert os.listdir(tmp_path / "new") == ["drive_preview.png"]


@pytest.fixture
def undrawn(monkeypatch):
    """A drive without its preview, which takes seconds."""
    monkeypatch.setattr(model, "draw_preview", lambda plan, out: ())


@pytest.mark.ros
@pytest.mark.parametrize("as_json", [False, True])
def test_it_asks_before_the_robot_moves(tmp_path, monkeypatch, undrawn, as_json):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    monkeypatch.chdir(tmp_path)
    done = invoke("--duration 20 --out drive.npz", "--json" if as_json else "")
    assert done.exit_code == 0, done.output
    assert "Drive the robot now? [y/N]: n" in done.output
    if as_json:
        facts = json.loads(done.stdout.splitlines()[-1])
        assert facts == {"out": "drive.npz", "robot": DEFAULT_ROBOT, "recorded": False}
    else:
        assert done.stdout.endswith(
            "the robot was not driven, and nothing was recorded.\n"
        )
    assert "drive.npz" not in os.listdir(tmp_path)


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
@pytest.mark.parametrize(
    ("complete", "failure", "code"),
    [(True, None, 0), (False, None, 130), (True, BackendError("odom"), 2)],
)
def test_an_outcome_becomes_lines_or_an_error(
    monkeypatch, tmp_path, undrawn, complete, failure, code
):
    record_node = pytest.importorskip("nics_drl_bridge.nodes.record_node")
    outcome = record_node.DriveResult(complete, failure, None, "over")
    monkeypatch.setattr(record_node, "record", lambda *_: outcome)
    done = invoke("--yes --duration 20 --out", tmp_path / "drive.npz")
    assert done.exit_code == code
    assert done.output.endswith("over\n")
