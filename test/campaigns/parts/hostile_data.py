"""Recordings, bags, models, black boxes and checkpoints that an attacker would hand in."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from parts.attempt import Attempt, nics
from parts.damaged_bags import samples
from parts.gates import Gate, gate_config

from nics_drl_bridge.config import dump_yaml, parse_yaml
from nics_drl_bridge.extras.bags.info import read_bag_info
from nics_drl_bridge.files import SUMS, hash_bytes, seal, write_sums
from nics_drl_bridge.gate import black_box
from nics_drl_bridge.gate.inputs import Tick
from nics_drl_bridge.generator import (
    MODEL_FILE,
    TABLE_FOLDER,
    builtin_model,
    load_model,
    save_model,
)
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import ARRAYS, LidarTable
from nics_drl_bridge.policy.train.checkpoint import read_checkpoint
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

Rng = np.random.Generator
ROBOT = "ackermann"


@dataclass(frozen=True)
class Whole:
    """Files that have nothing wrong with them.

    Attributes:
        recording, box, model: a recording, a black box, the folder of a model.
        bags: folders, MCAP and SQLite.
    """

    recording: Path
    box: Path
    model: Path
    bags: tuple[Path, ...]


@lru_cache(maxsize=1)
def _whole(folder: Path) -> Whole:
    drive = textbook.record(load_robot(ROBOT), np.random.default_rng(0), duration=8.0)
    save_recording(drive, folder / "whole.npz")
    lidar = load_lidar("paper")
    config = gate_config(load_robot("differential"), lidar)
    entries = []
    gate = Gate(config, lidar)
    for _ in range(20):
        before = gate.state
        gate.now = gate.now + 0.02
        entries.append(black_box.Entry(gate.now, Tick(), before, gate.tick()))
    black_box.write(config, tuple(entries), folder / "whole.jsonl")
    save_model(builtin_model(ROBOT), folder / "whole_model")
    (folder / "bags").mkdir()
    bags = tuple(sample.path for sample in samples(folder / "bags"))
    return Whole(
        folder / "whole.npz", folder / "whole.jsonl", folder / "whole_model", bags
    )


def attempts(rng: Rng, folder: Path) -> Iterator[Attempt]:
    """Without end."""
    whole = _whole(folder)
    makers: tuple[Callable[[], Attempt], ...] = (
        lambda: _recording(rng, folder, whole),
        lambda: _csv(rng, folder),
        lambda: _bag(rng, folder, whole),
        lambda: _bag(rng, folder, whole),
        lambda: _box(rng, folder, whole),
        lambda: _model(rng, folder, whole),
        lambda: _checkpoint(rng, folder),
        lambda: _good(rng, whole),
    )
    while True:
        yield makers[int(rng.integers(len(makers)))]()


def _good(rng: Rng, whole: Whole) -> Attempt:
    bag = whole.bags[int(rng.integers(len(whole.bags)))]
    acts: tuple[tuple[str, Callable[[], object]], ...] = (
        ("recording", lambda: read_recording(whole.recording)),
        ("bag", lambda: read_bag_info(bag)),
        ("bag", lambda: read_recording(bag, load_robot(ROBOT))),
        ("black box", lambda: black_box.replay(whole.box)),
        ("model", lambda: load_model(whole.model)),
        ("seed", lambda: sample_scene(load_world("arena"), 0.2, 2**63 - 1)),
    )
    kind, act = acts[int(rng.integers(len(acts)))]
    return Attempt(kind, "whole", act, "good")


def _npy(descr: str, shape: str, data: bytes) -> bytes:
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + data


def _zip(parts: dict[str, bytes]) -> bytes:
    """An archive with a checksum that fits."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in parts.items():
            archive.writestr(f"{name}.npy", data)
    return seal(buffer.getvalue())


