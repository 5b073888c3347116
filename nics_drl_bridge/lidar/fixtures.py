"""Fixtures of the worlds of a set, as lidars see them: walls and static maps.

P worlds lie one after the other in flat arrays; of each copy that is simulated, `member` tells
which one it is a copy of.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.map_kernels import GridArrays
from nics_drl_bridge.lidar.maps import NO_MAP, GridMap

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class Fixtures(NamedTuple):
    """Walls and maps of P worlds, for N copies."""

    member: Integers  # (N,) world of each copy
    walls: Array  # (W, 4) x1, y1, x2, y2 of all worlds [m]
    first: Integers  # (P + 1,) first wall of each world
    squares: NDArray[np.uint32]  # of all maps, see `GridArrays`
    maps: Integers  # (P, 3) first square, rows and columns of each map
    frames: Array  # (P, 5) of each map


@kernel(view=True)
def walls_of(n, fixtures):  # type: ignore[no-untyped-def]
    """Walls (W, 4) of one copy."""
    p = fixtures.member[n]
    return fixtures.walls[fixtures.first[p] : fixtures.first[p + 1]]


@kernel(view=True)
def grid_of(n, fixtures):  # type: ignore[no-untyped-def]
    """Map of one copy, without squares if there is none."""
    p = fixtures.member[n]
    return GridArrays(cells_of(fixtures.squares, fixtures.maps[p]), fixtures.frames[p])


@kernel(view=True)
def fixtures_around(n, fixtures):  # type: ignore[no-untyped-def]
    """Fixtures of one copy, as those of the only copy."""
    s = fixtures
    return Fixtures(s.member[n : n + 1], s.walls, s.first, s.squares, s.maps, s.frames)


@kernel(view=True)
def cells_of(cells, place):  # type: ignore[no-untyped-def]
    """Cells (rows, columns) of one map among those of many: first cell, rows, columns."""
    first, rows, columns = place[0], place[1], place[2]
    return cells[first : first + rows * columns].reshape((rows, columns))


def stack_fixtures(
    walls: Sequence[Array], grids: Sequence[GridMap | None], member: Integers
) -> Fixtures:
    """Stacks the fixtures of P worlds: walls (W, 4) and the map of each."""
    maps = [NO_MAP if grid is None else grid.arrays for grid in grids]
    squares, places = joined([each.squares for each in maps])
    frames = np.zeros((len(maps), 5))
    for frame, each in zip(frames, maps, strict=True):
        frame[: len(each.frame)] = each.frame
    first = np.cumsum([0, *map(len, walls)])
    return Fixtures(member, np.concatenate(walls), first, squares, places, frames)


def joined(cells: Sequence[NDArray[Any]]) -> tuple[NDArray[Any], Integers]:
    """Cells (rows, columns) one after the other, and first cell, rows, columns of each (P, 3).

    An array that occurs again, as the map of several worlds, is stored once.
    """
    once = {id(each): each for each in cells}
    starts = np.cumsum([0, *(each.size for each in once.values())]).tolist()
    first = dict(zip(once, starts, strict=False))
    shapes = [(first[id(each)], *each.shape) for each in cells]
    flat = [each.reshape(-1) for each in once.values()]  # of one alone, no copy
    return flat[0] if len(flat) == 1 else np.concatenate(flat), np.array(shapes, np.int64)
