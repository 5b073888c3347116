"""The ranges of domain randomisation: the schema of its YAML files."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.lidar.faults import LidarFaults, Skew, TooClose

MOST_PERIODS = 50.0
"""Greatest latency that may be drawn: the simulator keeps so many periods."""
MOST_OBSTACLES = 10_000
LIDAR_CHOICES = ("skew", "too_close")
"""Faults of which one of some words is drawn; of the others, a number."""


GREATEST_FACTOR = 1e3
GREATEST_LEVEL = 1e6


def _ordered(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError("a range is [least, greatest]")
    return span


def _not_negative(span: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 <= span[0] <= span[1] <= GREATEST_LEVEL:
        raise ValueError(f"a range must not begin below 0 or end above {GREATEST_LEVEL:g}")
    return span


def _positive(span: tuple[float, float]) -> tuple[float, float]:
    if not 1.0 / GREATEST_FACTOR <= span[0] <= span[1] <= GREATEST_FACTOR:
        raise ValueError(
            f"a range of factors must begin above 0, at {1.0 / GREATEST_FACTOR:g} or more, and end "
            f"at {GREATEST_FACTOR:g} or less"
        )
    return span


def _soon(span: tuple[float, float]) -> tuple[float, float]:
    if span[1] > MOST_PERIODS:
        raise ValueError(f"a latency must be at most {MOST_PERIODS:g} control periods")
    return span


Span = Annotated[tuple[float, float], AfterValidator(_ordered)]
Level = Annotated[Span, AfterValidator(_not_negative)]
Factor = Annotated[Span, AfterValidator(_positive)]
Latency = Annotated[Level, AfterValidator(_soon)]
AS_IT_IS: Factor = (1.0, 1.0)


class KinematicRanges(Schema):
    """Factors on the coefficients of the Taylor model, drawn for each coefficient on its own.

    Attributes:
        scale: for every coefficient.
        dofs: instead of it, for the coefficients of a rate, by its name in `model.yaml` (`wz`).
        terms: instead of both, by rate and term: `{wz: {speed*steering: [0.8, 1.2]}}`.
    """

    scale: Factor = AS_IT_IS
    dofs: dict[str, Factor] = Field(default_factory=dict)
    terms: dict[str, dict[str, Factor]] = Field(default_factory=dict)


class OdometryRanges(Schema):
    """What odometry and motion get wrong; factors on the model's levels, or levels instead.

    Attributes:
        noise: factor on the noise of the measured twist.
        drift: factor on what the model does not explain of the motion; only a drift that the
            recording showed can be scaled.
        odom_linear: noise of the velocity [m/s], instead of the model's.
        odom_angular: noise of the yaw rate [rad/s].
        position_drift: of x and y [m/sqrt(s)].
        heading_drift: [rad/sqrt(s)].
    """

    noise: Factor | None = None
    drift: Factor | None = None
    odom_linear: Level | None = None
    odom_angular: Level | None = None
    position_drift: Level | None = None
    heading_drift: Level | None = None

    @model_validator(mode="after")
    def _once(self) -> OdometryRanges:
        pairs = {"noise": ("odom_linear", "odom_angular")}
        pairs["drift"] = ("position_drift", "heading_drift")
        for factor, levels in pairs.items():
            for level in levels:
                if getattr(self, factor) is not None and getattr(self, level) is not None:
                    raise ValueError(f"give either the factor {factor} or the level {level}")
        return self


class LidarRanges(Schema):
    """The lidar's noise and faults, instead of the model's; the fields of `LidarFaults`.

    Attributes:
        noise_std: see `LidarSpec` [m].
        noise_proportional, quantisation, dropout, dropout_far: [least, greatest].
        skew, too_close: the words that may be drawn, each as likely.
    """

    noise_std: Level | None = None
    noise_proportional: Level | None = None
    quantisation: Level | None = None
    dropout: Level | None = None
    dropout_far: Level | None = None
    skew: tuple[Skew, ...] | None = Field(default=None, min_length=1)
    too_close: tuple[TooClose, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _probable(self) -> LidarRanges:
        likely = [name for name in ("dropout", "dropout_far") if getattr(self, name)]
        if sum(getattr(self, name)[1] for name in likely) > 1.0:
            raise ValueError("the greatest dropout and dropout_far must add up to at most 1")
        return self

    def numbers(self, end: int) -> dict[str, float]:
        """The least (end 0) or the greatest (end 1) of each number that `LidarFaults` holds."""
        spans = {name: getattr(self, name) for name in LidarFaults.model_fields}
        return {
            name: span[end]
            for name, span in spans.items()
            if span is not None and name not in LIDAR_CHOICES
        }


class ObstacleRanges(Schema):
    """How many obstacles a scene has, and how large they are.

    Attributes:
        count: [least, greatest], instead of the world's.
        size: factor on the size of every obstacle, one for a whole episode.
        rungs: so many sizes are drawn from, evenly spaced: each is baked beforehand.
    """

    count: tuple[int, int] | None = None
    size: Factor = AS_IT_IS
    rungs: int = Field(default=5, ge=2, le=100)

    @model_validator(mode="after")
    def _countable(self) -> ObstacleRanges:
        if self.count and not 0 <= self.count[0] <= self.count[1] <= MOST_OBSTACLES:
            raise ValueError(f"count must be [least, greatest] from 0 to {MOST_OBSTACLES}")
        return self

    @property
    def sizes(self) -> tuple[float, ...]:
        """The factors that may be drawn, ascending."""
        low, high = self.size
        rungs = self.rungs if high > low else 1
        return tuple(float(factor) for factor in np.linspace(low, high, rungs))


class Randomisation(Schema):
    """What is drawn anew for every episode; what is not named stays as in model and world.

    Attributes:
        name: what users call it.
        kinematics: see `KinematicRanges`.
        action_latency: on top of the model's [control periods].
        observation_latency: age of scan and odometry [control periods].
        odometry: see `OdometryRanges`.
        lidar: see `LidarRanges`.
        obstacles: see `ObstacleRanges`.
    """

    name: str
    kinematics: KinematicRanges = KinematicRanges()
    action_latency: Latency = (0.0, 0.0)
    observation_latency: Latency = (0.0, 0.0)
    odometry: OdometryRanges = OdometryRanges()
    lidar: LidarRanges = LidarRanges()
    obstacles: ObstacleRanges = ObstacleRanges()

    @property
    def sizes(self) -> tuple[float, ...]:
        """The factors on the obstacles' size that may be drawn, ascending."""
        return self.obstacles.sizes
