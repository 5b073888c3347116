"""Settings of an identification, and its calibration: how streams relate in time and space."""

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AllowInfNan, Field, NonNegativeFloat

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.curve import LONGEST_DELAY_S, InputCurve

Alpha = float | Literal["auto"]
Order = int | Literal["auto"]


@dataclass(frozen=True)
class Settings:
    """Options of an identification."""

    order: Order = defaults.TAYLOR_ORDER  # of the Taylor expansion (Eq. 1), or `auto`
    alpha: Alpha = defaults.PRUNING  # of the pruning (Eq. 2), or `auto`
    # end of the training part, measured from the first pose
    train_until_s: float = float("inf")
    # complete the model by the textbook for inputs that never moved
    assume: bool = False
    strict: bool = False  # refuse a drive that did not move every input independently
    control_period_s: float = 0.1  # the model's step must divide this


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold: a number from 0 to 1, or `auto`; else ConfigError."""
    if text == "auto":
        return "auto"
    with suppress(ValueError):
        value = float(text)
        if 0.0 <= value <= 1.0:
            return value
    raise ConfigError(f"alpha is {text!r}; it must be a number from 0 to 1, or auto.")


def parse_order(text: str) -> Order:
    """Parses the order of a model: 1 to 4, or `auto`; else ConfigError."""
    if text not in ("auto", "1", "2", "3", "4"):
        raise ConfigError(f"order is {text!r}; it must be 1, 2, 3 or 4, or auto.")
    return "auto" if text == "auto" else int(text)


@dataclass(frozen=True)
class Response:
    """A state variable that was not measured and follows a command with a first-order lag."""

    state: str
    command: str
    lag_s: NonNegativeFloat
    gain: float = 1.0  # state per command in steady state


@dataclass(frozen=True)
class Calibration:
    """Estimates of a recording's clocks, mounting and noise."""

    # added to the pose's stamps to give the commands' clock
    clock_offset_s: float = 0.0
    # from a command's stamp to its effect
    command_latency_s: Annotated[float, Field(le=LONGEST_DELAY_S)] = 0.0
    # heading of `base_link` minus heading of the tracked body
    rotation_rad: float = 0.0
    # (x, y) of the tracked point in `base_link`
    lever_arm_m: tuple[float, float] = (0.0, 0.0)
    # of the state variables; empty if the state was measured
    responses: tuple[Response, ...] = ()
    # of commands with an input curve or a delay of their own
    inputs: tuple[InputCurve, ...] = ()
    # time between bursts of poses; 0 without bursts
    burst_period_s: NonNegativeFloat = 0.0
    # standard deviation of x and y of the pose
    position_noise_m: NonNegativeFloat = 0.0
    heading_noise_rad: NonNegativeFloat = 0.0
    # speed per unit of the wheels' mean [m/s]; None if unknown
    wheel_scale: float | None = None
    # yaw rate per unit of right wheel minus left [rad/s]
    turn_scale: float | None = None
    # True if left and right are interchanged; None if unknown
    wheels_swapped: bool | None = None
    # Standard uncertainty of each estimated value, by the names above.
    uncertainty: dict[str, Annotated[float, AllowInfNan()]] = field(
        default_factory=dict
    )
    # a sentence on each finding, and on what could not be learnt
    notes: tuple[str, ...] = ()

    @property
    def is_exact(self) -> bool:
        """True if there is nothing to correct, not even noise, as in a synthetic recording."""
        return (
            self.clock_offset_s == self.command_latency_s == self.rotation_rad == 0.0
            and self.lever_arm_m == (0.0, 0.0)
            and not (self.responses or self.inputs)
            and self.burst_period_s == 0.0
            and self.position_noise_m == self.heading_noise_rad == 0.0
        )

    @property
    def mounting(self) -> Array:
        """Pose (3,) of the tracked body in `base_link`."""
        return np.array([*self.lever_arm_m, -self.rotation_rad])

    def to_base(self, tracked: ArrayLike) -> Array:
        """Converts poses (..., 3) of the tracked body to poses of `base_link`."""
        return geometry.compose(tracked, geometry.between(self.mounting, np.zeros(3)))

    def to_tracked(self, base: ArrayLike) -> Array:
        """Converts poses (..., 3) of `base_link` to poses of the tracked body."""
        return geometry.compose(base, self.mounting)
