"""The `info` of a vector env, as Gymnasium's SyncVectorEnv gives it, from arrays of all worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Flags = NDArray[np.bool_]
Facts = Mapping[str, Any]
"""name -> array (N, ...), or again such a mapping."""


def put(infos: dict[str, Any], facts: Facts, mask: Flags) -> None:
    """Adds the facts of the worlds in `mask` (N,); elsewhere what is there stays, or zeros.

    Each name is paired with its mask `_name`, nested mappings likewise. The arrays become those
    of `infos`.
    """
    whole = bool(mask.all())
    for name, values in facts.items():
        if isinstance(values, Mapping):
            put(infos.setdefault(name, {}), values, mask)
        elif whole:
            infos[name] = values
        else:
            chosen = mask.reshape(-1, *(1,) * (values.ndim - 1))
            infos[name] = np.where(chosen, values, infos.get(name, values.dtype.type(0)))
        shown = infos.get(f"_{name}")
        infos[f"_{name}"] = mask.copy() if shown is None else shown | mask


def finals(observation: NDArray[Any], mask: Flags) -> dict[str, Any]:
    """`final_obs` of the worlds in `mask` (N,): an object array with None elsewhere."""
    rows = np.full(len(mask), None, dtype=object)
    for n in np.flatnonzero(mask):  # only those that ended; the rows must be objects of their own
        rows[n] = observation[n].copy()
    return {"final_obs": rows, "_final_obs": mask.copy()}