def _recording(rng: Rng, folder: Path, whole: Whole) -> Attempt:
    with np.load(whole.recording) as held:
        arrays = dict(held)
    way = int(rng.integers(8))
    rows = int(10 ** rng.uniform(8, 18))
    name = str(rng.choice([key for key in arrays if key != "meta"]))
    parts = {
        key: _npy(repr(a.dtype.str), str(a.shape), a.tobytes())
        for key, a in arrays.items()
    }
    path = folder / "drive.npz"
    told = f"way {way}, {name}, {rows}"
    verdict = "bad"
    if way == 0:
        parts[name] = _npy("'<f8'", f"({rows},)", b"")
    elif way == 1:
        parts[name] = _npy("'|O'", "(3,)", b"cos\nsystem\n(S'true'\ntR.")
    elif way == 2:
        parts[name] = _npy(
            "'<f8'", f"({120_000_000 + rows % 99},)", bytes(8 * 120_000_000)
        )
    elif way == 3:
        parts[name] = _npy("'<f8'", "(" + "(" * 3000 + ")" * 3000 + ",)", b"")
    elif way == 4:
        parts["meta"] = _npy(f"'<U{rows % 2**31}'", "()", b"")
    elif way == 5:
        meta = json.loads(str(arrays["meta"]))
        key = str(rng.choice(list(meta)))
        meta[key] = [None, "x" * 10**6, {"a": 1}, [[]], 3][int(rng.integers(5))]
        parts = {"meta": _npy_of(np.array(json.dumps(meta)))} | {
            k: v for k, v in parts.items() if k != "meta"
        }
        told = f"meta {key}"
        verdict = "any"
    elif way == 6:
        parts["meta"] = _npy_of(np.array("[" * 100_000))
    else:
        other = arrays[name].astype(str(rng.choice(["S8", "c16", "?", "i1"])))
        parts[name] = _npy_of(other)
        told = f"{name} of type {other.dtype}"
        verdict = "any"
    path.write_bytes(_zip(parts))
    words = ("generate", path, "--robot", ROBOT, "--out", folder / "out")
    act = nics(*words) if rng.random() < 0.2 else _read(path)
    return Attempt("recording", told, act, verdict)


def _npy_of(array: np.ndarray[Any, Any]) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array)
    return buffer.getvalue()


def _read(path: Path) -> Callable[[], object]:
    return lambda: read_recording(path, load_robot(ROBOT))


def _csv(rng: Rng, folder: Path) -> Attempt:
    place = folder / "csv"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    rows = [f"0.5,0.0,{k / 10}" for k in range(300)]
    poses = [f"{k / 20},0,0,0,0,0,1,{k * 100_000_000}" for k in range(300)]
    way = int(rng.integers(6))
    at = int(rng.integers(300))
    if way == 0:
        rows[at] = "1" * int(rng.integers(10**6, 6 * 10**7))
    elif way == 1:
        rows[at] = "0.5," * int(rng.integers(10**5, 10**7))
    elif way == 2:
        poses[at] = '"' + "a\n" * int(rng.integers(10, 10**6))
    elif way == 3:
        rows = ["1,1,1"] * 3_000_000
    elif way == 4:
        rows[at] = f"{'9' * 5000},0,0"
    else:
        rows[at] = "\x00,\x1b[2J,x"
    (place / "cmd.csv").write_text("\n".join(rows), encoding="utf-8")
    (place / "vrpn.csv").write_text("\n".join(poses), encoding="utf-8")
    return Attempt("csv", f"way {way}, row {at}", _read(place))


def _bag(rng: Rng, folder: Path, whole: Whole) -> Attempt:
    """A bag whose metadata were changed so that they do not agree with its file."""
    source = whole.bags[int(rng.integers(len(whole.bags)))]
    bag = folder / "bag"
    shutil.rmtree(bag, ignore_errors=True)
    shutil.copytree(source, bag)
    file = bag / "metadata.yaml"
    data: Any = parse_yaml(file.read_text(encoding="utf-8"), "metadata")
    about = data["rosbag2_bagfile_information"]
    topics = about["topics_with_message_count"]
    k = int(rng.integers(len(topics)))
    ways = (
        "no name",
        "other name",
        "no topic",
        "more",
        "fewer, elsewhere",
        "empty name",
        "type",
        "twice",
        "bomb",
        "tag",
        "files",
        "all to one",
    )
    way = str(rng.choice(ways))
    one = topics[k]
    text = ""
    if way == "no name":
        del one["topic_metadata"]["name"]
    elif way in ("other name", "empty name"):
        one["topic_metadata"]["name"] = "/other" if way == "other name" else ""
    elif way == "no topic":
        del topics[k]
        about["message_count"] -= one["message_count"]
    elif way == "more":
        one["message_count"] += 1
    elif way in ("fewer, elsewhere", "all to one"):
        moved = 1 if way == "fewer, elsewhere" else one["message_count"]
        one["message_count"] -= moved
        topics[k - 1]["message_count"] += moved
    elif way == "type":
        one["topic_metadata"]["type"] = "std_msgs/msg/String"
    elif way == "twice":
        topics.append(one)
    elif way == "files":
        about["relative_file_paths"] = ["../../../../dev/zero"]
    elif way == "bomb":
        text = "k0: &k0 {x: 1}\n" + "".join(
            f"k{i}: &k{i} {{<<: [{', '.join([f'*k{i - 1}'] * 9)}]}}\n"
            for i in range(1, 30)
        )
    else:
        text = "tagged: !!python/object/apply:os.system ['true']\n"
    file.write_text(dump_yaml(data) + text, encoding="utf-8")
    acts = (lambda: read_bag_info(bag), _read(bag), nics("bag", "info", bag))
    return Attempt("bag", f"{source.name}, {way} of {k}", acts[int(rng.integers(3))])


