"""Fields of round obstacles for the benchmarks of environments."""

from __future__ import annotations

import math

from nics_drl_bridge.sim.world import World

RADIUS = 0.15
"""Of every obstacle [m], as in the paper's scenes."""
CLEARANCE = 0.3


def field(obstacles: int, side: float) -> World:
    """A square field of `side` [m] with so many circles."""
    circle = {"kind": "circle", "radius": RADIUS}
    return World.model_validate(
        {
            "name": "field",
            "size": (side, side),
            "obstacles": [{"shapes": [circle], "count": obstacles, "gap": 0.0}],
            "clearance": CLEARANCE,
            "goal_distance": (1.0, side),
        }
    )


def side_of(bodies: int, area: float) -> float:
    """Side [m] of the square that gives so many bodies `area` [m^2] each."""
    return math.sqrt(bodies * area)
