from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import nics, split_words

from nics_drl_bridge import __version__
from nics_drl_bridge.generator import generate, load_model
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import load_robot

MODEL_FILES = {"model.yaml", "lidar_table", "report.txt", "report.html", "SHA256SUMS"}


def started(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """`nics` in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "nics_drl_bridge.commands.cli",
        *split_words(*words),
    ]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=100)


def names(folder: Path) -> set[str]:
    """All that lies in a folder, hidden or not."""
    return set(os.listdir(folder))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.npz"
    car = load_robot("ackermann")
    save_recording(textbook.record(car, np.random.default_rng(0), duration=8.0), path)
    return path


@pytest.mark.process
def test_it_tells_its_version_and_refuses_another_command_in_one_sentence(tmp_path):
    assert started("--version", cwd=tmp_path).stdout == f"{__version__}\n"
    refused = started("genrate", cwd=tmp_path)
    assert refused.returncode == 2
    (sentence,) = refused.stderr.splitlines()
    assert sentence.startswith("nics: No such command 'genrate'")


def test_generate_makes_a_model_of_a_recording_and_replaces_it(drive, tmp_path):
    words = ("generate", drive, "--robot", "ackermann", "--out", "models/car")
    first = nics(*words, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert first.stdout.endswith("model written to models/car\n")
    assert names(tmp_path / "models") == {"car"}
    assert names(tmp_path / "models" / "car") == MODEL_FILES
    model = load_model(tmp_path / "models" / "car")
    assert model.robot.name == "ackermann"
    verdict_and_model = "\n\n".join(model.report.split("\n\n")[:2])
    assert verdict_and_model in first.stdout
    assert "models/car/report.html" in first.stdout
    again = nics(*words, "--alpha 0.9", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert names(tmp_path / "models") == {"car"}
    assert load_model(tmp_path / "models" / "car").fingerprint != model.fingerprint


@pytest.mark.parametrize("dt", [0.0100036, 1.0 / 60.0])
def test_a_recording_of_any_rate_gives_a_model_whose_step_divides_the_period(dt):
    spec = load_robot("differential")
    model, _ = generate(textbook.record(spec, np.random.default_rng(0), 20.0, dt), spec)
    steps = model.control_period / model.kinematics.dt
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert model.kinematics.dt == pytest.approx(dt, rel=0.01)


@pytest.mark.parametrize("words", [(), ("bag",)])
def test_no_command_shows_the_help(tmp_path, words):
    done = nics(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("Usage: nics")
    assert len(done.stderr.splitlines()) > 10
