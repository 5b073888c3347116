"""Any number of fields of cylinders grown by a cellular automaton, as BARN's were.

Cells are filled at random. Then, several times, cells with many filled neighbours are filled and
cells with few are emptied, which leaves clumps with paths between them (Perille, Truong, Xiao and
Stone, 2020).
"""

import math
from functools import lru_cache
from typing import Literal

import numpy as np
from pydantic import Field, model_validator
from scipy import ndimage

from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import Mask
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim.world import Goals, Obstacles, Starts, World

MOST_CELLS = 10_000
TRIES = 200  # fields drawn for one world, until one has a path through
# a cell with at least, at most this many filled neighbours (of 8) is filled, emptied
FILLED = 5
EMPTIED = 1
FINE = 2  # points per cell side in the search for a path


class Cellular(Schema):
    """Parameters of the worlds; each world draws its fill and smoothing from the given ranges."""

    kind: Literal["cellular"] = "cellular"  # which kind of generator this is
    worlds: int = Field(ge=1, le=10_000)  # number of worlds
    # seed of the generator; another seed makes other worlds
    seed: int = Field(default=0, ge=0)
    columns: int = Field(default=30, ge=4)  # number of cells across the field
    rows: int = Field(default=30, ge=4)  # number of cells along the field
    # side of a cell, and diameter of a cylinder [m]
    cell: float = Field(default=0.15, ge=0.01, le=10.0)
    # fraction of cells filled initially
    fill: tuple[float, float] = (0.1, 0.35)
    smoothing: tuple[int, int] = (2, 4)  # passes of the automaton
    # free space in front of and behind the field [m]
    margin: float = Field(default=4.0, ge=0.5, le=100.0)
    # width of the path through the field [m]
    passage: float = Field(default=0.5, ge=0.0, le=100.0)

    @model_validator(mode="after")
    def _consistent(self) -> "Cellular":
        if self.columns * self.rows > MOST_CELLS:
            raise ValueError(f"columns times rows may be {MOST_CELLS}")
        if not 0.0 <= self.fill[0] <= self.fill[1] < 1.0:
            raise ValueError("fill must be [minimum, maximum], from 0 to below 1")
        if self.passage > self.margin:
            raise ValueError(
                "passage may be as wide as margin, in whose middle the robot starts"
            )
        if not 0 <= self.smoothing[0] <= self.smoothing[1] <= 100:
            raise ValueError("smoothing must be [minimum, maximum], from 0 to 100")
        return self


@lru_cache(2048)  # a training opens each of them several times
def grow(parameters: Cellular, number: int) -> World:
    """Return one of the worlds, which the parameters determine. ConfigError if none has a path.

    The robot starts before the field, between two walls, and its goal lies beyond.
    """
    rng = np.random.default_rng([parameters.seed, number])
    for _ in range(TRIES):
        filled = _field(parameters, rng)
        if _has_way(filled, parameters):
            return _world(filled, parameters, number)
    raise ConfigError(
        f"key 'generate': none of {TRIES} fields drawn for world {number} has a path of "
        f"{parameters.passage:g} m; lower `fill` or `passage`."
    )


def _field(parameters: Cellular, rng: np.random.Generator) -> Mask:
    share = rng.uniform(*parameters.fill)
    filled = rng.random((parameters.rows, parameters.columns)) < share
    around = np.zeros((parameters.rows + 2, parameters.columns + 2), np.uint8)
    around[1:-1] = 1  # the walls at both sides
    for _ in range(rng.integers(parameters.smoothing[0], parameters.smoothing[1] + 1)):
        around[1:-1, 1:-1] = filled
        three = around[:-2] + around[1:-1] + around[2:]
        neighbours = three[:, :-2] + three[:, 1:-1] + three[:, 2:] - filled
        filled = (neighbours >= FILLED) | (filled & (neighbours > EMPTIED))
    return filled


def _has_way(filled: Mask, parameters: Cellular) -> bool:
    """True if a disc of the passage's width gets from before the field to behind it."""
    # beyond, all is free
    ahead = FINE * (1 + math.ceil(parameters.passage / 2.0 / parameters.cell))
    free = np.ones(
        (FINE * parameters.rows + 2 * ahead, FINE * parameters.columns + 2), np.bool_
    )
    free[:, [0, -1]] = False  # the walls at both sides
    free[ahead:-ahead, 1:-1] = ~np.repeat(np.repeat(filled, FINE, axis=0), FINE, axis=1)
    away = ndimage.distance_transform_edt(free) * parameters.cell / FINE
    areas, _ = ndimage.label(away > parameters.passage / 2.0)
    start, goal = areas[[0, -1], areas.shape[1] // 2].tolist()
    return bool(start > 0 and start == goal)


def _world(filled: Mask, parameters: Cellular, number: int) -> World:
    rows, columns = np.nonzero(filled)
    x = (columns + 0.5) * parameters.cell
    y = parameters.margin + (rows + 0.5) * parameters.cell
    wide = parameters.columns * parameters.cell
    deep = parameters.rows * parameters.cell
    long = deep + 2.0 * parameters.margin
    middle = wide / 2.0
    poses = [(px, py, 0.0) for px, py in np.round(np.stack([x, y], axis=1), 6).tolist()]
    if poses:
        cylinders = Obstacles(
            shapes=(Circle(radius=parameters.cell / 2.0),), at=tuple(poses)
        )
    else:
        cylinders = None
    start = parameters.margin / 2.0
    goal = long - parameters.margin / 2.0
    return World(
        name=f"cellular_{parameters.seed}_{number}",
        bounds=(0.0, 0.0, wide, long),
        clearance=0.0,
        walls=(
            (0.0, 0.0, 0.0, parameters.margin + deep),
            (wide, 0.0, wide, parameters.margin + deep),
            (0.0, 0.0, wide, 0.0),
        ),
        obstacles=(cylinders,) if cylinders else (),
        goal_distance=(0.0, 2.0 * long),
        starts=Starts(at=((middle, start, math.pi / 2.0),)),
        goals=Goals(at=((middle, goal),)),
    )
