"""The density of a lidar table that errs least within a budget of memory.

The paper's finding, denser distance and sparser angle, is not taken for granted: candidates are
baked and compared with the exact scanner on the same random scenes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.bake import MOST_NUMBERS, bake, grid_of
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.sensor_models import intensity_of
from nics_drl_bridge.lidar.shapes import Circle, Outlines, Shape
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import Density, LidarTable, padding

UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 2**10, "mi": 2**20, "gi": 2**30}
LEAST = Density(distances=3, rotations=8, phases=1)
MOST_DISTANCES, MOST_ROTATIONS = 10_000, 100_000
ROTATIONS = tuple(round(8 * 1.5**i) for i in range(24) if 8 * 1.5**i <= MOST_ROTATIONS)
"""Candidates; between two of them the error hardly changes."""
BEGIN = 8
PHASES = (4, 2, 8, 1)
CELL_BYTES, NUMBER_BYTES, SHAPE_BYTES = 16, 4, 24
DIGITS = 64
"""A larger table writes its numbers with so many more digits, at most."""
SCANS, OBSTACLES, SEED = 400, 10, 0
Told = Callable[[str], None]


@dataclass(frozen=True)
class Choice:
    """What was found.

    Attributes:
        table: baked.
        rmse: expected error of a range, see `expected_rmse` [m].
        tried: how many densities were baked to find it.
    """

    table: LidarTable
    rmse: float
    tried: int


def parse_size(text: str) -> int:
    """Bytes of `8MB`, `500kB`, `8MiB` or a plain number. Raises ConfigError."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:([kKmMgG]i?)?[bB])?\s*", text)
    size = float(match[1]) * UNITS[(match[2] or "").lower()] if match else 0.0
    if not 1.0 <= size <= 1e15:
        raise ConfigError(f"budget {text!r}: is no size; give one like 8MB, 500kB or 8MiB.")
    return int(size)


def table_bytes(spec: LidarSpec, shapes: Sequence[Shape], density: Density) -> int:
    """Memory that a table would take, `LidarTable.memory`, without baking it [bytes]."""
    outlines = Outlines.of(tuple(dict.fromkeys(shapes)))
    channels = 1 if intensity_of(spec.sensor_model) is None else 2
    total = padding(spec.angle_increment) * NUMBER_BYTES * channels
    for h in range(len(outlines.shapes)):
        cell = grid_of(spec, outlines, h, density).cell
        rows = int(cell[..., 1].sum()) * density.phases
        total += rows * NUMBER_BYTES * channels + cell[..., 0].size * CELL_BYTES + SHAPE_BYTES
    return total


