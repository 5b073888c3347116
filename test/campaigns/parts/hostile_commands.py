"""Seeds and paths that an attacker would give to commands and to the simulator."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from parts.artefacts import SHORT_TRAINING
from parts.attempt import Attempt, nics

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

Rng = np.random.Generator


def attempts(rng: Rng, folder: Path) -> Iterator[Attempt]:
    """Without end."""
    simulator = FastSimulator(
        builtin_model("differential"), load_world("arena"), worlds=1
    )
    while True:
        draw = rng.random()
        if draw < 0.1:
            seed = int(rng.integers(2**62, 2**63 - 1))
            act = _reset(simulator, seed)
            yield Attempt("seed", f"reset {seed}", act, "good")
        else:
            yield _seed(rng, folder, simulator) if draw < 0.5 else _path(rng, folder)


def _reset(simulator: FastSimulator, seed: int) -> Callable[[], object]:
    return lambda: simulator.reset([seed])


def _seed(rng: Rng, folder: Path, simulator: FastSimulator) -> Attempt:
    values = (
        2**63,
        2**64,
        -1,
        -(2**63),
        10**30,
        10**4200,
        1.5,
        "word",
        2**63 + 7,
        1e308,
    )
    seed = values[int(rng.integers(len(values)))]
    settings = folder / "settings.yaml"
    settings.write_text(dump_yaml(SHORT_TRAINING), encoding="utf-8")
    out = folder / "out"
    short = ("--world", "arena", "--episodes", "1", "--out", out)
    robot = ("--robot", "ackermann")
    acts: dict[str, Callable[[], object]] = {
        "reset": lambda: simulator.reset([seed]),
        "scene": lambda: sample_scene(load_world("arena"), 0.2, seed),  # type: ignore[arg-type]
        "evaluate": nics(
            "evaluate", "straight", *robot, "--in", "fast", f"--seed={seed}", *short
        ),
        "train": nics("train", "--settings", settings, f"--seeds={seed}", "--out", out),
        "record": nics(
            "record", "--preview", *robot, f"--seed={seed}", "--out", folder / "d.npz"
        ),
    }
    name = str(rng.choice(list(acts)))
    return Attempt("seed", f"{name} {str(seed)[:30]}", acts[name])


def _path(rng: Rng, folder: Path) -> Attempt:
    """What is no file, in the place of one."""
    commands: tuple[tuple[str, ...], ...] = (
        ("policy", "info"),
        ("explain",),
        ("bag", "info"),
        ("bake", "--world"),
        ("bake", "--shapes"),
        ("bake", "--lidar"),
        ("bake", "--robot"),
        ("generate", "--out", "model", "--robot"),
        ("generate", "--robot", "ackermann", "--out", "model"),
        ("train", "--settings"),
        ("doctor", "--model", "ackermann"),
        ("evaluate", "--in", "fast", "--out", "evaluated"),
        ("urdf",),
        (
            "evaluate",
            "straight",
            "--robot",
            "ackermann",
            "--in",
            "fast",
            "--out",
            "evaluated",
            "--world",
        ),
        ("doctor", "--policy"),
        ("bag", "replay", "x", "--estimate", "--model"),
    )
    command = commands[int(rng.integers(len(commands)))]
    suffix = {"info": ".onnx", "replay": ".jsonl", "model": ".npz"}.get(
        command[-1], ".yaml"
    )
    path = folder / f"no_file{suffix}"
    shutil.rmtree(
        path, ignore_errors=True
    ) if path.is_dir() and not path.is_symlink() else (path.unlink(missing_ok=True))
    way = str(
        rng.choice(
            ["pipe", "/dev/zero", "/dev/null", "loop", "folder", "missing", "large"]
        )
    )
    if way == "pipe":
        os.mkfifo(path)
    elif way.startswith("/dev"):
        path.symlink_to(way)
    elif way == "loop":
        path.symlink_to(path)
    elif way == "folder":
        path.mkdir()
    elif way == "large":
        with path.open("wb") as file:
            file.truncate(2**33)
    words = [str(folder / w) if w in ("model", "evaluated") else w for w in command]
    more = ["x.npz"] if command[-1] == "--robot" and command[0] == "generate" else []
    return Attempt("path", f"{way} for {' '.join(command)}", nics(*words, path, *more))
