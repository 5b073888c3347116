"""Does a kill ever leave a torn file? Writers are killed with SIGKILL at random moments.

What the package writes (recordings, models, lidar tables, black boxes, policies, checkpoints) is
written in two versions in turn; after each kill one of them, whole, has to be there.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from mmap import mmap
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Bars, Given, Result, at_least, at_most, run_campaign
from parts.loaders import WRITTEN, Loader

from nics_drl_bridge import files
from nics_drl_bridge.errors import BridgeError

LONGEST_S = 0.05  # within which a writer is killed after it began to write
STARTS_S = 10.0  # within which it begins
LEAST_DURING = 0.25  # fraction of the kills that have to hit a write
PIECE = 4096  # bytes that a naive writer writes at once, as a buffered file does
# Shared with the writer: numbers of writes that began, and that ended, modulo 256.
WRITES = mmap(-1, 2)
BEGUN = get_context("fork").Semaphore(0)  # one for each write that began


def count_torn(
    loader: Loader, kills: int, rng: np.random.Generator, folder: Path
) -> dict[str, int]:
    """Counts what is neither version, and the kills that hit a write."""
    path = folder / loader.name
    versions = []
    for version in (1, 0):
        loader.write(path, version)
        versions.append(loader.read(path))
    torn = 0
    during = 0
    for _ in range(kills):
        WRITES[:] = bytes(2)
        while BEGUN.acquire(block=False):  # writes of the last one
            pass
        child = os.fork()
        if child == 0:
            _write_for_ever(loader, path)
        BEGUN.acquire(timeout=STARTS_S)
        moment_s = rng.uniform(0.0, LONGEST_S)
        killer = threading.Timer(moment_s, os.kill, (child, signal.SIGKILL))
        killer.start()
        os.waitpid(child, 0)
        killer.join()
        during += WRITES[0] != WRITES[1]
        try:
            is_whole = loader.read(path) in versions
        except BridgeError:
            is_whole = False
        if not is_whole:
            torn += 1
            _remove(path)
            loader.write(path, 0)
        for rest in folder.glob(f".{loader.name}.*"):
            _remove(rest)
    return {"torn": torn, "kills": kills, "kills_during_a_write": during}


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _write_for_ever(loader: Loader, path: Path) -> None:
    """In a process of its own; ends with it. A write begins with its hidden file or folder."""
    files.make_hidden_name = _note_begin(files.make_hidden_name)
    version = 0
    try:
        while True:
            version = 1 - version
            loader.write(path, version)
            WRITES[1] = WRITES[0]
    finally:
        os._exit(1)


def _note_begin(make: Callable[..., Any]) -> Callable[..., Any]:
    def make_and_note(*given: Any, **named: Any) -> Any:
        WRITES[0] = (WRITES[0] + 1) % 256
        BEGUN.release()
        return make(*given, **named)

    return make_and_note


def write_naively(loader: Loader) -> Loader:
    """Returns the loader that writes where the file is to lie, as `open(path, "w")` does."""
    contents: list[dict[Path, bytes]] = []
    for version in (0, 1):
        with tempfile.TemporaryDirectory() as name:
            whole = Path(name) / loader.name
            loader.write(whole, version)
            parts = sorted(one for one in whole.rglob("*") if one.is_file()) or [whole]
            contents.append({one.relative_to(name): one.read_bytes() for one in parts})

    def write(path: Path, version: int) -> None:
        _note_begin(lambda: None)()
        for name, data in contents[version].items():
            place = path.parent / name
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("wb", buffering=0) as file:
                for begin in range(0, len(data), PIECE):
                    file.write(data[begin : begin + PIECE])

    return replace(loader, write=write)


def measure(given: Given) -> Result:
    """Counts over all that the package writes, and by its kind."""
    rng = np.random.default_rng(given.seed)
    found = {}
    for loader in WRITTEN:
        writer = write_naively(loader) if given.control == "naive_writer" else loader
        with tempfile.TemporaryDirectory() as folder:
            found[loader.name] = count_torn(writer, given.kills, rng, Path(folder))
    keys = ("torn", "kills", "kills_during_a_write")
    total = {key: sum(one[key] for one in found.values()) for key in keys}
    return {**total, "by_kind": found}


def set_bars(result: Result) -> Bars:
    during = at_least(max(1.0, LEAST_DURING * result["kills"]))
    return {"torn": at_most(0), "kills_during_a_write": during}


if __name__ == "__main__":
    run_campaign(measure, set_bars, {"kills": (300, "of each kind of file"), "seed": 0})
