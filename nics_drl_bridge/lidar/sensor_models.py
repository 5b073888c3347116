"""Sensor models, the returns that a device loses: baked into a table, they cost no time."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field

from nics_drl_bridge.config import Schema

Ranges = NDArray[np.float32]
Function = Callable[[Ranges, NDArray[np.float64]], Ranges]
"""Ranges (P,) [m] and angles of incidence (P,) [rad] to the ranges that the device reports."""
NEAREST = 1e-3  # a surface nearer than this is as bright as one at this range [m]


class IncidenceDropout(Schema):
    """Loses returns at oblique incidence, as from polished metal."""

    kind: Literal["incidence_dropout"] = (
        "incidence_dropout"  # which sensor model this is
    )
    greatest_incidence: float = Field(
        gt=0.0, lt=math.pi / 2.0
    )  # of the ray to the normal [rad]

    def __str__(self) -> str:
        """In a few words."""
        return f"nothing from beyond {math.degrees(self.greatest_incidence):.4g} deg of incidence"

    def lost(
        self, ranges: Ranges, incidence: NDArray[np.float64], reflectivity: float | None
    ) -> NDArray[np.bool_]:
        """True for the points (P,) without a return; see `Intensity.lost`."""
        return np.asarray(incidence > self.greatest_incidence)


class Intensity(Schema):
    """Intensity of a return: `gain * reflectivity * cos(incidence)^exponent / range^2`.

    This is the laser range equation for a diffuse surface that is wider than the beam, in clear
    air: Jelalian, Laser Radar Systems (1992); in this form Hoefle and Pfeifer, Correction of laser
    scanning intensity data (2007), with the exponent 1 of Lambert's law. A reflectivity of 1 is
    that of a white diffuse surface, a retroreflector has more; the exponent is 0 for no effect of
    the angle, and more than 1 for glossy surfaces.
    """

    kind: Literal["intensity"] = "intensity"  # which sensor model this is
    gain: float = Field(
        default=1.0, gt=0.0
    )  # white, at normal incidence, at 1 m [device's unit]
    reflectivity: float = Field(
        default=0.5, gt=0.0
    )  # of walls, maps, shapes without their own
    exponent: float = Field(default=1.0, ge=0.0, le=100.0)  # of the cosine
    threshold: float = Field(
        default=0.0, ge=0.0
    )  # weaker returns are lost [the device's unit]

    def __str__(self) -> str:
        """In a few words."""
        lost = f", below {self.threshold:g} nothing" if self.threshold else ""
        return (
            f"intensity {self.gain:g} at 1 m{lost}, reflectivity {self.reflectivity:g}"
        )

    def reflectance(
        self, cosine: ArrayLike, reflectivity: float | None
    ) -> NDArray[np.float64]:
        """Returns the factor (P,) without the range: reflectivity times cos(incidence)^exponent."""
        white = self.reflectivity if reflectivity is None else reflectivity
        return np.asarray(
            white * np.power(np.asarray(cosine, np.float64), self.exponent)
        )

    def lost(
        self, ranges: Ranges, incidence: NDArray[np.float64], reflectivity: float | None
    ) -> NDArray[np.bool_]:
        """True for the points (P,) below the threshold, by angle to the surface's normal [rad]."""
        light = self.gain * self.reflectance(np.cos(incidence), reflectivity)
        return np.asarray(
            light / np.square(np.maximum(ranges, NEAREST)) < self.threshold
        )


def _one_intensity(models: "tuple[SensorModel, ...]") -> "tuple[SensorModel, ...]":
    if sum(isinstance(model, Intensity) for model in models) > 1:
        raise ValueError("a lidar has one model of the kind intensity; keep one")
    return models


SensorModel = Annotated[IncidenceDropout | Intensity, Field(discriminator="kind")]
SensorModels = Annotated[tuple[SensorModel, ...], AfterValidator(_one_intensity)]


def returned(
    models: Sequence[SensorModel],
    ranges: Ranges,
    incidence: NDArray[np.float64],
    reflectivity: float | None,
) -> Ranges:
    """Returns ranges (P,) with `inf` where any model loses the return; see `Intensity.lost`."""
    for model in models:
        ranges = np.where(
            model.lost(ranges, incidence, reflectivity), np.float32(np.inf), ranges
        )
    return ranges
