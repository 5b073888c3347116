"""Training checkpoints with everything needed to resume bit-identically; never deployed."""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import check_sealed, seal, write_bytes
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv

FORMAT = "nics_drl_bridge/checkpoint/5"
MOST_BYTES = 4 * 2**30  # maximum size of a file, which includes SAC's whole buffer


def save_checkpoint(
    path: Path, state: dict[str, Any], env: TrainVecEnv, about: dict[str, Any]
) -> None:
    """Writes a checkpoint between two rollouts; `about` identifies the training."""
    content = {"format": FORMAT, "about": json.dumps(about), "state": state}
    write_content(
        path, content | {"envs": [tensors(snapshot(worlds)) for worlds in env.envs]}
    )


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Writes a checkpoint of tensors, numbers and text, completely or not at all."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, seal(buffer.getvalue()))


def read_checkpoint(path: Path, kind: str = FORMAT) -> dict[str, Any]:
    """Reads a checkpoint. Raises ConfigError if it is missing, damaged or of another format."""
    if not path.is_file():
        raise ConfigError(
            f"{path}: no such checkpoint; leave out --resume to start again."
        )
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError("it is larger than any checkpoint")
        with path.open("rb") as file:
            check_sealed(file)
            with zipfile.ZipFile(file) as archive:
                if any(member.compress_type for member in archive.infolist()):
                    raise ValueError("torch never compresses")
            file.seek(0)
            # weights_only blocks code in pickles; before torch 2.6 it had gaps.
            content: Any = torch.load(file, map_location="cpu", weights_only=True)
        _check_tensors(content, size)
        format_name = str(content["format"])
        read = {**content, "about": json.loads(content["about"])}
    except Exception:  # noqa: BLE001 - a damaged file breaks torch in any way
        raise ConfigError(
            f"{path}: is not a training checkpoint, or is damaged; leave out "
            "--resume to start again."
        ) from None
    if format_name != kind:
        raise ConfigError(
            f"{path}: is a {format_name!r}, not a {kind!r}; resume with the same --engine "
            "and version."
        )
    return read


def _check_tensors(content: Any, size: int) -> None:
    """Raises ValueError for a tensor larger than the file, such as one repeated number."""
    parts = content.values() if isinstance(content, dict) else content
    for part in parts if isinstance(content, dict | list | tuple) else ():
        _check_tensors(part, size)
    if (
        isinstance(content, torch.Tensor)
        and content.numel() * content.element_size() > size
    ):
        raise ValueError("a tensor is larger than the file")


def tensors(arrays: dict[str, AnyArray]) -> dict[str, torch.Tensor]:
    """Converts arrays by name to tensors."""
    return {
        name: torch.from_numpy(np.ascontiguousarray(rows))
        for name, rows in arrays.items()
    }


Arrays = dict[str, AnyArray]
MEMORY, DRAWN = "memory.", "drawn."
"""Prefixes of the arrays whose names depend on the current episodes."""


def snapshot(env: BridgeVectorEnv) -> Arrays:
    """Copies everything that changes in a vector env, for a bit-identical `restore`."""
    arrays = dict(env.changing)
    arrays |= {MEMORY + name: rows for name, rows in env.memory.items()}
    arrays |= {DRAWN + name: rows for name, rows in env.simulator.drawn.items()}
    return {name: rows.copy() for name, rows in arrays.items()}


def restore(env: BridgeVectorEnv, state: Mapping[str, AnyArray]) -> None:
    """Restores a snapshot. Raises ConfigError if worlds, robots or task of the env differ."""
    parts: dict[str, Arrays] = {"": {}, MEMORY: {}, DRAWN: {}}
    for name, rows in state.items():
        prefix = next((p for p in (MEMORY, DRAWN) if name.startswith(p)), "")
        parts[prefix][name.removeprefix(prefix)] = np.array(rows)
    targets = env.changing
    arrays = parts[""]
    for name in sorted(arrays.keys() | targets.keys()):
        was, now = (_kind(rows.get(name)) for rows in (arrays, targets))
        if was != now:
            reason = f"{name!r} is {was}, but this env's is {now}"
            raise ConfigError(
                f"state of a vector env: {reason}; make the env with the original arguments."
            )
    for name, target in targets.items():
        target[...] = arrays[name]  # in place: the compiled steps refer to these arrays
    env.memory = parts[MEMORY]
    env.simulator.drawn = parts[DRAWN]
    env.simulator.sort_bodies()
    env.ready = bool((targets["episode"] >= 0).all())


def _kind(rows: AnyArray | None) -> str:
    return "missing" if rows is None else f"{rows.dtype} of shape {rows.shape}"
