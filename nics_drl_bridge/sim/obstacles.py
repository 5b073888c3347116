"""Motion of obstacles: straight ahead, from waypoint to waypoint, or as people walk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.lidar.shapes import Coordinate
from nics_drl_bridge.sim.separation_kernels import (
    BEHIND,
    COUNT,
    FIRST,
    FLUCTUATION,
    FORESIGHT,
    KIND,
    LOOP,
    PATROL,
    PAUSE,
    PEDESTRIAN,
    PLAN,
    RANGE,
    RELAXATION,
    REPULSION,
    SPEED_HIGH,
    SPEED_LOW,
    VIEW,
    WALL_RANGE,
    WALL_REPULSION,
    WANDER,
)  # fmt: skip

__all__ = [
    "NO_DISTANCES", "Motion", "Patrol", "Pedestrian", "Wander",
    "distance_arrays", "plan_arrays",
]  # fmt: skip

Array = NDArray[np.float64]
Plans = tuple[Array, Array]
Distances = tuple[NDArray[np.float32], Array]
FASTEST = 10.0
"""Greatest speed of an obstacle [m/s]; beyond it a control period would be too coarse."""
STRONGEST = 1e3
"""Upper bound on the parameters of the social force model, each in its unit."""
NO_DISTANCES: Distances = (np.full((1, 1), np.inf, np.float32), np.array([0.0, 0.0, 1.0, 0.0, 1.0]))
"""Argument of the kernels where there is no static map."""


def _fast(speed: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 < speed[0] <= speed[1] <= FASTEST:
        raise ValueError(f"speed must be [least, greatest], above 0 and at most {FASTEST:g} m/s")
    return speed


Speed = Annotated[tuple[float, float], AfterValidator(_fast)]


class Wander(Schema):
    """Moves straight ahead and turns to a free direction when something is near.

    Attributes:
        speed: least and greatest; one is drawn per episode [m/s].
    """

    kind: Literal["wander"] = "wander"
    speed: Speed


class Patrol(Schema):
    """Moves from waypoint to waypoint and waits while something is in the way.

    It first moves to the first waypoint, from wherever it stands.

    Attributes:
        waypoints: x, y in `map` [m].
        speed: [m/s].
        loop: continue from the last waypoint to the first; otherwise back and forth.
        pause: at each waypoint [s].
    """

    kind: Literal["patrol"] = "patrol"
    waypoints: tuple[tuple[Coordinate, Coordinate], ...] = Field(min_length=2, max_length=1000)
    speed: float = Field(gt=0.0, le=FASTEST)
    loop: bool = True
    pause: float = Field(default=0.0, ge=0.0, le=1e6)

    @model_validator(mode="after")
    def _apart(self) -> Patrol:
        corners = [*self.waypoints, *self.waypoints[: int(self.loop)]]
        if any(one == other for one, other in pairwise(corners)):
            raise ValueError("two waypoints that follow each other must differ")
        return self


class Pedestrian(Schema):
    """Walks to random goals, by the social force model of Helbing and Molnar (1995).

    The symbols and defaults are those of "Social force model for pedestrian dynamics", Phys. Rev.
    E 51, 4282, with two exceptions. The ellipses of the repulsion follow the relative velocity, as
    in Johansson, Helbing and Shukla (2007), and distances are between the surfaces of the discs,
    as in Helbing, Farkas and Vicsek (2000). The speeds are the paper's 1.34 m/s, plus or minus one
    standard deviation of 0.26 m/s.

    Attributes:
        speed: least and greatest desired speed; one is drawn per episode, and the walker is
            never faster than the greatest [m/s].
        relaxation: tau, the time constant of approaching the desired velocity [s].
        repulsion: V0 of walkers, obstacles and robots [m^2/s^2].
        range: sigma, the range of `repulsion` [m].
        wall_repulsion: U0 of walls [m^2/s^2].
        wall_range: R, the range of `wall_repulsion` [m].
        foresight: delta t, the time by which the others' motion is extrapolated [s].
        view: 2 phi, the angle of sight [rad].
        behind: c, the weight of forces from outside the angle of sight.
        fluctuation: standard deviation of a random acceleration [m/s^2].
    """

    kind: Literal["pedestrian"] = "pedestrian"
    speed: Speed = (1.08, 1.6)
    relaxation: float = Field(default=0.5, ge=0.1, le=10.0)
    repulsion: float = Field(default=2.1, ge=0.0, le=STRONGEST)
    range: float = Field(default=0.3, ge=1e-3, le=STRONGEST)
    wall_repulsion: float = Field(default=10.0, ge=0.0, le=STRONGEST)
    wall_range: float = Field(default=0.2, ge=1e-3, le=STRONGEST)
    foresight: float = Field(default=1.0, ge=0.0, le=STRONGEST)
    view: float = Field(default=math.radians(200.0), ge=0.0, le=2.0 * math.pi)
    behind: float = Field(default=0.5, ge=0.0, le=1.0)
    fluctuation: float = Field(default=0.1, ge=0.0, le=STRONGEST)


Motion = Annotated[Wander | Patrol | Pedestrian, Field(discriminator="kind")]


def plan_arrays(motions: Sequence[Wander | Patrol | Pedestrian | None]) -> Plans:
    """Returns the kernels' argument `plans`: obstacle k of every world moves by motion k.

    Args:
        motions: (K), None for an obstacle that stands still.

    Returns:
        (K, P) rows, columns as in `separation_kernels`, and (Q, 2) waypoints of all patrols [m].
    """
    rows, waypoints = np.zeros((len(motions), PLAN)), np.zeros((0, 2))
    for row, motion in zip(rows, motions, strict=True):
        if isinstance(motion, Patrol):
            row[KIND], row[SPEED_LOW : SPEED_HIGH + 1] = PATROL, motion.speed
            row[FIRST], row[COUNT] = len(waypoints), len(motion.waypoints)
            row[LOOP], row[PAUSE] = motion.loop, motion.pause
            waypoints = np.concatenate([waypoints, motion.waypoints])
        elif motion is not None:
            row[SPEED_LOW : SPEED_HIGH + 1] = motion.speed
            row[KIND] = WANDER
        if isinstance(motion, Pedestrian):
            row[KIND] = PEDESTRIAN
            row[RELAXATION], row[FLUCTUATION] = motion.relaxation, motion.fluctuation
            row[REPULSION], row[RANGE] = motion.repulsion, motion.range
            row[WALL_REPULSION], row[WALL_RANGE] = motion.wall_repulsion, motion.wall_range
            row[FORESIGHT], row[BEHIND] = motion.foresight, motion.behind
            row[VIEW] = math.cos(motion.view / 2.0)
    return rows, waypoints


def distance_arrays(grid: GridMap | None) -> Distances:
    """Returns the kernels' argument `distances`: distance field of a static map, and its frame."""
    return NO_DISTANCES if grid is None else (grid.distance_field, grid.arrays.frame)
