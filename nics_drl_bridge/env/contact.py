"""When a return of the lidar means that something touches the robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.lidar.spec import LidarSpec

Array = NDArray[np.float64]


def contact_ranges(robot: RobotSpec, lidar: LidarSpec, margin: float) -> NDArray[np.float32]:
    """Range at which each beam leaves the footprint and a margin around it.

    Args:
        robot: with a round footprint, or one of corners.
        lidar: where it is mounted, and its beams.
        margin: [m].

    Returns:
        (B,) [m]; -inf where a beam does not cross the footprint.
    """
    x, y, heading = lidar.mount
    angles = lidar.angles + heading
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if robot.footprint is None:
        leaves = _leaves_circle(ray, np.array([x, y]), robot.footprint_radius + margin)
    else:
        leaves = _leaves_outline(ray, np.array(robot.footprint) - [x, y]) + margin
    return leaves.astype(np.float32)


def _leaves_circle(ray: Array, start: Array, radius: float) -> Array:
    along = ray @ start
    rest = radius * radius - start @ start + along * along
    return np.where(rest >= 0.0, np.sqrt(np.maximum(rest, 0.0)) - along, -np.inf)


def _leaves_outline(ray: Array, corners: Array) -> Array:
    """(B,) where rays (B, 2) from the origin cross an outline (V, 2) for the last time."""
    edge = np.roll(corners, -1, axis=0) - corners
    turned = np.stack([-edge[:, 1], edge[:, 0]], axis=-1)
    steep = ray @ turned.T  # (B, V) of each ray and side
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.sum(corners * turned, axis=-1) / steep
        where = (away[..., None] * ray[:, None] - corners) * edge
        share = where.sum(axis=-1) / np.sum(edge * edge, axis=-1)
    crossed = (steep != 0.0) & (away >= 0.0) & (share >= -1e-9) & (share <= 1.0 + 1e-9)
    return np.asarray(np.where(crossed, away, -np.inf).max(axis=1))
