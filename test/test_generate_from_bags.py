"""`generate` on bags: the same model as from the package's own recordings."""

from __future__ import annotations

import numpy as np
import pytest
from command_line import nics

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.generator import generate
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import load_robot

CAMPAIGN = pytest.mark.campaign
SAME = 1e-6
"""Stamps are rounded to nanoseconds, and headings go through quaternions."""


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
    drive = record(spec, np.random.default_rng(1), duration=20.0)
    expected, _ = generate(drive, spec)
    variables = (*spec.state, *spec.command)
    low, high = np.array([(v.min, v.max) for v in variables]).T
    x = np.random.default_rng(0).uniform(low, high, (200, len(variables)))
    rates = expected.kinematics.rates(x)
    for storage in ("mcap", "sqlite3"):
        write_bag(drive, tmp_path / storage, spec, storage)
        made, _ = generate(read_recording(tmp_path / storage, spec), spec)
        error = np.abs(made.kinematics.rates(x) - rates).max()
        assert error < SAME * np.abs(rates).max()
        assert made.timing == pytest.approx(expected.timing)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--topic odom", "must be ROLE=TOPIC"),
        ("--topics none.yaml", "no such file"),
        ("--topic odom=/x --topic pose=none", "has no topic '/x' (odom)"),
    ],
)
def test_a_wrong_mapping_is_one_sentence_and_nothing_is_made(tmp_path, words, said):
    bags.write(tmp_path / "bag", bags.drive())
    done = nics("generate bag --out car", words, cwd=tmp_path)
    assert done.returncode == 2
    (sentence,) = done.stderr.splitlines()
    assert said in sentence
    assert not (tmp_path / "car").exists()
