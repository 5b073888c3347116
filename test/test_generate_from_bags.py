"""`nics generate` on bags: the same model as from the package's own recordings."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.generator import SimulatorModel, load_model
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

SECONDS = 20.0
CAMPAIGN = pytest.mark.campaign
SAME = 1e-6
"""Stamps are rounded to nanoseconds, and headings go through quaternions."""


def generate(*words: object):
    return CliRunner().invoke(app, ["generate", *map(str, words)])


def model_of(recording, out, robot, *words) -> SimulatorModel:
    done = generate(recording, "--out", out, "--robot", robot, *words)
    assert done.exit_code == 0, done.output
    return load_model(out)


def refused(*words: object) -> str:
    done = generate(*words)
    assert done.exit_code == 2, done.output
    *progress, sentence = done.stderr.splitlines()
    assert all(line.endswith(" s)") for line in progress)  # of a slow machine
    return sentence


def assert_alike(one: SimulatorModel, other: SimulatorModel, spec: RobotSpec) -> None:
    variables = (*spec.state, *spec.command)
    low, high = np.array([(v.min, v.max) for v in variables]).T
    x = np.random.default_rng(0).uniform(low, high, (200, len(variables)))
    expected = one.kinematics.rates(x)
    scale = np.abs(expected).max()
    assert np.abs(other.kinematics.rates(x) - expected).max() < SAME * scale
    assert other.timing == one.timing


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot",
    [
        "ackermann",
        *(pytest.param(r, marks=CAMPAIGN) for r in ("differential", "mecanum")),
    ],
)
def test_a_bag_gives_the_model_of_the_same_drive(tmp_path, robot):
    spec = load_robot(robot)
    drive = record(spec, np.random.default_rng(1), duration=SECONDS)
    save_recording(drive, tmp_path / "drive.npz")
    expected = model_of(tmp_path / "drive.npz", tmp_path / "expected", robot)
    for storage in ("mcap", "sqlite3"):
        write_bag(drive, tmp_path / storage, spec, storage)
        made = model_of(tmp_path / storage, tmp_path / f"of_{storage}", robot)
        assert_alike(expected, made, spec)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--topic", "odom"], "must be ROLE=TOPIC"),
        (["--topics", "none.yaml"], "no such file"),
        (["--topic", "odom=/x", "--topic", "pose=none"], "has no topic '/x' (odom)"),
    ],
)
def test_a_wrong_mapping_is_one_sentence_and_nothing_is_made(tmp_path, words, said):
    bag = bags.write(tmp_path / "bag", bags.drive())
    assert said in refused(bag, "--out", tmp_path / "car", *words)
    assert not (tmp_path / "car").exists()
