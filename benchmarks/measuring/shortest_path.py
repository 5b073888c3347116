"""Shortest paths through a field of cylinders, from cell to cell as BARN's own are."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim import barn

Array = NDArray[np.float64]
WIDE = 3
"""Cells [barn.CELL] whose distance from a cylinder a path keeps: the robot fits in between."""


def shortest_path(cylinders: Array) -> Array:
    """The cells (P, 2) of a shortest path, by steps to eight neighbours [m].

    The start is the middle of the field's near side, the goal that of its far side. ConfigError if
    there is no way.
    """
    blocked = np.zeros((barn.ROWS, barn.COLUMNS), np.bool_)
    at = np.round((cylinders - np.array(barn.CORNER)) / barn.CELL).astype(int)[:, ::-1]
    inside = ((at >= 0) & (at < blocked.shape)).all(axis=1)
    blocked[tuple(at[inside].T)] = True
    for wide in range(WIDE, -1, -1):  # as far from the cylinders as a way allows
        found = _search(_grown(blocked, wide))
        if found is not None:
            cells = np.array(found)[:, ::-1]
            return np.asarray(cells * barn.CELL + barn.CORNER)
    raise ConfigError(
        "a world of cylinders: no way from the start to the goal; leave it out."
    )


def _grown(blocked: NDArray[np.bool_], wide: int) -> NDArray[np.bool_]:
    out = blocked.copy()
    rows, columns = np.nonzero(blocked)
    for i in range(-wide, wide + 1):
        for j in range(-wide, wide + 1):
            if math.hypot(i, j) <= wide:
                near = rows + i
                beside = columns + j
                fits = (
                    (near >= 0)
                    & (near < out.shape[0])
                    & (beside >= 0)
                    & (beside < out.shape[1])
                )
                out[near[fits], beside[fits]] = True
    return out


def _search(blocked: NDArray[np.bool_]) -> list[tuple[int, int]] | None:
    """Dijkstra's search from the row of the field's begin to its last row."""
    first = round((barn.PATH_CORNER[1] - barn.CORNER[1]) / barn.CELL)
    middle = blocked.shape[1] // 2
    last = blocked.shape[0] - 1
    starts = [
        (abs(j - middle), (first, j))
        for j in range(blocked.shape[1])
        if not blocked[first, j]
    ]
    nowhere = -1, -1
    heap = [(float(away), cell, nowhere) for away, cell in starts]
    heapq.heapify(heap)
    came: dict[tuple[int, int], tuple[int, int]] = {}
    while heap:
        far, cell, before = heapq.heappop(heap)
        if cell in came:
            continue
        came[cell] = before
        if cell[0] == last:
            path = [cell]
            while (previous := came[path[-1]]) != nowhere:
                path.append(previous)
            return path[::-1]
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                to = cell[0] + i, cell[1] + j
                fits = first <= to[0] <= last and 0 <= to[1] < blocked.shape[1]
                if (i or j) and fits and not blocked[to] and to not in came:
                    heapq.heappush(heap, (far + math.hypot(i, j), to, cell))
    return None
