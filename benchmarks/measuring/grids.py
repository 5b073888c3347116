"""Maps of an office, and of the office as SLAM leaves it, and scans in them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from measuring.rates import interleaved, shortest
from nics_drl_bridge.lidar import map_kernels
from nics_drl_bridge.lidar.beam_kernels import INF, LidarPose
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.scan_kernels import scan_scratch

SIZE = 20.0
RESOLUTION = 0.05
CELLS = round(SIZE / RESOLUTION)
SCANS = 1000
REPEATS = 7
CLEARANCE = 0.2


def to_cells(metres: float) -> int:
    """Returns a length in cells."""
    return round(metres / RESOLUTION)


def make_office(seed: int) -> NDArray[np.bool_]:
    """Rooms of 4 m along a corridor, with doors, furniture and round pillars."""
    rng = np.random.default_rng(seed)
    solid = np.zeros((CELLS, CELLS), bool)
    wall = 2
    low = to_cells(9.0)
    high = to_cells(11.0)
    solid[[0, 1, -2, -1]] = solid[:, [0, 1, -2, -1]] = True
    solid[low : low + wall] = solid[high : high + wall] = True
    for x in range(0, CELLS, to_cells(4.0)):
        solid[:low, x : x + wall] = solid[high:, x : x + wall] = True
        door = x + to_cells(rng.uniform(0.8, 2.2))
        for y in (low, high):
            solid[y : y + wall, door : door + to_cells(0.9)] = False
    rows, columns = np.mgrid[:CELLS, :CELLS]
    for k in range(90):
        y, x = rng.integers(5, CELLS - 20, 2)
        height, width = rng.integers(2, 16, 2)
        if low - 20 < y < high + 4:  # the corridor stays free
            continue
        if k < 60:
            solid[y : y + height, x : x + width] = True
        else:
            solid |= (rows - y) ** 2 + (columns - x) ** 2 < height**2 / 4.0
    return solid


def make_slam(seed: int) -> NDArray[np.bool_]:
    """The office with three of ten edge cells flipped, and specks."""
    rng = np.random.default_rng(seed)
    solid = make_office(seed)
    edge = ndimage.binary_dilation(solid) & ~ndimage.binary_erosion(solid)
    solid ^= edge & (rng.random(solid.shape) < 0.3)
    return solid | (rng.random(solid.shape) < 7e-4)


MAPS: dict[str, Callable[[int], NDArray[np.bool_]]] = {
    "office": make_office,
    "slam": make_slam,
}


def draw_poses(grid: GridMap, seed: int) -> NDArray[np.float64]:
    """Draws x, y, cosine, sine (SCANS, 4) of lidars in free places."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(grid.distance_field > CLEARANCE)
    chosen = places[rng.integers(0, len(places), SCANS)]
    at = grid.cell_to_world(chosen + rng.uniform(-0.5, 0.5, (SCANS, 2)))
    heading = rng.uniform(-np.pi, np.pi, SCANS)
    return np.column_stack([at, np.cos(heading), np.sin(heading)])


@njit(error_model="numpy")
def run(
    out: NDArray[np.float32],
    beams: Any,
    at: NDArray[np.float64],
    range_max: float,
    arrays: Any,
    walk: bool,
    scratch: Any,
) -> None:
    """Scans from poses `at`, walking or jumping."""
    for n in range(at.shape[0]):
        scratch.scan[:] = INF
        x, y, c, s = at[n]
        map_kernels.scan_map(
            scratch.scan,
            beams,
            LidarPose(x, y, c, s, 0.0),
            range_max,
            arrays,
            walk,
            scratch.singles,
            scratch.integers,
        )
        distances = scratch.scan.view(np.float32)[: out.shape[1]]
        out[n] = np.minimum(distances, np.float32(range_max))


def scan_map(
    beams: Any, at: NDArray[np.float64], range_max: float, arrays: Any, walk: bool
) -> tuple[NDArray[np.float32], float]:
    """Returns scans, and scans per second of the best of some runs."""
    out = np.empty((len(at), beams.directions.shape[1]), np.float32)
    scratch = scan_scratch(beams.directions.shape[1])
    call = partial(run, out, beams, at, range_max, arrays, walk, scratch)
    seconds = shortest(interleaved({"scan": call}, REPEATS))["scan"]
    return out, len(at) / seconds
