"""Convex parts of outlines and rectangles of maps: MuJoCo's bodies are convex."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.lidar.shapes import convex_hull

Array = NDArray[np.float64]
SLIVER = 1e-9
"""A triangle of less area is left out, in parts of the square of the outline's size."""


def convex_parts(outline: Array) -> list[Array]:
    """Convex outlines (v, 2) that together fill an outline (V, 2), given counter-clockwise.

    A convex outline is its only part, others are cut into triangles, ear by ear (Meisters 1975).
    """
    if len(convex_hull(outline)) == len(outline):
        return [outline]
    rest, parts = list(range(len(outline))), []
    least = SLIVER * float(np.ptp(outline, axis=0).max()) ** 2
    while len(rest) > 3:
        at = next((i for i in range(len(rest)) if _is_ear(outline, rest, i)), 0)
        parts.append(outline[[rest[at - 1], rest[at], rest[(at + 1) % len(rest)]]])
        del rest[at]
    parts.append(outline[rest])
    return [part for part in parts if _area(*part) > least]


def _area(a: Array, b: Array, c: Array) -> float:
    """Twice the signed area of a triangle; positive counter-clockwise."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _is_ear(outline: Array, rest: list[int], i: int) -> bool:
    """Whether the corner i of `rest` can be cut off: convex, and no other corner within."""
    before, here, after = rest[i - 1], rest[i], rest[(i + 1) % len(rest)]
    a, b, c = outline[before], outline[here], outline[after]
    if _area(a, b, c) <= 0.0:
        return False
    others = (outline[k] for k in rest if k not in (before, here, after))
    return not any(
        _area(a, b, p) >= 0.0 and _area(b, c, p) >= 0.0 and _area(c, a, p) >= 0.0 for p in others
    )


def rectangles(blocked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rectangles that together cover the blocked cells of a map and no other cell.

    Runs along the rows; equal runs in rows that follow each other become one.

    Args:
        blocked: (rows, columns).

    Returns:
        (R, 4) first row, first column, and those after the last.
    """
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(blocked) + 1):
        runs = _runs(blocked[row]) if row < len(blocked) else set()
        for run in [run for run in open_runs if run not in runs]:
            done.append((open_runs.pop(run), run[0], row, run[1]))
        for run in runs:
            open_runs.setdefault(run, row)
    return np.array(sorted(done), dtype=np.int64).reshape(-1, 4)


def _runs(row: NDArray[np.bool_]) -> set[tuple[int, int]]:
    """First column of each run of blocked cells, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return {(int(a), int(b)) for a, b in edges.reshape(-1, 2)}
