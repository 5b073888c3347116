"""What the package writes, killed while it is written and damaged before it is read."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from mmap import mmap
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from parts.gates import Gate, gate_config

from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.gate import black_box
from nics_drl_bridge.gate.inputs import Tick
from nics_drl_bridge.generator import builtin_model, load_model, save_model
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.checkpoint import read_checkpoint
from nics_drl_bridge.policy.train.export import export_policy
from nics_drl_bridge.policy.train.run import CHECKPOINT, train
from nics_drl_bridge.policy.train.settings import TrainingSettings
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import load_recording, save_recording
from nics_drl_bridge.robot.spec import load_robot

LONGEST_S = 0.05
"""A writer is killed within this time after it began to write."""
STARTS_S = 10.0
"""So long it may take until it does."""
WRITES = mmap(-1, 2)
"""Shared with the writer: which number of writes began, and which ended, modulo 256."""
PIECE = 4096
"""Bytes that a naive writer writes at once, as a buffered file does."""
SHORT_TRAINING = {
    "robot": "differential",
    "worlds": {"empty": 4},
    "steps": 64,
    "hidden": [8],
    "ppo": {"rollout": 16, "batch": 64, "epochs": 1},
}
"""For a checkpoint: settings of `nics train`."""


@dataclass(frozen=True)
class Artefact:
    """Something that is written and read back.

    Attributes:
        name: of the file or folder.
        write: writes version 0 or 1 to a path.
        version: reads it and tells which version it is; raises BridgeError when it is damaged.
    """

    name: str
    write: Callable[[Path, int], None]
    version: Callable[[Path], int]


def artefacts() -> list[Artefact]:
    """All that the package writes and reads back."""
    made = [_recording(), _model(), _table(), _black_box()]
    with tempfile.TemporaryDirectory() as folder:
        return [*made, _policy(Path(folder)), _checkpoint(Path(folder))]


def _recording() -> Artefact:
    robot = load_robot("differential")
    drives = [textbook.record(robot, np.random.default_rng(seed)) for seed in (0, 1)]

    def version(path: Path) -> int:
        return _which(
            load_recording(path).pose.values, [drive.pose.values for drive in drives]
        )

    def write(path: Path, n: int) -> None:
        save_recording(drives[n], path)

    return Artefact("drive.npz", write, version)


def _model() -> Artefact:
    models = [builtin_model("differential")]
    models.append(replace(models[0], report="another report\n"))

    def version(path: Path) -> int:
        return [model.report for model in models].index(load_model(path).report)

    return Artefact("model", lambda path, n: save_model(models[n], path), version)


def _table() -> Artefact:
    tables = [builtin_model(name).table for name in ("differential", "ackermann")]

    def version(path: Path) -> int:
        return _which(LidarTable.load(path).rows, [table.rows for table in tables])

    return Artefact("table", lambda path, n: tables[n].save(path), version)


def _black_box() -> Artefact:
    lidar = load_lidar("paper")
    config = gate_config(load_robot("differential"), lidar)
    boxes = [_entries(config, lidar, ticks) for ticks in (5, 9)]

    def version(path: Path) -> int:
        return [len(box) for box in boxes].index(len(black_box.replay(path).entries))

    def write(path: Path, n: int) -> None:
        black_box.write(config, boxes[n], path)

    return Artefact("stop.jsonl", write, version)


def _policy(folder: Path) -> Artefact:
    model = builtin_model("differential")
    task = make_task("navigation", model, {"scan": 36})
    contents = []
    for n in (0, 1):
        actor = torch.nn.Linear(
            task.observation_space.shape[0], len(model.robot.command)
        )
        file = folder / f"{n}.onnx"
        export_policy(actor, task, model, file, provenance={"seed": n})
        contents.append(file.read_bytes())

    def version(path: Path) -> int:
        return int(load_policy(path).contract.provenance["seed"])

    return Artefact(
        "policy.onnx", lambda path, n: write_bytes(path, contents[n]), version
    )


def _checkpoint(folder: Path) -> Artefact:
    contents = []
    for seed in (0, 1):
        train(TrainingSettings.model_validate(SHORT_TRAINING), seed, folder)
        contents.append((folder / CHECKPOINT).read_bytes())

    def version(path: Path) -> int:
        return int(read_checkpoint(path)["about"]["seed"])

    return Artefact(CHECKPOINT, lambda path, n: write_bytes(path, contents[n]), version)


def _entries(config: Any, lidar: Any, ticks: int) -> tuple[black_box.Entry, ...]:
    entries = []
    gate = Gate(config, lidar)
    for _ in range(ticks):
        before = gate.state
        gate.now = gate.now + 0.02
        entries.append(black_box.Entry(gate.now, Tick(), before, gate.tick()))
    return tuple(entries)


def _which(found: NDArray[Any], versions: list[NDArray[Any]]) -> int:
    """Which of the versions an array is, to the bit."""
    return [np.array_equal(found, version) for version in versions].index(True)


def torn(
    artefact: Artefact, kills: int, rng: np.random.Generator, folder: Path
) -> dict[str, int]:
    """How often something was left that is neither the old nor the new version, whole.

    Each time a process that writes both in turn is killed with SIGKILL at a random moment after it
    began to write.

    Returns:
        `torn`, `kills`, and `kills_during_a_write`: those before which a write had begun that had
        not ended.
    """
    path = folder / artefact.name
    bad = 0
    during = 0
    artefact.write(path, 0)
    for _ in range(kills):
        WRITES[:] = bytes(2)
        child = os.fork()
        if child == 0:
            _write_for_ever(artefact, path)
        _wait_for_a_write()
        time.sleep(rng.uniform(0.0, LONGEST_S))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        during += WRITES[0] != WRITES[1]
        try:
            artefact.version(path)
        except (BridgeError, ValueError):
            bad += 1
            _remove(path)
            artefact.write(path, 0)
        for rest in folder.glob(f".{artefact.name}.*"):
            _remove(rest)
    return {"torn": bad, "kills": kills, "kills_during_a_write": during}


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _wait_for_a_write() -> None:
    """Returns once a write has begun, or after `STARTS_S`."""
    latest = time.monotonic() + STARTS_S
    while WRITES[0] == 0 and time.monotonic() < latest:
        time.sleep(0.0)


def _write_for_ever(artefact: Artefact, path: Path) -> None:
    """In a process of its own; ends with it. A write begins with its temporary file or folder."""
    version = 0
    make_file = tempfile.mkstemp
    make_folder = tempfile.mkdtemp
    tempfile.mkstemp = lambda *given, **named: _begun(make_file, given, named)
    tempfile.mkdtemp = lambda *given, **named: _begun(make_folder, given, named)
    try:
        while True:
            version = 1 - version
            artefact.write(path, version)
            WRITES[1] = WRITES[0]
    finally:
        os._exit(1)


def _begun(make: Callable[..., Any], given: Any, named: Any) -> Any:
    WRITES[0] = (WRITES[0] + 1) % 256
    return make(*given, **named)


def naive(artefact: Artefact) -> Artefact:
    """The same, written where it is to lie, as `open(path, "w")` does."""
    with tempfile.TemporaryDirectory() as folder:
        held = [_content(artefact, Path(folder), n) for n in (0, 1)]

    def write(path: Path, n: int) -> None:
        _begun(lambda: None, (), {})
        for name, data in held[n].items():
            place = path.parent / name
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("wb", buffering=0) as file:
                for begin in range(0, len(data), PIECE):
                    file.write(data[begin : begin + PIECE])

    return replace(artefact, write=write)


def _content(artefact: Artefact, folder: Path, n: int) -> dict[Path, bytes]:
    """What a version consists of, by its place."""
    whole = folder / artefact.name
    artefact.write(whole, n)
    parts = sorted(one for one in whole.rglob("*") if one.is_file()) or [whole]
    return {one.relative_to(folder): one.read_bytes() for one in parts}


def unchecked() -> Any:
    """Takes every checksum out while it is entered: they fit whatever they are held against."""
    fits = contextlib.ExitStack()
    for place in (
        "recording.recording._check_seal",
        "generator.check_sums",
        "lidar.table.check_sums",
        "policy.file.onnx_graph.check_seal",
        "policy.train.checkpoint.check_sealed",
    ):
        fits.enter_context(mock.patch(f"nics_drl_bridge.{place}", return_value=True))
    return fits


def accepted(
    artefact: Artefact, flips: int, rng: np.random.Generator, folder: Path
) -> int:
    """How often a file with one flipped bit was read as if nothing were wrong."""
    path = folder / artefact.name
    good = 0
    artefact.write(path, 0)
    files = sorted(file for file in path.rglob("*") if file.is_file()) or [path]
    for _ in range(flips):
        file = files[int(rng.integers(len(files)))]
        whole = file.read_bytes()
        damaged = bytearray(whole)
        damaged[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        try:
            with contextlib.suppress(
                ValueError
            ):  # read, but as no version that was written
                artefact.version(path)
            good += 1
        except BridgeError:
            pass
        finally:
            file.write_bytes(whole)
    return good


def measure(
    kills: int, flips: int, seed: int, control: str | None = None
) -> dict[str, Any]:
    """All figures over all artefacts, and by artefact.

    Args:
        kills, flips: of each artefact.
        seed: of all that is drawn.
        control: see the registry.
    """
    rng = np.random.default_rng(seed)
    by_artefact = {}
    for artefact in artefacts():
        written = naive(artefact) if control == "naive_writer" else artefact
        with tempfile.TemporaryDirectory() as folder:
            found = torn(written, kills, rng, Path(folder))
        believed = unchecked() if control == "no_checksum" else contextlib.nullcontext()
        with tempfile.TemporaryDirectory() as folder, believed:
            found["accepted_corrupt"] = accepted(artefact, flips, rng, Path(folder))
        by_artefact[artefact.name] = {**found, "flips": flips}
    keys = ("torn", "kills", "kills_during_a_write", "accepted_corrupt", "flips")
    total = {key: sum(one[key] for one in by_artefact.values()) for key in keys}
    return {**total, "artefacts": by_artefact}