def random_scenes(
    spec: LidarSpec, scanner: Scanner, seed: int = SEED
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Robots (N, 3) and bodies (N, K, 7): shapes spread evenly over all that the lidar can see."""
    rng = np.random.default_rng(seed)
    outlines, shape = scanner.table.outlines, (SCANS, OBSTACLES)
    chosen = rng.integers(len(outlines.shapes), size=shape)
    radii = outlines.radii[chosen]
    reach = spec.range_max + radii
    distance = np.sqrt(rng.uniform(radii**2, reach**2))
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, *shape))
    poses = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), heading], axis=-1)
    bodies = np.empty((*shape, 7))
    for h, one in enumerate(outlines.shapes):
        bodies[chosen == h] = scanner.place([one] * int((chosen == h).sum()), poses[chosen == h])
    robots = np.zeros((SCANS, 3))
    robots[:, 2] = rng.uniform(-np.pi, np.pi, SCANS)
    c, s = np.cos(robots[:, 2]), np.sin(robots[:, 2])
    x, y, _ = spec.mount  # the lidar, not the robot, is where the distances begin
    robots[:, 0], robots[:, 1] = -c * x + s * y, -s * x - c * y
    return robots, bodies


def expected_rmse(spec: LidarSpec, table: LidarTable, seed: int = SEED) -> float:
    """Error of a range against the exact scanner, over all beams, among ten obstacles [m].

    No return counts as the greatest range, too close as 0. Equal seeds give equal scenes. It is
    the error of the geometry: what a named sensor model loses is not held against the table.
    """
    if not table.shapes:
        return 0.0
    if table.sensor_model:
        table = bake(spec, table.shapes, table.density, ())
    exact, baked = Scanner(spec, table, "exact"), Scanner(spec, table, "baked")
    robots, bodies = random_scenes(spec, exact, seed)
    one, other = (
        np.nan_to_num(scanner.scan(robots, bodies), posinf=spec.range_max, neginf=0.0)
        for scanner in (baked, exact)
    )
    return float(np.sqrt(np.mean(np.square(one - other, dtype=np.float64))))


def densest(
    spec: LidarSpec, shapes: Sequence[Shape], budget: int, rotations: int, phases: int
) -> Density | None:
    """The density with the most distances that fits, None when the least does not."""
    low, high, guess = LEAST.distances, MOST_DISTANCES, 24

    def size(distances: int) -> int:
        density = Density(distances=distances, rotations=rotations, phases=phases)
        return table_bytes(spec, shapes, density)

    if size(low) > budget:
        return None
    while high > low:  # sizes grow nearly in proportion: each guess is from the last size
        guess = min(max(guess, low + 1), high)
        found = size(guess)
        if found <= budget:
            low = guess
        else:
            high = guess - 1
        ahead = int(guess + (budget - found) * guess / found)
        if found <= budget and ahead <= low * 1.01:
            break
        guess = ahead
    return Density(distances=low, rotations=rotations, phases=phases)


def choose(
    spec: LidarSpec, shapes: Sequence[Shape], budget: int, told: Told | None = None
) -> Choice:
    """The table with the smallest expected error whose file has at most so many bytes.

    For each number of phases it climbs over the rotations; distances take what is left.

    Args:
        spec: the lidar.
        shapes: to bake.
        budget: greatest size of the file [bytes]; in memory it takes 2 kB less.
        told: called with a sentence before each density is tried.

    Raises:
        ConfigError: the budget is too small.
    """
    smallest = bake(spec, shapes, LEAST)
    least = len(smallest.dump()) + DIGITS
    if least > budget:
        raise ConfigError(
            f"a budget of {budget:,} bytes is too small: the smallest table of these shapes takes "
            f"{least:,} bytes; allow that, or bake fewer or smaller shapes."
        )
    room = min(budget - least + smallest.memory, NUMBER_BYTES * MOST_NUMBERS)
    search = _Search(spec, smallest, room, told)
    round_ = all(isinstance(shape, Circle) for shape in shapes)
    begin = BEGIN
    for phases in PHASES:
        begin = search.climb(begin, phases, still=round_)
    return Choice(search.best, search.rmse, len(search.seen))


class _Search:
    """The best table so far, and the errors of those that were tried."""

    def __init__(
        self, spec: LidarSpec, smallest: LidarTable, budget: int, told: Told | None
    ) -> None:
        self.spec, self.shapes, self.budget, self.told = spec, smallest.shapes, budget, told
        self.best, self.rmse = smallest, expected_rmse(spec, smallest)
        self.seen: dict[tuple[int, int], float] = {}

    def climb(self, begin: int, phases: int, still: bool) -> int:
        """Index of the best rotations, from a first one; `still` where rotation is no matter."""
        here = begin
        while here > 0 and not np.isfinite(self.error(here, phases)):
            here -= 1
        for step in () if still else (1, -1):
            while 0 <= here + step < len(ROTATIONS) and (
                self.error(here + step, phases) < self.error(here, phases)
            ):
                here += step
        return here

    def error(self, index: int, phases: int) -> float:
        """Expected error with so many rotations and phases [m], inf when they do not fit."""
        key = index, phases
        if key not in self.seen:
            density = densest(self.spec, self.shapes, self.budget, ROTATIONS[index], phases)
            self.seen[key] = np.inf if density is None else self._try(density)
        return self.seen[key]

    def _try(self, density: Density) -> float:
        if self.told is not None:
            self.told(f"{density.distances} x {density.rotations} x {density.phases}")
        table = bake(self.spec, self.shapes, density)
        rmse = expected_rmse(self.spec, table)
        if rmse < self.rmse:
            self.best, self.rmse = table, rmse
        return rmse
