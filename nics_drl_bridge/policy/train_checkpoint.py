"""Checkpoints of a training, all that it needs to continue bit-identically; none is deployed."""

import io
import json
import time
import zipfile
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import check_sealed, sealed, write_bytes
from nics_drl_bridge.policy.train_algorithms import RECENT
from nics_drl_bridge.policy.train_vec_env import TrainVecEnv
from nics_drl_bridge.policy.training_settings import TrainingSettings

FORMAT = "nics_drl_bridge/checkpoint/2"
MOST_BYTES = 4 * 2**30  # maximum size of a file, which contains all of SAC's buffer
COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining")
LAST = ("_last_obs", "_last_episode_starts")
REPLAYED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save_checkpoint(
    path: Path, algorithm: BaseAlgorithm, env: TrainVecEnv, about: dict[str, Any]
) -> None:
    """Writes a checkpoint between two roll-outs; `about` identifies the training."""
    replay: dict[str, Any] = {}
    if isinstance(algorithm, OffPolicyAlgorithm):
        buffer: Any = algorithm.replay_buffer
        rows = {name: getattr(buffer, name)[: buffer.size()] for name in REPLAYED}
        replay = {"pos": buffer.pos, "full": buffer.full, **_tensors(rows)}
    content = {
        "format": FORMAT,
        "about": json.dumps(about),
        "parameters": algorithm.get_parameters(),
        "variables": {  # other than the networks: the temperature of SAC
            name: getattr(algorithm, name).detach().clone()
            for name in algorithm._get_torch_save_params()[1]
        },
        "counters": {name: getattr(algorithm, name) for name in COUNTERS},
        "recent": list(algorithm.ep_success_buffer or ()),
        "last": _tensors({name: getattr(algorithm, name) for name in LAST}),
        "replay": replay,
        "random": _random_state(algorithm),
        "envs": [_tensors(snapshot(one)) for one in env.envs],
    }
    write_content(path, content)


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Writes a checkpoint of tensors, numbers and text, completely or not at all."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, sealed(buffer.getvalue()))


