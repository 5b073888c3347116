from __future__ import annotations

import json
import signal
import subprocess
import sys

import filelock
import pytest
from browser import until
from typer.testing import CliRunner

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.policy.file.policy_file import load_policy

REACH = """
from dataclasses import dataclass
import numpy as np
from nics_drl_bridge.env.task import Task, bearing, distance

@dataclass(frozen=True)
class Reach(Task):
    @property
    def observation_space(self):
        return self.box([0, -1, -1], [1000, 1, 1])
    def reset(self, episodes):
        return {"goal": episodes.goals.copy()}
    def observation(self, view, memory):
        seen = bearing(view.pose, memory["goal"])
        return np.concatenate([self.free_share(view.ranges), seen], axis=-1)
    def reward(self, before, after, memory):
        return {"near": -distance(after.pose, memory["goal"])}
    def end(self, view, memory):
        return self.touches(view.ranges)
"""
SETTINGS_OF_ANY_TASK = """
worlds: {arena: 8}
steps: 256
max_episode_steps: 20
hidden: [8]
ppo: {rollout: 16, batch: 64, epochs: 1}
"""
SETTINGS = f"{SETTINGS_OF_ANY_TASK}task_options: {{scan: around}}\n"


def nics(*arguments):
    return CliRunner().invoke(app, ["train", *map(str, arguments)])