def _box(rng: Rng, folder: Path, whole: Whole) -> Attempt:
    lines = [json.loads(line) for line in whole.box.read_text().splitlines()[:-1]]
    size = int(10 ** rng.uniform(6, 18))
    way = int(rng.integers(6))
    array = {"kind": "array", "type": "<f8", "shape": [size], "data": ""}
    record = lines[int(rng.integers(1, len(lines)))]
    if way == 0:
        record["given"] = {"kind": "Scan", "ranges": array}
    elif way == 1:
        record["given"] = array | {"type": f"<U{size % 2**30}"}
    elif way == 2:
        record["now"] = [None, "x", 1e308, [], -1e308][int(rng.integers(5))]
    elif way == 3:
        key = str(rng.choice(list(lines[0]["config"])))
        lines[0]["config"][key] = [None, 1e308, "x" * 5000, [], size][
            int(rng.integers(5))
        ]
    elif way == 4:
        record["given"] = _nested(int(rng.integers(1200, 20_000)))
    else:
        lines += [record] * (100_000 + size % 300_000)
    text = "".join(_line(line) for line in lines)
    path = folder / "stop.jsonl"
    path.write_text(text + json.dumps({"sha256": hash_bytes(text.encode())}) + "\n")
    verdict = "any" if way in (2, 3, 5) else "bad"
    act = (
        nics("explain", path) if rng.random() < 0.3 else lambda: black_box.replay(path)
    )
    return Attempt("black box", f"way {way}, {size}", act, verdict)


def _nested(depth: int) -> str:
    return "[" * depth + "]" * depth


def _line(record: Any) -> str:
    given = record.get("given")
    if isinstance(given, str):  # brackets, too deep for the writer
        return (
            json.dumps(record | {"given": 0}).replace('"given": 0', f'"given": {given}')
            + "\n"
        )
    return json.dumps(record) + "\n"


def _model(rng: Rng, folder: Path, whole: Whole) -> Attempt:
    """A model with other values in it and no checksum, or a table of false shapes."""
    place = folder / "model"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(whole.model, place)
    if rng.random() < 0.3:
        return _table(rng, place / TABLE_FOLDER)
    lines = (place / SUMS).read_text(encoding="utf-8").splitlines(keepends=True)
    listed = [line for line in lines if not line.endswith(f"  {MODEL_FILE}\n")]
    (place / SUMS).write_text("".join(listed), encoding="utf-8")
    text = (place / MODEL_FILE).read_text(encoding="utf-8")
    data: Any = parse_yaml(text, "model")
    inner: Any = data
    told = []
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = keys[int(rng.integers(len(keys)))]
        told.append(str(key))
        if not isinstance(inner[key], dict | list) or not inner[key]:
            break
        inner = inner[key]
    values = (None, "x" * 3000, -1, 1e308, 10**20, [], {}, [[1.0]], 1e-320, True)
    which = int(rng.integers(len(values)))
    inner[key] = values[which]
    (place / MODEL_FILE).write_text(dump_yaml(data), encoding="utf-8")
    return Attempt(
        "model", f"{'.'.join(told)} is {which}", lambda: load_model(place), "any"
    )


def _table(rng: Rng, place: Path) -> Attempt:
    """A table with one array of a false header, whose checksums are right."""
    name = str(rng.choice(ARRAYS))
    way = int(rng.integers(5))
    size = int(10 ** rng.uniform(8, 30))
    ways = (
        _npy("'<f4'", f"({size},)", b""),
        _npy("'<f4'", f"({2**32}, {2**32})", b""),
        _npy("'|O'", "(3,)", b"cos\nsystem\n(S'true'\ntR."),
        _npy("'<f4'", "(" * 3000, b""),
        _zip({"rows": bytes(size % 10**7)}),
    )
    (place / f"{name}.npy").write_bytes(ways[way])
    write_sums(place)
    return Attempt(
        "model", f"table, way {way}, {name}, {size}", lambda: LidarTable.load(place)
    )


def _checkpoint(rng: Rng, folder: Path) -> Attempt:
    import torch

    path, way, buffer = folder / "checkpoint.pt", int(rng.integers(4)), io.BytesIO()
    if way == 0:
        torch.save({"format": "x" * 10**6, "about": "[" * 10**6}, buffer)
    elif way == 1:
        torch.save({"format": Path("x"), "about": print}, buffer)
    elif way == 2:
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("archive/data.pkl", bytes(900_000_000))
            archive.writestr("archive/version", b"3\n")
    else:
        torch.save(torch.zeros(1).expand(2**40), buffer)
    path.write_bytes(seal(buffer.getvalue()))
    return Attempt("checkpoint", f"way {way}", lambda: read_checkpoint(path))
