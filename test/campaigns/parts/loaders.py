"""What the package reads from disk: how each kind is written whole, read, changed and sealed."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import bags
import numpy as np
import onnx

from nics_drl_bridge.config import dump_yaml, parse_yaml, share_folder
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.extras.bags.info import read_bag_info
from nics_drl_bridge.files import SUMS, hash_bytes, seal, write_bytes, write_sums
from nics_drl_bridge.gate import black_box
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.inputs import Tick
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.generator import MODEL_FILE, builtin_model, load_model, save_model
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.policy.file import onnx_graph
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.settings import (
    TrainingSettings,
    load_training,
    open_training,
)
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.bag_file import open_bag
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import load_recording, save_recording
from nics_drl_bridge.recording.topic_roles import load_topic_roles
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

ROBOT = "ackermann"
Tree = tuple[Callable[[Path], Any], Callable[[Path, Any], None]]
TRAINING = {
    "robot": "differential",
    "worlds": {"empty": 4},
    "steps": 64,
    "hidden": [8],
    "ppo": {"rollout": 16, "batch": 64, "epochs": 1},
}


@dataclass(frozen=True)
class Loader:
    """One kind of input."""

    name: str  # of the file or folder
    write: Callable[
        [Path, int], object
    ]  # writes version 0 or 1 of a whole one to a path
    # returns what tells a version from another; raises BridgeError
    read: Callable[[Path], object]
    # True: any changed byte has to be refused; otherwise what is read has to be whole
    sealed: bool = True
    # the YAML file, if any: within the folder, or the file itself if `.`
    text: str = ""
    # opens and saves values that can be replaced; by default those of `text`
    tree: Tree | None = None
    # makes checksums fit a changed text
    reseal: Callable[[Path], None] = lambda path: None
    free: bool = False  # changed bytes may be read as anything
    command: tuple[
        str, ...
    ] = ()  # of `nics` before the path, of a command that reads it


# Recordings, models, tables, black boxes, policies and checkpoints: what the package writes.


def _hash(array: Any) -> str:
    return sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


@lru_cache
def _drive(version: int) -> Any:
    rng = np.random.default_rng(version)
    return textbook.record(load_robot(ROBOT), rng, duration=8.0)


def _open_meta(path: Path) -> Any:
    with np.load(path) as arrays:
        return json.loads(str(arrays["meta"]))


def _save_meta(path: Path, meta: Any) -> None:
    with np.load(path) as held:
        arrays = dict(held)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays | {"meta": np.array(json.dumps(meta))})
    path.write_bytes(seal(buffer.getvalue()))


def _write_model(path: Path, version: int) -> None:
    model = builtin_model("differential")
    save_model(replace(model, report="another\n") if version else model, path)


def _unlist_model(path: Path) -> None:
    lines = (path / SUMS).read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.endswith(f"  {MODEL_FILE}\n")]
    (path / SUMS).write_text("".join(kept), encoding="utf-8")


def _write_table(path: Path, version: int) -> None:
    builtin_model(("differential", ROBOT)[version]).table.save(path)


@lru_cache
def _gate_entries(version: int) -> tuple[Any, tuple[black_box.Entry, ...]]:
    model = builtin_model("differential")
    config = configure_gate(model, "differential", shielded=False)
    gate = Gate(config, model.lidar)
    entries = []
    for _ in range((5, 9)[version]):
        before = gate.state
        gate.now += 0.02
        entries.append(black_box.Entry(gate.now, Tick(), before, gate.tick()))
    return config, tuple(entries)


def _open_box(path: Path) -> Any:
    return [json.loads(line) for line in path.read_text().splitlines()[:-1]]


def _save_box(path: Path, lines: Any) -> None:
    text = "".join(json.dumps(line) + "\n" for line in lines)
    path.write_text(text + json.dumps({"sha256": hash_bytes(text.encode())}) + "\n")


@lru_cache
def _policy_bytes(version: int) -> bytes:
    import torch

    from nics_drl_bridge.policy.train.export import export_policy

    model = builtin_model("differential")
    task = make_task("navigation", model, {"scan": 36})
    size = task.observation_space.shape[0]
    actor = torch.nn.Linear(size, len(model.robot.command))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "policy.onnx"
        export_policy(actor, task, model, file, provenance={"seed": version})
        return file.read_bytes()


def _open_contract(path: Path) -> Any:
    return json.loads(onnx_graph.find_contract_text(onnx.load(path), "file"))


def _save_contract(path: Path, data: Any) -> None:
    proto = onnx.load(path)
    if isinstance(data, dict):
        data["graph_sha256"] = onnx_graph.hash_graph(proto)
    del proto.metadata_props[:]
    onnx.helper.set_model_props(proto, {onnx_graph.KEY: json.dumps(data)})
    path.write_bytes(onnx_graph.add_seal(proto.SerializeToString(deterministic=True)))


@lru_cache
def _checkpoint_bytes(version: int) -> bytes:
    from nics_drl_bridge.policy.train.run import CHECKPOINT, train

    with tempfile.TemporaryDirectory() as folder:
        settings = TrainingSettings.model_validate(TRAINING)
        train(*open_training(settings), settings, version, Path(folder))
        return (Path(folder) / CHECKPOINT).read_bytes()


def _read_checkpoint(path: Path) -> object:
    from nics_drl_bridge.policy.train.checkpoint import read_checkpoint

    return read_checkpoint(path)["about"]["seed"]


WRITTEN = (
    Loader(
        "drive.npz",
        lambda path, version: save_recording(_drive(version), path),
        lambda path: _hash(load_recording(path).pose.values),
        tree=(_open_meta, _save_meta),
        command=("generate", "--robot", ROBOT, "--out", "generated"),
    ),
    Loader(
        "model",
        _write_model,
        lambda path: load_model(path).report,
        text=MODEL_FILE,
        reseal=_unlist_model,
        command=("doctor", "--model"),
    ),
    Loader(
        "table",
        _write_table,
        lambda path: _hash(LidarTable.load(path).rows),
        reseal=write_sums,
    ),
    Loader(
        "stop.jsonl",
        lambda path, version: black_box.write(*_gate_entries(version), path),
        lambda path: len(black_box.replay(path).entries),
        tree=(_open_box, _save_box),
        command=("explain",),
    ),
    Loader(
        "policy.onnx",
        lambda path, version: write_bytes(path, _policy_bytes(version)),
        lambda path: load_policy(path).contract.provenance.get("seed"),
        tree=(_open_contract, _save_contract),
        command=("policy", "info"),
    ),
    Loader(
        "checkpoint.npz",
        lambda path, version: write_bytes(path, _checkpoint_bytes(version)),
        _read_checkpoint,
    ),
)


# Bags, by this package and by others, and CSV folders: what was recorded elsewhere.


def _make_bag(
    name: str, write: Callable[[Path, int], object], is_checked: bool = False
) -> Loader:
    """Returns the loader of a bag, which is read in every way that there is."""

    def read(path: Path) -> object:
        held = {}
        with open_bag(path) as bag:
            for topic, kind in bag.types.items():
                rows = [(ns, bytes(data)) for ns, data in bag.read_serialized(topic)]
                held[topic] = kind, rows if is_checked else [ns for ns, _ in rows]
        counts = {topic.topic: topic.count for topic in read_bag_info(path).topics}
        streams: Any = read_recording(path, load_robot(ROBOT)).streams
        return held, counts, len(streams["command"].t)

    command = ("bag", "info")
    return Loader(
        name, write, read, sealed=False, text="metadata.yaml", command=command
    )


def _write_own(storage: str, path: Path, version: int) -> None:
    write_bag(_drive(version), path, load_robot(ROBOT), storage)


def _write_foreign(compression: str, path: Path, version: int) -> None:
    bags.write(path, bags.drive(), "mcap", compression)  # without checksums


def _write_csv(path: Path, version: int) -> None:
    path.mkdir()
    rows = [f"0.5,0.0,{k / 10}" for k in range(300)]
    poses = [f"{k / 20},0,0,0,0,0,1,{k * 100_000_000}" for k in range(300)]
    (path / "cmd.csv").write_text("\n".join(rows), encoding="utf-8")
    (path / "vrpn.csv").write_text("\n".join(poses), encoding="utf-8")


RECORDED = (
    _make_bag("ours_mcap", partial(_write_own, "mcap"), is_checked=True),
    _make_bag("ours_sqlite3", partial(_write_own, "sqlite3")),
    _make_bag("foreign_mcap", partial(_write_foreign, "none")),
    _make_bag("foreign_packed", partial(_write_foreign, "storage")),
    Loader(
        "csv",
        _write_csv,
        lambda path: read_recording(path, load_robot(ROBOT)),
        free=True,
    ),
)


# YAML: configurations of each kind.


def _read_lidar(path: str) -> object:
    shapes = [Circle(radius=0.2)]
    scanner = make_scanner(load_lidar(path), shapes, renderer="exact")
    return scanner.scan([0.0, 0.0, 0.0], scanner.place(shapes, [[1.0, 0.5, 0.0]]))


def _read_world(path: str) -> object:
    return sample_scene(load_world(path), 0.2, 0)


CONFIGS: dict[str, Callable[[str], object]] = {
    "robots/ackermann": load_robot,
    "lidars/rplidar_a2": _read_lidar,
    "worlds/arena": _read_world,
    "worlds/crowd": _read_world,
    "limits/differential": lambda path: load_limits(path, load_robot("differential")),
    "randomisation/strong": load_randomisation,
    "training/navigation_differential": load_training,
    "maps/room": lambda path: load_map(path).arrays,
}
COMMANDS = {
    "robots": ("bake", "--robot"),
    "lidars": ("bake", "--lidar"),
    "worlds": ("bake", "--world"),
    "training": ("train", "--settings"),
}


def _make_config(kind: str, read: Callable[[str], object]) -> Loader:
    source = share_folder() / "config" / f"{kind}.yaml"

    def write(path: Path, version: int) -> None:
        shutil.copy(source, path)
        if kind.startswith("maps"):
            shutil.copy(source.with_suffix(".pgm"), path.parent)

    return Loader(
        f"{kind.replace('/', '_')}.yaml",
        write,
        lambda path: read(str(path)),
        text=".",
        free=True,
        command=COMMANDS.get(kind.split("/")[0], ()),
    )


def _write_topics(path: Path, version: int) -> None:
    text = "cmd_vel: /cmd_vel\nodom: /odom\nstamps: header\n"
    path.write_text(text, encoding="utf-8")


LOADERS = (
    *WRITTEN,
    *RECORDED,
    *(_make_config(kind, read) for kind, read in CONFIGS.items()),
    Loader("topics.yaml", _write_topics, load_topic_roles, text=".", free=True),
)


def find_tree(loader: Loader) -> Tree | None:
    """Returns how the values of an input are opened and saved, or None."""
    if loader.tree is not None or not loader.text:
        return loader.tree

    def open_yaml(path: Path) -> Any:
        return parse_yaml((path / loader.text).read_text(encoding="utf-8"), "whole")

    def save_yaml(path: Path, data: Any) -> None:
        (path / loader.text).write_text(dump_yaml(data), encoding="utf-8")
        loader.reseal(path)

    return open_yaml, save_yaml
