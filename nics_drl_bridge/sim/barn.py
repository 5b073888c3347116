"""The 250 public worlds of BARN, the Benchmark for Autonomous Robot Navigation.

Fields of cylinders from "Benchmarking Metric Ground Navigation" (Perille, Truong, Xiao
and Stone, 2020), through which entrants of the BARN challenge drive 10 m.
`config/worlds/barn/` names the source of the data. Worlds whose number is a multiple of
6 are the benchmark's test set and are not included.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import share_folder
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.world import Goals, Obstacles, Starts, World

RADIUS = 0.075  # of each cylinder [m]
CELL = 0.15  # side of the cells [m]
# centre of the first cell [m]
CORNER = (-4.425, 0.075)
PATH_CORNER = (-4.425, 5.075)
# along y, along x
ROWS = 64
COLUMNS = 30
START = (-2.25, 3.0, 1.57)
GOAL = (-2.25, 13.0)
BOUNDS = (-4.5, 0.0, 0.0, 14.0)  # the cylinders' field, and 1 m beyond the goal
FILE = "config/worlds/barn/barn.npz"


def barn_numbers() -> tuple[int, ...]:
    """The numbers of the worlds, ascending."""
    return tuple(_arrays()["numbers"].tolist())


def barn_world(number: int) -> World:
    """Return a world by number, in the frame of its Gazebo world."""
    packed = _arrays()["cylinders"][_index(number)]
    cells = np.unpackbits(packed, count=ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    poses = [(x, y, 0.0) for x, y in _centres(np.argwhere(cells), CORNER).tolist()]
    return World(
        name=f"barn_{number:03d}",
        bounds=BOUNDS,
        clearance=0.0,
        goal_distance=(9.0, 11.0),
        obstacles=(Obstacles(shapes=(Circle(radius=RADIUS),), at=tuple(poses)),),
        starts=Starts(at=(START,)),
        goals=Goals(at=(GOAL,)),
    )


def barn_path(number: int) -> Array:
    """Return the benchmark's own shortest path (P, 2) in a world, cell by cell [m]."""
    paths = _arrays()["paths"]
    return _centres(paths[paths[:, 0] == _index(number), 1:], PATH_CORNER)


def _centres(cells: NDArray[Any], corner: tuple[float, float]) -> Array:
    """Return x, y (n, 2) [m] of cells (n, 2), row and column."""
    return np.round(cells[:, ::-1] * CELL + corner, 6)


def _index(number: int) -> int:
    if number not in barn_numbers():
        raise ConfigError(
            f"there is no BARN world {number}; the numbers are 1 to 299 without multiples of 6."
        )
    return barn_numbers().index(number)


@lru_cache
def _arrays() -> dict[str, NDArray[Any]]:
    """The file's arrays: `numbers` (N,), `cylinders` (N, bytes) of packed bits, `paths` (P, 3)."""
    with np.load(share_folder() / FILE) as file:
        return dict(file)
