from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from command_line import nics

from nics_drl_bridge import __version__
from nics_drl_bridge.commands import console
from nics_drl_bridge.generator import load_model
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import load_robot

MODEL_FILES = {"model.yaml", "lidar_table", "report.txt", "report.html", "SHA256SUMS"}


def started(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """`nics` in a process of its own."""
    command = [sys.executable, "-m", "nics_drl_bridge.commands.cli", *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=100)


def refused(done: subprocess.CompletedProcess[str]) -> str:
    """The one sentence that a command ended with."""
    assert done.returncode == 2, done.stderr
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("nics: ")
    return sentence


def names(folder: Path) -> set[str]:
    """All that lies in a folder, hidden or not."""
    return set(os.listdir(folder))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.npz"
    car = load_robot("ackermann")
    save_recording(textbook.record(car, np.random.default_rng(0), duration=30.0), path)
    return path


def csv_folder(path: Path, bad_row: str = "") -> Path:
    """Half a minute of a car under motion capture."""
    path.mkdir()
    t = np.arange(0.0, 30.0, 0.1)
    commands = [f"0.5,0.0,{second:.3f}" for second in t]
    poses = [f"{0.5 * s:.4f},0.0,0.0,0.0,0.0,0.0,1.0,{int(s * 1e9)}" for s in t]
    if bad_row:
        poses[7] = bad_row
    (path / "cmd.csv").write_text("\n".join(commands), encoding="utf-8")
    (path / "vrpn.csv").write_text("\n".join(poses), encoding="utf-8")
    return path


COMMANDS = {
    "generate",
    "record",
    "explain",
    "doctor",
    "urdf",
    "train",
    "evaluate",
    "demo",
    "policy",
    "bag",
    "world",
}


@pytest.mark.process
def test_it_tells_its_version_and_its_commands_and_refuses_others_in_one_sentence(
    tmp_path,
):
    assert started("--version", cwd=tmp_path).stdout == f"{__version__}\n"
    told = started("--help", cwd=tmp_path)
    assert told.returncode == 0
    assert set(told.stdout.split()) >= COMMANDS
    assert "No such command 'genrate'" in refused(started("genrate", cwd=tmp_path))


@pytest.mark.process
def test_the_help_loads_nothing_that_only_commands_need(tmp_path):
    heavy = {
        "numba",
        "scipy",
        "matplotlib",
        "gymnasium",
        "torch",
        "rclpy",
        "onnx",
        "numpy",
    }
    code = "import sys, nics_drl_bridge.commands.cli; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert heavy.isdisjoint(done.stdout.split())


def test_an_unknown_command_or_option_is_refused(tmp_path):
    for words in (("genrate",), ("generate", "drive.npz", "--output", "model")):
        done = nics(*words, cwd=tmp_path)
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
    assert names(tmp_path) == set()


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
    again = nics(*words, "--alpha", "0.9", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert names(tmp_path / "models") == {"car"}
    assert load_model(tmp_path / "models" / "car").fingerprint != model.fingerprint


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0100036, 0.0083, 1.0 / 60.0])
def test_a_recording_of_any_rate_gives_a_model_whose_step_divides_the_period(
    tmp_path, dt
):
    spec = load_robot("differential")
    save_recording(
        textbook.record(spec, np.random.default_rng(0), 40.0, dt), tmp_path / "d.npz"
    )
    done = nics(
        "generate", "d.npz", "--robot", "differential", "--out", "car", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    model = load_model(tmp_path / "car")
    steps = model.control_period / model.kinematics.dt
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert model.kinematics.dt == pytest.approx(dt, rel=0.01)


@pytest.mark.slow
def test_of_a_recording_too_coarse_for_a_model_the_textbook_is_written(tmp_path):
    spec = load_robot("differential")
    fine = textbook.record(spec, np.random.default_rng(0), duration=60.0, dt=0.01)
    pose, state = (
        replace(stream, t=stream.t[::80], values=stream.values[::80])
        for stream in (fine.pose, fine.state)
    )
    save_recording(replace(fine, pose=pose, state=state), tmp_path / "slow.npz")
    words = ("generate", "slow.npz", "--robot", "differential", "--out", "car")
    wanted = nics(*words, cwd=tmp_path)
    assert wanted.returncode == 0, wanted.stderr
    told = " ".join(wanted.stdout.split())
    assert "the model written is the textbook" in told
    assert "between rows that are 0.8 s apart, so record at a higher rate." in told
    assert names(tmp_path / "car") == MODEL_FILES
    assert load_model(tmp_path / "car").robot == spec


def test_replay_of_something_else_is_one_sentence(tmp_path):
    (tmp_path / "stop.jsonl").write_text("{}", encoding="utf-8")
    assert "is no black box" in refused(nics("explain", "stop.jsonl", cwd=tmp_path))
    assert "no such file" in refused(nics("explain", "none.jsonl", cwd=tmp_path))


@pytest.mark.slow
def test_generate_reads_the_folder_of_a_real_drive(shared_recordings, tmp_path):
    folder = shared_recordings / "xtark_ackermann" / "random_drive_45s"
    done = nics("generate", folder, "--out", "car", "--assume-textbook", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert names(tmp_path / "car") == MODEL_FILES


def test_a_missing_recording_is_one_sentence(tmp_path):
    for name in ("drive.npz", "drive"):
        sentence = refused(nics("generate", name, "--out", "car", cwd=tmp_path))
        assert name in sentence
        assert "no such file" in sentence
    assert names(tmp_path) == set()


def test_an_empty_folder_names_the_files_that_are_needed(tmp_path):
    (tmp_path / "drive").mkdir()
    sentence = refused(nics("generate", "drive", "--out", "car", cwd=tmp_path))
    assert "cmd.csv" in sentence
    assert "vrpn.csv" in sentence
    assert names(tmp_path) == {"drive"}


def test_a_row_with_infinity_is_named(tmp_path):
    csv_folder(tmp_path / "drive", "0.1,inf,0.0,0.0,0.0,0.0,1.0,700000000")
    sentence = refused(nics("generate", "drive", "--out", "car", cwd=tmp_path))
    assert "vrpn.csv: line 8: column 1 is infinite" in sentence
    assert names(tmp_path) == {"drive"}


def test_a_damaged_npz_is_one_sentence(drive, tmp_path):
    data = drive.read_bytes()
    (tmp_path / "torn.npz").write_bytes(data[: len(data) // 2])
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    before = names(tmp_path)
    for name in ("torn.npz", "other.npz"):
        assert name in refused(nics("generate", name, "--out", "car", cwd=tmp_path))
    assert names(tmp_path) == before


@pytest.mark.parametrize(
    ("option", "name", "hint"),
    [
        ("--robot", "ackerman", "did you mean 'ackermann'?"),
        ("--robot", "robot.yaml", "robot.yaml: no such file"),
        ("--world", "areena", "did you mean 'arena'?"),
        ("--lidar", "papper", "did you mean 'paper'?"),
    ],
)
def test_an_unknown_name_comes_with_the_nearest(drive, tmp_path, option, name, hint):
    sentence = refused(
        nics("generate", drive, "--out", "car", option, name, cwd=tmp_path)
    )
    assert name in sentence
    assert hint in sentence
    assert names(tmp_path) == set()


def test_what_lies_at_the_place_of_the_model_is_left_alone(drive, tmp_path):
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("mine", encoding="utf-8")
    before = names(tmp_path)
    for out, reason in (("file", "is a file"), ("folder", "holds other files")):
        assert reason in refused(nics("generate", drive, "--out", out, cwd=tmp_path))
    assert names(tmp_path) == before
    assert names(tmp_path / "folder") == {"thesis.tex"}
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_a_recording_of_another_robot_is_refused(drive, tmp_path):
    refused(nics("generate", drive, "--out", "car", "--robot", "mecanum", cwd=tmp_path))
    assert names(tmp_path) == set()


def test_ctrl_c_in_a_compiled_function_is_an_interruption_and_another_fault_is_not():
    with pytest.raises(typer.Exit) as caught, console.report_in_one_sentence():
        raise SystemError(
            "returned a result with an exception set"
        ) from KeyboardInterrupt()
    assert caught.value.exit_code == 130
    with (
        pytest.raises(SystemError, match="of another kind"),
        console.report_in_one_sentence(),
    ):
        raise SystemError("of another kind")


@pytest.mark.parametrize(
    "words",
    [
        ("bake", "--distances", "abc"),
        ("evaluate", "straight", "--seed", "-3"),
        ("evaluate", "straight", "--seed", "1.5"),
        ("evaluate", "straight", "--seed", "9" * 6000),
        ("evaluate", "straight", "--seed", str(2**63), "--in", "fast"),
        ("evaluate", "straight", "--seed", str(2**63 - 1), "--in", "fast"),
        ("train", "--seeds", str(2**64)),
        ("record", "--preview", "--seed", str(2**63), "--out", "drive.npz"),
        ("evaluat",),
        ("bake", "--unheard-of", "x" * 5000),
        ("bake", "x" * 50_000),
    ],
)
def test_a_wrong_option_is_one_sentence(tmp_path, words):
    assert len(refused(nics(*words, cwd=tmp_path))) < 1000
    assert names(tmp_path) == set()


@pytest.mark.parametrize("words", [(), ("bag",)])
def test_no_command_shows_the_help(tmp_path, words):
    done = nics(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("Usage: nics")
    assert len(done.stderr.splitlines()) > 10
