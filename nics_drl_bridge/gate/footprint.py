"""The robot's footprint: as a body for the shield to sweep, and as points."""

import math
from functools import cache

import numpy as np

from nics_drl_bridge.gate.shield_kernels import Body
from nics_drl_bridge.gate.state import ShieldConfig
from nics_drl_bridge.interface import Array
from nics_drl_bridge.sim.collision_kernels import Outline

SPACING = 0.05  # maximum distance between the points of a footprint with corners [m]


@cache
def get_body(shield: ShieldConfig) -> Body:
    """Returns the footprint that is swept."""
    corners = np.array(shield.outline, np.float64).reshape(-1, 2)
    return Body(
        outline=Outline(corners, 0, len(corners)),
        radius=shield.footprint_radius,
        farthest_corner=float(np.hypot(*corners.T).max(initial=0.0)),
        margin=shield.margin,
        lever=shield.lever,
        order=shield.order,
    )


@cache
def sample_footprint(
    shield: ShieldConfig, mount: tuple[float, float, float], count: int
) -> tuple[Array, Array]:
    """Returns points around the footprint, with their bearings from the lidar.

    Args:
        shield: whose footprint it is.
        mount: of the lidar: x, y [m], heading [rad].
        count: number of points of a circle.

    Returns:
        bearings: (M,) of the points from the lidar [rad]; of a circle, from its centre.
        points: (M, 2) in the robot's frame [m].
    """
    corners = np.array(shield.outline)
    if not len(corners):
        bearings = np.linspace(-np.pi, np.pi, count, endpoint=False)
        points = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        return bearings, shield.footprint_radius * points
    edges = []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        pieces = math.ceil(np.hypot(*(end - begin)) / SPACING)
        edges.append(np.linspace(begin, end, pieces, endpoint=False))
    points = np.concatenate(edges)
    return np.arctan2(points[:, 1] - mount[1], points[:, 0] - mount[0]), points
