"""Calibration: the relations of a recording's streams in time and space."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AllowInfNan, NonNegativeFloat

from nics_drl_bridge import geometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """A state variable that was not measured and follows a command with a first-order lag.

    Attributes:
        state, command: names in the RobotSpec.
        lag_s: time constant [s].
        gain: state per command in steady state.
    """

    state: str
    command: str
    lag_s: NonNegativeFloat
    gain: float = 1.0


@dataclass(frozen=True)
class Calibration:
    """Estimates of a recording's clocks, mounting and noise.

    Attributes:
        clock_offset_s: added to the pose's stamps, gives the commands' clock [s].
        command_latency_s: from a command's stamp to its effect [s].
        rotation_rad: heading of `base_link` minus the heading of the tracked body.
        lever_arm_m: (x, y) of the tracked point in `base_link` [m].
        responses: of the state variables; empty if the state was measured.
        burst_period_s: between the bursts in which poses arrived [s]; 0 without bursts.
        position_noise_m: standard deviation of x and y of the pose [m].
        heading_noise_rad: standard deviation of its heading [rad].
        wheel_scale: speed per unit of the mean of both wheels [m/s]; None if unknown.
        turn_scale: yaw rate per unit of right wheel minus left [rad/s]; None if unknown.
        wheels_swapped: True if left and right wheel are interchanged; None if unknown.
        uncertainty: standard uncertainty of each estimated value, by the names above.
        notes: one sentence on each finding and on each value that could not be learnt.
    """

    clock_offset_s: float = 0.0
    command_latency_s: float = 0.0
    rotation_rad: float = 0.0
    lever_arm_m: tuple[float, float] = (0.0, 0.0)
    responses: tuple[Response, ...] = ()
    burst_period_s: NonNegativeFloat = 0.0
    position_noise_m: NonNegativeFloat = 0.0
    heading_noise_rad: NonNegativeFloat = 0.0
    wheel_scale: float | None = None
    turn_scale: float | None = None
    wheels_swapped: bool | None = None
    uncertainty: dict[str, Annotated[float, AllowInfNan()]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def is_identity(self) -> bool:
        """True if the streams can be used as they are."""
        return (
            self.clock_offset_s == self.command_latency_s == self.rotation_rad == 0.0
            and self.lever_arm_m == (0.0, 0.0)
            and not self.responses
            and self.burst_period_s == 0.0
        )

    @property
    def is_exact(self) -> bool:
        """True if there is nothing to correct, not even noise: a textbook recording."""
        return self.is_identity and self.position_noise_m == self.heading_noise_rad == 0.0

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
