from __future__ import annotations

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags
import numpy as np

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import load_robot


def nics(*words):
    return CliRunner().invoke(app, list(map(str, words)))


def cut(bag, share):
    """A bag whose end is missing."""
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    return bag


@pytest.fixture
def damaged(tmp_path):
    return cut(bags.write(tmp_path / "bag", bags.drive()), 0.7)


def test_info_prints_a_table_or_json(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive())
    told = nics("bag", "info", bag)
    assert told.exit_code == 0, told.output
    assert "geometry_msgs/msg/PoseStamped" in told.stdout
    facts = json.loads(nics("bag", "info", bag, "--json").stdout)
    assert facts["messages"] == 360
    assert [topic["topic"] for topic in facts["topics"]] == ["/cmd_vel", "/pose"]


@pytest.mark.parametrize(
    "words",
    [
        ("bag", "info"),
        ("bag", "replay", "--estimate"),
        ("doctor",),
        ("generate", "--out", "model"),
    ],
)
def test_a_damaged_bag_is_one_sentence_for_every_command(damaged, words):
    told = nics(*words, damaged)
    assert told.exit_code == 2
    (sentence,) = told.stderr.splitlines()
    assert sentence.startswith(f"nics: {damaged}: ")
    assert "nics bag salvage" in sentence


@pytest.mark.process
def test_a_damaged_bag_is_one_sentence_for_the_process_too(damaged):
    command = [
        sys.executable,
        "-m",
        "nics_drl_bridge.commands.cli",
        "bag",
        "info",
        str(damaged),
    ]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert told.returncode == 2
    (sentence,) = told.stderr.splitlines()
    assert sentence.startswith(f"nics: {damaged}: ")


def test_what_is_intact_is_saved_and_the_loss_is_told(damaged, tmp_path):
    told = nics("bag", "salvage", damaged, tmp_path / "saved")
    assert told.exit_code == 0, told.output
    assert "of 360 are lost" in told.stdout
    assert nics("bag", "info", tmp_path / "saved").exit_code == 0
    facts = json.loads(
        nics("bag", "salvage", damaged, tmp_path / "anew", "--json").stdout
    )
    assert facts["path"] == str(tmp_path / "anew")
    assert facts["told"] == told.stdout.splitlines()[:-1]
    looked = nics("bag", "info", damaged, "--salvage")
    assert looked.exit_code == 0
    assert "of 360 are lost" in looked.stderr


@pytest.mark.slow
def test_generate_takes_what_is_intact_when_told_to(tmp_path):
    car = load_robot("ackermann")
    bag = tmp_path / "drive"
    write_bag(textbook.record(car, np.random.default_rng(0), duration=30.0), bag, car)
    words = ("--robot", "ackermann", "--salvage", "--out", tmp_path / "model")
    told = nics("generate", cut(bag, 0.8), *words)
    assert told.exit_code == 0, told.output
    assert "are lost" in told.stderr
    assert (tmp_path / "model" / "model.yaml").is_file()


def test_what_a_salvaged_bag_lacks_is_said_of_the_users_own(tmp_path):
    bag = bags.write(tmp_path / "drive", {"/cmd_vel": bags.commands()})
    told = nics("generate", bag, "--salvage", "--out", tmp_path / "model")
    assert told.exit_code == 2
    assert told.stderr.splitlines()[-1].startswith(f"nics: {bag}: ")
