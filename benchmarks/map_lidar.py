"""Static maps: jumps over free squares against walking from cell to cell.

Two generated maps of 20 m x 20 m at 0.05 m: an office, and the same as a SLAM would leave it, with
ragged edges and specks. One thread; ranges beyond range_max count as range_max.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench import answer, parser_of
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from nics_drl_bridge.lidar import map_kernels
from nics_drl_bridge.lidar.beam_kernels import INF, LidarPose, beams_of, finish
from nics_drl_bridge.lidar.maps import OCCUPIED, GridMap
from nics_drl_bridge.lidar.scan_kernels import scan_lanes
from nics_drl_bridge.lidar.spec import load_lidar

CONTROLS = {
    "shifted": "the map that is jumped through lies a cell beside",
    "slow": "the walk in place of the jumps",
    "nan": "one range is none",
}
SIZE = 20.0
RESOLUTION = 0.05
CELLS = round(SIZE / RESOLUTION)
LIDARS = ("paper", "paper_12m")
SCANS = 1000
REPEATS = 7
CLEARANCE = 0.2
FASTER, RMSE_M, MOST_OFF = 3.0, 1e-5, 1e-5
"""Bars: times the walk's speed, RMSE, and the share of beams that may be off by 1 mm."""


def cells(metres: float) -> int:
    """A length in cells."""
    return round(metres / RESOLUTION)


def office(seed: int) -> NDArray[np.bool_]:
    """Rooms of 4 m along a corridor, with doors, furniture and round pillars."""
    rng = np.random.default_rng(seed)
    solid = np.zeros((CELLS, CELLS), bool)
    wall = 2
    low = cells(9.0)
    high = cells(11.0)
    solid[[0, 1, -2, -1]] = solid[:, [0, 1, -2, -1]] = True
    solid[low : low + wall] = solid[high : high + wall] = True
    for x in range(0, CELLS, cells(4.0)):
        solid[:low, x : x + wall] = solid[high:, x : x + wall] = True
        door = x + cells(rng.uniform(0.8, 2.2))
        for y in (low, high):
            solid[y : y + wall, door : door + cells(0.9)] = False
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


def slam(seed: int) -> NDArray[np.bool_]:
    """The office with three of ten edge cells flipped, and specks."""
    rng = np.random.default_rng(seed)
    solid = office(seed)
    edge = ndimage.binary_dilation(solid) & ~ndimage.binary_erosion(solid)
    solid ^= edge & (rng.random(solid.shape) < 0.3)
    return solid | (rng.random(solid.shape) < 7e-4)


MAPS: dict[str, Callable[[int], NDArray[np.bool_]]] = {"office": office, "slam": slam}


def poses(grid: GridMap, seed: int) -> NDArray[np.float64]:
    """(SCANS, 4) x, y, cosine, sine of lidars in free places."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(grid.distance_field > CLEARANCE)
    chosen = places[rng.integers(0, len(places), SCANS)] + rng.uniform(
        -0.5, 0.5, (SCANS, 2)
    )
    heading = rng.uniform(-np.pi, np.pi, SCANS)
    at = grid.cell_to_world(chosen)
    return np.column_stack([at, np.cos(heading), np.sin(heading)])


@njit(error_model="numpy")
def run(out, beams, at, range_max, arrays, walk, lanes):
    """Scans from poses `at`, walking or jumping."""
    for n in range(at.shape[0]):
        lanes.scan[:] = INF
        x, y, c, s = at[n]
        map_kernels.scan_map(
            lanes.scan,
            beams,
            LidarPose(x, y, c, s, 0.0),
            range_max,
            arrays,
            walk,
            lanes.singles,
            lanes.integers,
        )
        finish(out[n], lanes.scan, 0.0, range_max)


def timed(*arguments: Any) -> tuple[NDArray[np.float32], float]:
    """Scans, and scans per second of the best of some runs."""
    out = np.empty((SCANS, arguments[0].directions.shape[1]), np.float32)
    run(out, *arguments)
    best = np.inf
    for _ in range(REPEATS):
        begin = time.perf_counter()
        run(out, *arguments)
        best = min(best, time.perf_counter() - begin)
    return np.minimum(out, arguments[2]), SCANS / best


def measure(seed: int, control: str | None) -> dict[str, Any]:
    """One row per map and lidar."""
    rows = []
    for name, make in MAPS.items():
        grid = GridMap((make(seed) * OCCUPIED).astype(np.int8), RESOLUTION)
        map_kernels.free_squares(grid.blocked)  # compiles
        begin = time.perf_counter()
        squares, _ = grid.arrays
        bake = time.perf_counter() - begin
        for lidar in LIDARS:
            spec = load_lidar(lidar)
            directions = np.ascontiguousarray(spec.directions.T)
            beams = beams_of(directions, spec.angle_min, spec.angle_increment)
            lanes = scan_lanes(spec.beams)
            at = poses(grid, seed + 1)
            arguments = (beams, at, spec.range_max, grid.arrays)
            exact, exact_speed = timed(*arguments, True, lanes)
            if control == "shifted":
                moved = np.column_stack([at[:, :1] + RESOLUTION, at[:, 1:]])
                arguments = (beams, moved, spec.range_max, grid.arrays)
            baked, baked_speed = timed(*arguments, control == "slow", lanes)
            if control == "nan":
                baked[0, 0] = np.nan
            error = baked.astype(np.float64) - exact
            rows.append(
                {
                    "map": name,
                    "beams": spec.beams,
                    "range_max_m": spec.range_max,
                    "exact_scans_per_s": round(exact_speed),
                    "baked_scans_per_s": round(baked_speed),
                    "ratio": round(baked_speed / exact_speed, 2),
                    "rmse_m": float(np.sqrt((error**2).mean())),
                    "beams_off_by_1_mm": int((np.abs(error) > 1e-3).sum()),
                    "beams_compared": error.size,
                    "table_bytes": squares.nbytes,
                    "bake_s": round(bake, 4),
                }
            )
    return {"threads": 1, "seed": seed, "rows": rows}


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    for row in result["rows"]:
        name = f"{row['map']}, {row['range_max_m']:g} m"
        if not row["ratio"] >= FASTER:
            missed.append(
                f"{name}: {row['ratio']:.2f} times the walk's speed, bar {FASTER:g}"
            )
        if not row["rmse_m"] <= RMSE_M:
            missed.append(f"{name}: RMSE {row['rmse_m']:.2e} m, bar {RMSE_M:g}")
        off = row["beams_off_by_1_mm"] / row["beams_compared"]
        if not off <= MOST_OFF:
            missed.append(
                f"{name}: {off:.2e} of the beams are off by 1 mm, bar {MOST_OFF:g}"
            )
    return missed


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    result = measure(given.seed, given.control)
    answer(result, missed_of(result), given.json)


if __name__ == "__main__":
    main()
