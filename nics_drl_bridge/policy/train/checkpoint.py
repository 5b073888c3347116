"""Training checkpoints with everything needed to resume bit-identically; never deployed."""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import check_sealed, seal, write_bytes
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.policy.train.worlds import TrainingWorlds

FORMAT = "nics_drl_bridge/checkpoint/6"
MOST_TEXT = 2**24
MOST_BYTES = 4 * 2**30  # maximum size of a file, which includes SAC's whole buffer
CONTENT = "content"  # name of the array that holds everything else as JSON text
ARRAY = "array"
ITEMS = "items"
"""Keys in the JSON text: the name of an array, and the keys and values of a dict."""


def save_checkpoint(
    path: Path, state: dict[str, Any], worlds: TrainingWorlds, about: dict[str, Any]
) -> None:
    """Writes a checkpoint between two rollouts; `about` identifies the training."""
    content = {"format": FORMAT, "about": about, "state": state}
    write_content(path, content | {"envs": [snapshot(env) for env in worlds.envs]})


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Writes a checkpoint, completely or not at all.

    It may hold arrays, tensors, numbers and text in dicts and lists.
    """
    arrays: dict[str, AnyArray] = {}
    text = json.dumps(_take_out_arrays(content, arrays))
    arrays[CONTENT] = np.frombuffer(text.encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, seal(buffer.getvalue()))


def _take_out_arrays(content: Any, arrays: dict[str, AnyArray]) -> Any:
    """Returns content as JSON allows it; moves its arrays and tensors into `arrays`."""
    if isinstance(content, dict):
        items = [[key, _take_out_arrays(content[key], arrays)] for key in content]
        return {ITEMS: items}
    if isinstance(content, list | tuple):
        return [_take_out_arrays(part, arrays) for part in content]
    if content is None or isinstance(content, bool | int | float | str):
        return content
    name = f"array_{len(arrays)}"
    arrays[name] = np.asarray(content)
    return {ARRAY: name}


def _put_back_arrays(content: Any, arrays: dict[str, AnyArray]) -> Any:
    """Reverses `_take_out_arrays`; each array belongs to one place only."""
    if isinstance(content, list):
        return [_put_back_arrays(part, arrays) for part in content]
    if not isinstance(content, dict):
        return content
    if ARRAY in content:
        return arrays.pop(content[ARRAY])
    return {key: _put_back_arrays(value, arrays) for key, value in content[ITEMS]}


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
                    raise ValueError("numpy compresses only on request")
            file.seek(0)
            with np.load(file, allow_pickle=False) as stored:
                arrays = dict(stored)
            text = arrays.pop(CONTENT)
            if text.nbytes > MOST_TEXT:
                raise ValueError("its text is longer than that of any checkpoint")
            read = dict(_put_back_arrays(json.loads(text.tobytes()), arrays))
        format_name = str(read["format"])
        if not isinstance(read["about"], dict):
            raise ValueError("it does not say which training it belongs to")
    except Exception:  # noqa: BLE001 - a damaged file breaks numpy in any way
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
