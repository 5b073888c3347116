"""The `info` of a vector env, as Gymnasium's SyncVectorEnv gives it, from arrays of worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]
Facts = Mapping[str, Any]
"""name -> array with a leading world, or again such a mapping."""


def put_all(infos: dict[str, Any], facts: Facts, without: Flags) -> None:
    """Adds facts of all worlds (N, ...), each paired with its mask `_name`.

    Args:
        infos: takes the arrays for its own.
        facts: of every world.
        without: (N,) worlds that have none; their rows become zero, as Gymnasium has it.
    """
    gone = np.flatnonzero(without)
    for name, values in facts.items():
        if isinstance(values, Mapping):
            infos[name] = {}
            put_all(infos[name], values, without)
        else:
            if len(gone):
                values[gone] = 0
            infos[name] = values
        infos[f"_{name}"] = ~without


def put_rows(infos: dict[str, Any], facts: Facts, rows: Rows, count: int) -> None:
    """Adds facts (n, ...) of the worlds `rows` (n,) of N, with masks, among zeros."""
    for name, values in facts.items():
        if isinstance(values, Mapping):
            infos[name] = {}
            put_rows(infos[name], values, rows, count)
        else:
            infos[name] = np.zeros((count, *values.shape[1:]), values.dtype)
            infos[name][rows] = values
        infos[f"_{name}"] = np.zeros(count, np.bool_)
        infos[f"_{name}"][rows] = True


def rows_of(facts: Facts, rows: Rows) -> dict[str, Any]:
    """The same facts of some worlds only."""
    return {
        name: rows_of(values, rows) if isinstance(values, Mapping) else values[rows]
        for name, values in facts.items()
    }


def finals(observation: NDArray[Any], rows: Rows) -> dict[str, Any]:
    """`final_obs` of the worlds `rows`: an object array with None elsewhere."""
    shown, mask = np.full(len(observation), None, dtype=object), np.zeros(len(observation), bool)
    for n in rows:  # only those that ended: each must be an object of its own
        shown[n] = observation[n].copy()
    mask[rows] = True
    return {"final_obs": shown, "_final_obs": mask}
