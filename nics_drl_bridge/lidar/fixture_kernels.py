"""Compiled fixtures of the worlds of a set, as lidars see them: walls and static maps.

P worlds are stored one after the other in flat arrays; `member` holds the world of each simulated
copy.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.map_kernels import GridArrays


class Fixtures(NamedTuple):
    """Walls and maps of P worlds, for N copies."""

    member: Integers  # (N,) world of each copy
    walls: Array  # (W, 4) x1, y1, x2, y2 of all worlds [m]
    first: Integers  # (P + 1,) first wall of each world
    squares: NDArray[np.uint32]  # of all maps, see `GridArrays`
    maps: Integers  # (P, 3) first square, rows and columns of each map
    frames: Array  # (P, 5) of each map


@kernel(view=True)
def walls_of(n: int, fixtures: Fixtures) -> Array:
    """Walls (W, 4) of one copy."""
    p = fixtures.member[n]
    return fixtures.walls[fixtures.first[p] : fixtures.first[p + 1]]


@kernel(view=True)
def grid_of(n: int, fixtures: Fixtures) -> GridArrays:
    """Map of one copy, without squares if there is none."""
    p = fixtures.member[n]
    return GridArrays(cells_of(fixtures.squares, fixtures.maps[p]), fixtures.frames[p])


@kernel(view=True)
def fixtures_around(n: int, fixtures: Fixtures) -> Fixtures:
    """Fixtures of one copy, as if it were the only copy."""
    s = fixtures
    return Fixtures(s.member[n : n + 1], s.walls, s.first, s.squares, s.maps, s.frames)


@kernel(view=True)
def cells_of(cells: NDArray[np.uint32], place: Integers) -> NDArray[np.uint32]:
    """Cells (rows, columns) of one map among those of many: first cell, rows, columns."""
    first = place[0]
    rows = place[1]
    columns = place[2]
    return cells[first : first + rows * columns].reshape((rows, columns))