def read_checkpoint(path: Path, kind: str = FORMAT) -> dict[str, Any]:
    """Reads a checkpoint of a format; ConfigError if it is missing, damaged, or another kind."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such checkpoint; leave out --resume to begin anew.")
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ValueError("it is larger than any checkpoint")
        with path.open("rb") as file:
            check_sealed(file)
            with zipfile.ZipFile(file) as archive:
                if any(member.compress_type for member in archive.infolist()):
                    raise ValueError("torch packs nothing")
            file.seek(0)
            # weights_only blocks whatever else a pickle could do; before torch 2.6 it had gaps.
            content: Any = torch.load(file, map_location="cpu", weights_only=True)
        _check_tensors(content, size)
        found = str(content["format"])
        read = {**content, "about": json.loads(content["about"])}
    except Exception:  # noqa: BLE001 - a damaged file breaks torch in any way
        reason = "is no checkpoint of a training, or a damaged one"
        raise ConfigError(f"{path}: {reason}; leave out --resume to begin anew.") from None
    if found != kind:
        raise ConfigError(f"{path}: is a {found!r}, not a {kind!r}; resume with the same --engine.")
    return read


def _check_tensors(content: Any, size: int) -> None:
    """Raises ValueError for a tensor larger than the file, such as one repeated number."""
    parts = content.values() if isinstance(content, dict) else content
    for part in parts if isinstance(content, dict | list | tuple) else ():
        _check_tensors(part, size)
    if isinstance(content, torch.Tensor) and content.numel() * content.element_size() > size:
        raise ValueError("a tensor is larger than the file")


def resume(content: dict[str, Any], algorithm: BaseAlgorithm, env: TrainVecEnv) -> None:
    """Puts a checkpoint into an algorithm and an env made with the same arguments."""
    algorithm.set_parameters(content["parameters"], exact_match=True)
    for name, value in content["variables"].items():
        getattr(algorithm, name).data.copy_(value)
    for name, value in content["counters"].items():
        setattr(algorithm, name, value)
    size = algorithm._stats_window_size
    algorithm.ep_success_buffer = deque(content["recent"], maxlen=size)
    algorithm.ep_info_buffer = deque(maxlen=size)
    for name, value in content["last"].items():
        setattr(algorithm, name, value.numpy().copy())
    for one, state in zip(env.envs, content["envs"], strict=True):
        restore(one, {name: value.numpy() for name, value in state.items()})
    if isinstance(algorithm, OffPolicyAlgorithm):
        buffer: Any = algorithm.replay_buffer
        replay = content["replay"]
        buffer.pos, buffer.full = replay["pos"], replay["full"]
        for name in REPLAYED:
            getattr(buffer, name)[: buffer.size()] = replay[name].numpy()
    _set_random_state(algorithm, content["random"])


def _tensors(arrays: dict[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(rows)) for name, rows in arrays.items()}


def _random_state(algorithm: BaseAlgorithm) -> dict[str, Any]:
    shared = np.random.get_state(legacy=False)  # noqa: NPY002 - Stable-Baselines3 draws from it
    spaces = algorithm.action_space.np_random.bit_generator.state
    return {
        "torch": torch.get_rng_state(),
        "numpy": json.dumps(shared, default=lambda array: array.tolist()),
        "actions": json.dumps(spaces),
    }


def _set_random_state(algorithm: BaseAlgorithm, content: dict[str, Any]) -> None:
    set_random_seed(0)
    torch.set_rng_state(content["torch"])
    shared = json.loads(content["numpy"])
    shared["state"]["key"] = np.array(shared["state"]["key"], np.uint32)
    np.random.set_state(shared)  # noqa: NPY002 - as above
    algorithm.action_space.np_random.bit_generator.state = json.loads(content["actions"])


TOLD_S = 0.2  # minimum time between two reports of the progress [s]


@dataclass(frozen=True)
class Progress:
    """Progress of a training."""

    seed: int
    steps: int  # environment steps done
    total: int
    success: float  # shares of the last 1000 episodes; NaN before the first has ended
    collision: float
    steps_per_s: float  # since this process began or resumed it
    env_share: float  # share of the wall time that went to the simulator


Save = Callable[[], None]
Tell = Callable[[Progress], None]


class Companion(BaseCallback):
    """Callback that monitors each step and roll-out: calls `tell`, and `save` between roll-outs."""

    def __init__(
        self, env: TrainVecEnv, seed: int, settings: TrainingSettings, save: Save, tell: Tell
    ) -> None:
        super().__init__()
        self._env, self._seed, self._save, self._tell = env, seed, save, tell
        self._total, self._every = settings.steps, settings.checkpoint_every
        self._collisions: deque[bool] = deque(maxlen=RECENT)

    def _on_training_start(self) -> None:
        self._begin = self._told = time.perf_counter()
        self._busy = self._env.stepping_s
        self._first = self._saved = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps // self._every > self._saved // self._every:
            self._save()
            self._saved = self.model.num_timesteps

    def _on_step(self) -> bool:
        for n in np.flatnonzero(self.locals["dones"]):
            self._collisions.append(bool(self.locals["infos"][n].get("collision", False)))
        return True

    def _on_rollout_end(self) -> None:
        now = time.perf_counter()
        if now - self._told < TOLD_S and self.num_timesteps < self._total:
            return
        self._told = now
        taken = max(now - self._begin, 1e-9)
        recent = self.model.ep_success_buffer, self._collisions
        success, collision = (float(np.mean(r)) if r else np.nan for r in recent)
        progress = Progress(
            self._seed, self.num_timesteps, self._total, success, collision,
            (self.num_timesteps - self._first) / taken,
            (self._env.stepping_s - self._busy) / taken,
        )  # fmt: skip
        self.logger.record("rollout/collision_rate", progress.collision)
        self.logger.record("time/env_share", progress.env_share)
        self._tell(progress)


Arrays = dict[str, NDArray[Any]]
MEMORY, DRAWN = "memory.", "drawn."
"""Prefixes of the arrays whose names depend on the running episodes."""


def snapshot(env: BridgeVectorEnv) -> Arrays:
    """Copies all that changes in a vector env, from which `restore` continues bit-identically."""
    found = dict(env.changing)
    found |= {MEMORY + name: rows for name, rows in env.memory.items()}
    found |= {DRAWN + name: rows for name, rows in env.simulator.drawn.items()}
    return {name: rows.copy() for name, rows in found.items()}


def restore(env: BridgeVectorEnv, state: Mapping[str, NDArray[Any]]) -> None:
    """Puts a snapshot into a vector env; ConfigError if its worlds, robots or task are others."""
    parts: dict[str, Arrays] = {"": {}, MEMORY: {}, DRAWN: {}}
    for name, rows in state.items():
        prefix = next((p for p in (MEMORY, DRAWN) if name.startswith(p)), "")
        parts[prefix][name.removeprefix(prefix)] = np.array(rows)
    targets, given = env.changing, parts[""]
    for name in sorted(given.keys() | targets.keys()):
        was, now = (_kind(rows.get(name)) for rows in (given, targets))
        if was != now:
            reason = f"{name!r} is {was}, this env's is {now}"
            advice = "make the env with the arguments that it had"
            raise ConfigError(f"state of a vector env: {reason}; {advice}.")
    for name, target in targets.items():
        target[...] = given[name]  # in place: the compiled steps refer to these arrays
    env.memory, env.simulator.drawn = parts[MEMORY], parts[DRAWN]
    env.simulator.sort_bodies()
    env.ready = bool((targets["episode"] >= 0).all())


def _kind(rows: NDArray[Any] | None) -> str:
    return "missing" if rows is None else f"{rows.dtype} of shape {rows.shape}"