@pytest.fixture
def settings(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture
def no_torch(monkeypatch):
    """PyTorch and Stable-Baselines3 are not installed."""
    for name in [*sys.modules]:
        if name.endswith((".extras.sb3.training", ".policy.train.vec_env")):
            monkeypatch.delitem(sys.modules, name)
    for name in ("torch", "stable_baselines3"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.slow
def test_a_run_leaves_policy_evaluation_and_logs_of_each_seed_and_can_be_resumed(
    tmp_path, settings, no_torch
):
    out = tmp_path / "run"
    done = nics("--settings", settings, "--seeds", 3, 4, "--episodes", 10, "--out", out)
    assert done.exit_code == 0, done.output
    assert done.output.count("of 10 episodes") == 2
    for seed in (3, 4):
        folder = out / f"seed_{seed}"
        assert load_policy(folder / "policy.onnx").contract.provenance["seed"] == seed
        told = json.loads((folder / "evaluation.json").read_text())
        figures = told["arena"]
        assert told["training_steps"] == 256
        assert figures["success"]["low"] <= figures["success"]["value"]
        assert any(folder.glob("events.out.tfevents.*"))
    again = nics("--resume", "--episodes", 10, "--out", out)
    assert again.exit_code == 0, again.output
    lines = [line for line in again.output.splitlines() if line.startswith("seed ")]
    assert [line.partition(" in ")[0] for line in lines] == [
        "seed 3: 256 steps",
        "seed 4: 256 steps",
    ]
    one = nics("--resume", "--seeds", 4, "--episodes", 10, "--out", out)
    assert one.exit_code == 0, one.output
    assert [line for line in one.output.splitlines() if line.startswith("seed 3")] == []
    assert "seed 4: 256 steps" in one.output
    refused = nics("--resume", "--seeds", 5, "--out", out)
    assert (
        "no checkpoint of these seeds; name one of [3, 4] with --seeds"
        in refused.output
    )
    refused = nics("--settings", settings, "--seeds", 3, "--out", out)
    assert refused.exit_code == 2
    assert "contains checkpoints of these seeds; add --resume" in refused.output


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--robot", "diferential"], "did you mean 'differential'"),
        (["--resume"], "--resume requires --out"),
        (["--resume", "--out", "nowhere"], "nowhere: contains no settings.yaml"),
        (["--seeds", "1", "1", "--out", "run"], "give one or more, without duplicates"),
        (["--engine", "rai"], "unknown engine 'rai'; did you mean 'ray'"),
        (
            ["--engine", "lean", "--algorithm", "sac"],
            "--engine lean requires ppo, not 'sac'",
        ),
        (
            ["--resume", "--engine", "lean", "--out", "x"],
            "--engine: a resumed run has its own",
        ),
        (
            ["--address", "auto"],
            "--address: requires --engine ray; add it, or remove this option.",
        ),
    ],
)
def test_what_can_not_be_trained_gives_one_sentence(
    tmp_path, monkeypatch, settings, arguments, sentence
):
    monkeypatch.chdir(tmp_path)
    done = nics(*arguments)
    assert done.exit_code == 2
    assert sentence in " ".join(done.output.split())
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    ("task", "text", "sentence"),
    [
        (
            "mine.py:Reach",
            REACH.replace('{"near": -', '{"near": np.nan * '),
            "task Reach: its reward term 'near' must be finite",
        ),
        (
            "mine.py:Reach",
            REACH.replace('memory["goal"])}', 'memory["gaol"])}'),
            "mine.py:17, in reward: KeyError('gaol'); correct",
        ),
        ("mine.py:Patrol", "", "'mine.py:Patrol': mine.py defines no subclass"),
        (
            "cooperative_reaching",
            "",
            "task 'cooperative_reaching': has 3 robots; train a single-robot task,",
        ),
    ],
    ids=["no number", "an error", "misspelt", "a team"],
)
def test_a_task_that_can_not_be_learnt_is_refused_before_a_folder_is_begun(
    tmp_path, monkeypatch, task, text, sentence
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(text)
    done = nics("--task", task, "--world", "empty", "--steps", 64, "--out", "run")
    assert done.exit_code == 2
    assert sentence in " ".join(done.output.split())
    assert "Traceback" not in done.output
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_task_that_tells_no_success_is_said_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(REACH)
    (tmp_path / "settings.yaml").write_text(
        "task: mine.py:Reach\n" + SETTINGS_OF_ANY_TASK
    )
    own = "--task", "mine.py:Reach"
    done = nics("--settings", "settings.yaml", *own, "--episodes", 2, "--out", "run")
    assert done.exit_code == 0, done.output
    assert "check that the task's `info` contains `is_success`" in done.output
    assert "--task mine.py:Reach" in done.output.splitlines()[-1]


@pytest.mark.parametrize("engine", ["lean", "sb3"])
def test_a_training_that_diverges_says_so_and_leaves_no_broken_checkpoint(
    tmp_path, engine
):
    (tmp_path / "settings.yaml").write_text(
        SETTINGS.replace("epochs: 1", "epochs: 20, learning_rate: 1.0e+30")
    )
    out = tmp_path / "run"
    done = nics(
        "--settings", tmp_path / "settings.yaml", "--engine", engine, "--out", out
    )
    assert done.exit_code == 2
    assert "nics: the training diverged: after" in done.output
    assert (
        "its weights are too large or not finite; lower its learning_rate."
        in done.output
    )
    assert not list(out.rglob("checkpoint.npz"))
    assert not (out / "settings.yaml").exists()  # which would bar the corrected ones


@pytest.mark.slow
def test_a_training_beside_another_in_one_folder_is_refused(tmp_path, settings):
    out = tmp_path / "run"
    out.mkdir()
    with filelock.FileLock(out / ".lock"):
        done = nics("--settings", settings, "--out", out)
    assert done.exit_code == 2
    assert "another training is running there; wait until it ends" in " ".join(
        done.output.split()
    )
    assert nics("--settings", settings, "--episodes", 2, "--out", out).exit_code == 0


@pytest.mark.process
def test_an_interrupted_training_tells_the_command_that_resumes_it(tmp_path):
    imported = "from nics_drl_bridge.env.tasks.navigation import Navigation\n"
    own = f"{imported}class Mine(Navigation): pass\n"
    (tmp_path / "own.py").write_text(own)
    settings = "worlds: {empty: 64}\nsteps: 20000000\ncheckpoint_every: 2000\n"
    (tmp_path / "short.yaml").write_text(settings)
    program = [
        sys.executable,
        "-c",
        "from nics_drl_bridge.commands.start import main; main()",
    ]
    train = [*program, "train", "--settings", "short.yaml", "--task", "own.py:Mine"]
    train += ["--out", "my run", "--seeds", "3", "4", "--episodes", "7"]
    with subprocess.Popen(
        train,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        checkpoint = tmp_path / "my run" / "seed_3" / "checkpoint.npz"
        until(
            lambda: checkpoint.is_file() or process.poll() is not None,
            "a checkpoint",
            300.0,
        )
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60.0)[1]
    assert process.returncode == 130, said
    line = next(
        each
        for each in said.splitlines()
        if each.startswith("to continue from the last")
    )
    command = line.partition("checkpoint: ")[2]
    expected = (
        "nics train --resume --out 'my run' --seeds 3 4 --episodes 7 --task own.py:Mine"
    )
    assert command == expected
