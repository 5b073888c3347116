"""LidarSpec: the one home of a lidar's beams, limits and header fields."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema, find_config, load_yaml

FULL_CIRCLE_TOLERANCE = 1e-6


class LidarSpec(Schema):
    """A planar lidar.

    Beam 0 points at `angle_min`, the others follow counter-clockwise. When the limits span a
    full circle the last beam stops one increment short of it, so that no direction is
    measured twice.

    Attributes:
        name: what users call it.
        beams: B.
        angle_min: of the first beam, in the frame of the lidar [rad].
        angle_max: of the last beam, or of the end of the circle [rad].
        range_min: nearer returns are reported as `-inf` [m].
        range_max: farther returns are reported as `inf` [m].
        rate: scans per second [Hz].
        mount: x [m], y [m], heading [rad] of `laser` in `base_link`.
        noise_std: standard deviation of a range [m].
    """

    name: str = "lidar"
    beams: int = Field(ge=1, le=100_000)
    angle_min: float
    angle_max: float
    range_min: float = Field(ge=0.0)
    range_max: float = Field(gt=0.0)
    rate: float = Field(gt=0.0)
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_std: float = Field(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _consistent(self) -> LidarSpec:
        if not self.range_min < self.range_max:
            raise ValueError("range_min must be less than range_max")
        if not 0.0 < self.angle_max - self.angle_min <= 2.0 * np.pi + FULL_CIRCLE_TOLERANCE:
            raise ValueError("angle_max must exceed angle_min by at most a full circle, in radians")
        if max(-self.angle_min, self.angle_max) > 2.0 * np.pi + FULL_CIRCLE_TOLERANCE:
            raise ValueError("angle_min and angle_max must lie within -2 pi and 2 pi")
        return self

    @property
    def full_circle(self) -> bool:
        """Whether the beams go all around."""
        return self.angle_max - self.angle_min > 2.0 * np.pi - FULL_CIRCLE_TOLERANCE

    @property
    def angle_increment(self) -> float:
        """Angle between neighbouring beams [rad]."""
        gaps = self.beams if self.full_circle else max(self.beams - 1, 1)
        return (self.angle_max - self.angle_min) / gaps

    @cached_property
    def angles(self) -> NDArray[np.float64]:
        """(B,) direction of each beam in the frame of the lidar [rad]."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.beams))

    @cached_property
    def directions(self) -> NDArray[np.float32]:
        """(B, 2) cosine and sine of each beam's direction."""
        return np.stack([np.cos(self.angles), np.sin(self.angles)], axis=1).astype(np.float32)


def load_lidar(name: str) -> LidarSpec:
    """Loads a shipped lidar by name (`paper`), or any by the path of its YAML file."""
    return load_yaml(find_config(name, "lidars"), LidarSpec)
