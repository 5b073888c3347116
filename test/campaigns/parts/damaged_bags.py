"""Bags that are cut off or whose bytes are changed: what reading them gives."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.extras.bags.info import read_bag_info
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import load_robot

ROBOT = "ackermann"
SECONDS = 8.0
MOST_CHANGES = 8
"""Bytes changed at once, in one file of a bag."""

Held = dict[str, tuple[str, list[int], list[str]]]
"""Type, times of receipt and digests of the messages of each topic."""


@dataclass
class Score:
    """What went wrong.

    Attributes:
        tracebacks: exceptions that are not one sentence for people.
        silent_partial: bags that were read without a word although something was missing, or,
            of bags with checksums, changed.
        refused, accepted: how many bags were.
        told: some words on each of what went wrong.
    """

    tracebacks: int = 0
    silent_partial: int = 0
    refused: int = 0
    accepted: int = 0
    told: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Sample:
    """A bag that is whole.

    Attributes:
        path: its folder.
        sealed: whether it carries checksums.
        held: what is in it.
    """

    path: Path
    sealed: bool
    held: Held


def samples(folder: Path) -> list[Sample]:
    """The same drive as this package writes it, and as rosbags does: MCAP and SQLite."""
    robot = load_robot(ROBOT)
    drive = textbook.record(robot, np.random.default_rng(0), duration=SECONDS)
    ours = folder / "ours_mcap"
    write_bag(drive, ours, robot, "mcap")
    write_bag(drive, folder / "ours_sqlite3", robot, "sqlite3")
    _foreign(ours, folder / "foreign_mcap", "none")
    _foreign(ours, folder / "foreign_packed", "storage")
    names = ("ours_mcap", "ours_sqlite3", "foreign_mcap", "foreign_packed")
    return [
        Sample(folder / name, name == "ours_mcap", _held(folder / name))
        for name in names
    ]


def _foreign(source: Path, path: Path, compression: str) -> None:
    """A copy by rosbags alone, without checksums."""
    from rosbags.rosbag2 import (
        CompressionFormat,
        CompressionMode,
        Reader,
        StoragePlugin,
        Writer,
    )

    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with Reader(source) as reader, writer:
        connections = {
            c.id: writer.add_connection(
                c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest
            )
            for c in reader.connections
        }
        for connection, ns, data in reader.messages():
            writer.write(connections[connection.id], ns, data)


def _held(path: Path) -> Held:
    with open_bag(path) as bag:
        told: Held = {}
        for topic, kind in bag.types.items():
            rows = bag.read_serialized(topic)
            digests = [sha256(data).hexdigest() for _, data in rows]
            told[topic] = kind, [ns for ns, _ in rows], digests
        return told


def truncations(
    sample: Sample, count: int, rng: np.random.Generator
) -> Iterator[dict[str, bytes]]:
    """Files of a bag, one of them cut off anywhere."""
    for _ in range(count):
        files = _files(sample.path)
        name = str(rng.choice(sorted(files)))
        yield files | {name: files[name][: int(rng.integers(len(files[name])))]}


def corruptions(
    sample: Sample, count: int, rng: np.random.Generator
) -> Iterator[dict[str, bytes]]:
    """Files of a bag, with some bits flipped or bytes replaced in one of them."""
    for _ in range(count):
        files = _files(sample.path)
        name = str(rng.choice(sorted(files)))
        data = np.frombuffer(files[name], dtype=np.uint8).copy()
        places = rng.integers(len(data), size=rng.integers(1, MOST_CHANGES + 1))
        if rng.random() < 0.5:
            data[places] ^= np.uint8(1 << rng.integers(8))
        else:
            data[places] = rng.integers(256, size=len(places), dtype=np.uint8)
        yield files | {name: data.tobytes()}


def _files(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def judge(sample: Sample, files: dict[str, bytes], folder: Path, score: Score) -> None:
    """Reads a damaged bag in every way that there is."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    bag = folder / sample.path.name
    bag.mkdir()
    for name, data in files.items():
        (bag / name).write_bytes(data)
    refused = False
    for act in (_same, _informed, _read):
        try:
            fault = act(bag, sample)
        except BridgeError as error:
            refused = True
            fault = "" if "\n" not in str(error) else "a sentence of several lines"
        except Exception as error:  # noqa: BLE001 - these are what is counted
            score.tracebacks += 1
            score.told.append(f"{act.__name__}: {type(error).__name__}: {error}")
            continue
        if fault:
            score.silent_partial += 1
            score.told.append(f"{sample.path.name}: {act.__name__}: {fault}")
    score.refused += refused
    score.accepted += not refused


def _same(bag: Path, sample: Sample) -> str:
    """What was given without a word has to be what was written."""
    held = _held(bag)
    if {t: v[:2] for t, v in held.items()} != {
        t: v[:2] for t, v in sample.held.items()
    }:
        return "topics, types, counts or times differ"
    if sample.sealed and held != sample.held:
        return "messages differ"
    return ""


def _informed(bag: Path, sample: Sample) -> str:
    told = {topic.topic: topic.count for topic in read_bag_info(bag).topics}
    return (
        ""
        if told == {t: len(v[1]) for t, v in sample.held.items()}
        else "counts differ"
    )


def _read(bag: Path, sample: Sample) -> str:
    streams: Any = read_recording(bag, load_robot(ROBOT)).streams
    fits = len(streams["command"].t) == len(sample.held["/cmd_vel"][1])
    return "" if fits else "commands are missing"


def damage_bags(folder: Path, cuts: int, changes: int, seed: int) -> Score:
    """Cuts and changes so many bags, and counts what goes wrong."""
    score = Score()
    rng = np.random.default_rng(seed)
    every = samples(folder)
    for index, sample in enumerate(every):
        share = [n // len(every) + (index < n % len(every)) for n in (cuts, changes)]
        for files in truncations(sample, share[0], rng):
            judge(sample, files, folder / "damaged", score)
        for files in corruptions(sample, share[1], rng):
            judge(sample, files, folder / "damaged", score)
    return score
