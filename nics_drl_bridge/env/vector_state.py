"""The state of a vector env: all that changes while it runs, taken out and put back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError

Arrays = dict[str, NDArray[Any]]
MEMORY, DRAWN = "memory.", "drawn."
"""What the names begin with whose number only the running episodes tell."""


def snapshot(env: BridgeVectorEnv) -> Arrays:
    """All that changes in a vector env, copied, by name.

    An env of the same arguments that is given it by `restore` goes on with the same bits.
    """
    found = dict(env.changing)
    found |= {MEMORY + name: rows for name, rows in env.memory.items()}
    found |= {DRAWN + name: rows for name, rows in env.simulator.drawn.items()}
    return {name: rows.copy() for name, rows in found.items()}


def restore(env: BridgeVectorEnv, state: Mapping[str, NDArray[Any]]) -> None:
    """Puts a snapshot into a vector env of the same arguments.

    Raises:
        ConfigError: it is of an env with other worlds, robots, lidar or task.
    """
    targets = env.changing
    known = {name for name in state if not name.startswith((MEMORY, DRAWN))}
    for name in sorted(known ^ set(targets)):
        raise ConfigError(f"state of a vector env: {name!r} is in one of both only; {_SAME}")
    for name, target in targets.items():
        if state[name].shape != target.shape or state[name].dtype != target.dtype:
            raise ConfigError(
                f"state of a vector env: {name!r} is of shape {state[name].shape}, this env's of "
                f"{target.shape}; {_SAME}"
            )
    for name, target in targets.items():
        target[...] = state[name]  # in place: the compiled steps hold these arrays
    env.memory = _below(MEMORY, state)
    env.simulator.drawn = _below(DRAWN, state)
    env.ready = bool((targets["episode"] >= 0).all())


_SAME = "make the env with the arguments that it had."


def _below(prefix: str, state: Mapping[str, NDArray[Any]]) -> Arrays:
    return {
        name.removeprefix(prefix): np.array(rows)
        for name, rows in state.items()
        if name.startswith(prefix)
    }
