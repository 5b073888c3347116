"""Motion of obstacles: from waypoint to waypoint, or as people walk."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.shapes import Coordinate
from nics_drl_bridge.sim import obstacle_kernels as at

__all__ = ["Motion", "Patrol", "Pedestrian", "plan_arrays"]
# Maximum speed of an obstacle [m/s]; beyond, a control period is too coarse
FASTEST = 10.0
# Upper bound on the parameters of the social force model, each in its unit
STRONGEST = 1e3


def _fast(speed: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 < speed[0] <= speed[1] <= FASTEST:
        raise ValueError(
            f"speed must be [minimum, maximum], above 0 and at most {FASTEST:g} m/s"
        )
    return speed


Speed = Annotated[tuple[float, float], AfterValidator(_fast)]
Strength = Annotated[float, Field(ge=0.0, le=STRONGEST)]
Distance = Annotated[float, Field(ge=1e-3, le=STRONGEST)]


class Patrol(Schema):
    """Moves from waypoint to waypoint, and waits while something is in the way."""

    kind: Literal["patrol"] = "patrol"  # which kind of motion this is
    # x, y in `map` [m]
    waypoints: tuple[tuple[Coordinate, Coordinate], ...] = Field(
        min_length=2, max_length=1000
    )
    speed: float = Field(gt=0.0, le=FASTEST)  # [m/s]
    # continue from the last waypoint to the first; otherwise back and forth
    loop: bool = True
    pause: float = Field(
        default=0.0, ge=0.0, le=1e6
    )  # waiting time at each waypoint [s]

    @model_validator(mode="after")
    def _apart(self) -> "Patrol":
        corners = [*self.waypoints, *self.waypoints[: int(self.loop)]]
        if any(corner == next_corner for corner, next_corner in pairwise(corners)):
            raise ValueError("consecutive waypoints must differ")
        return self


class Pedestrian(Schema):
    """Walks to random goals, by the social force model of Helbing and Molnar (1995).

    Symbols and defaults are those of "Social force model for pedestrian dynamics", Phys. Rev. E 51,
    4282, but the ellipses of the repulsion follow the relative velocity (Johansson, Helbing, Shukla
    2007), and distances are between the surfaces of the discs (Helbing, Farkas, Vicsek 2000). The
    speeds are the paper's 1.34 m/s, plus or minus one standard deviation of 0.26 m/s.
    """

    kind: Literal["pedestrian"] = "pedestrian"  # which kind of motion this is
    # range of the desired speed, drawn per episode; its upper end is a limit [m/s]
    speed: Speed = (1.08, 1.6)
    # tau, relaxation time to the desired velocity [s]
    relaxation: float = Field(default=0.5, ge=0.1, le=10.0)
    repulsion: Strength = 2.1  # V0 [m^2/s^2] of walkers, obstacles and robots
    range: Distance = 0.3  # sigma [m]
    wall_repulsion: Strength = 10.0  # U0 [m^2/s^2]
    wall_range: Distance = 0.2  # R [m]
    # delta t, the time by which the others' motion is extrapolated [s]
    foresight: Strength = 1.0
    # 2 phi, angle of sight [rad]
    view: float = Field(default=math.radians(200.0), ge=0.0, le=2.0 * math.pi)
    # c, weight of forces from outside the angle of sight
    behind: float = Field(default=0.5, ge=0.0, le=1.0)
    fluctuation: Strength = 0.1  # standard deviation of a random acceleration [m/s^2]


Motion = Annotated[Patrol | Pedestrian, Field(discriminator="kind")]


def plan_arrays(
    motions: Sequence[Patrol | Pedestrian | None],
) -> tuple[Array, Array]:
    """Return the plans (K, P) of obstacles with these motions, and patrols' waypoints (Q, 2)."""
    rows = np.zeros((len(motions), at.PLAN))
    waypoints = np.zeros((0, 2))
    for row, motion in zip(rows, motions, strict=True):
        if motion is None:
            continue
        row[[at.SPEED_LOW, at.SPEED_HIGH]] = motion.speed
        if isinstance(motion, Patrol):
            row[at.KIND] = at.PATROL
            row[at.LOOP] = motion.loop
            row[at.PAUSE] = motion.pause
            row[at.FIRST] = len(waypoints)
            row[at.COUNT] = len(motion.waypoints)
            waypoints = np.concatenate([waypoints, motion.waypoints])
        else:
            row[at.KIND] = at.PEDESTRIAN
            row[at.RELAXATION] = motion.relaxation
            row[at.FLUCTUATION] = motion.fluctuation
            row[at.REPULSION] = motion.repulsion
            row[at.RANGE] = motion.range
            row[at.WALL_REPULSION] = motion.wall_repulsion
            row[at.WALL_RANGE] = motion.wall_range
            row[at.FORESIGHT] = motion.foresight
            row[at.BEHIND] = motion.behind
            row[at.VIEW] = math.cos(motion.view / 2.0)
    return rows, waypoints
