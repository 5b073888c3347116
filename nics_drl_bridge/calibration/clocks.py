"""Clocks: offset, latency and lags of a recording, from whatever follows the commands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.noise import Motion
from nics_drl_bridge.calibration.timing import (
    Delay,
    delay_of_pose,
    delay_of_response,
    latency_of_state,
    moved_commands,
    nominal_lags,
)
from nics_drl_bridge.kinematics.recording import Recording, Stream
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

WHEELS_EXPLAINED = 0.5
"""The wheels must be explained by the commands to this share of their variance."""
WITHIN_TICK = 12.0**-0.5
"""Wheel speeds are taken as the mean over the tick that ends at their stamp; some drivers report
them as they are at the stamp: a time is uncertain by where in the tick they hold."""
MIN_TIME_S = 5e-4
CERTAIN = 3.0
"""A correction below this many standard uncertainties is left out."""


@dataclass(frozen=True)
class Timing:
    """Offset and latency as in `Calibration`, and what they were learnt from.

    Attributes:
        offset, latency: [s].
        sigma: standard uncertainty of what was estimated, by the name in `Calibration`.
        lags: (S,) of the inferred states, empty where the state was measured.
        lag_sigma: (S,) NaN where nominal.
        separated: whether offset and latency could be told apart.
    """

    offset: float
    latency: float
    sigma: dict[str, float]
    lags: Array
    lag_sigma: Array
    separated: bool


def timing_of(recording: Recording, spec: RobotSpec, twists: Motion) -> Timing:
    """Finds clock offset, latency and lags, each where the recording shows it."""
    if recording.state is not None:
        return _timing_of_measured_state(recording, recording.state, spec, twists)
    if not moved_commands(recording.command).any():
        nothing = np.full(len(spec.state), np.nan)
        start = recording.command.t[0] - recording.pose.t[0]
        offset = float(start) if abs(start) > 60.0 else 0.0
        return Timing(offset, 0.0, {}, nominal_lags(spec), nothing, False)
    target = (twists.start, twists.end, twists.twist)
    centers = _likely_shifts(recording)
    if recording.pose.clock == recording.command.clock:
        delay = delay_of_response(recording.command, spec, target)
        latency = if_certain(max(delay.value, 0.0), delay.sigma, MIN_TIME_S)
        sigma = {"command_latency_s": delay.sigma}
        return Timing(0.0, latency, sigma, delay.lags, delay.lag_sigma, True)
    wheels = _wheel_delay(recording, spec)
    delay = delay_of_response(
        recording.command, spec, target, centers, None if wheels is None else wheels.lags
    )
    if wheels is None:
        sigma = {"clock_offset_s": delay.sigma}
        return Timing(-delay.value, 0.0, sigma, delay.lags, delay.lag_sigma, False)
    sigma = {
        "clock_offset_s": float(np.hypot(wheels.sigma, delay.sigma)),
        "command_latency_s": wheels.sigma,
    }
    latency = max(wheels.value, 0.0)
    return Timing(latency - delay.value, latency, sigma, wheels.lags, wheels.lag_sigma, True)


def _timing_of_measured_state(
    recording: Recording, state: Stream, spec: RobotSpec, twists: Motion
) -> Timing:
    found = latency_of_state(recording.command, state, spec)
    step = float(np.median(np.diff(state.t)))
    sigma, latency = {}, 0.0
    if found is not None:
        sigma["command_latency_s"] = found.sigma
        latency = if_certain(max(found.value, 0.0), found.sigma, 0.05 * step)
    offset = 0.0
    if recording.pose.clock != state.clock:
        target = (twists.start, twists.end, twists.twist)
        delay = delay_of_pose(state, target, _likely_shifts(recording))
        sigma["clock_offset_s"] = delay.sigma
        offset = -if_certain(delay.value, delay.sigma, MIN_TIME_S)
    nothing = np.zeros(0)
    return Timing(offset, latency, sigma, nothing, nothing, found is not None)


def _likely_shifts(recording: Recording) -> tuple[float, ...]:
    """Where to search for the delay of the pose's clock: no shift, or a common start."""
    return 0.0, float(recording.pose.t[0] - recording.command.t[0])


def _wheel_delay(recording: Recording, spec: RobotSpec) -> Delay | None:
    """The response of the wheels, if they are on the commands' clock and follow at all."""
    wheels = recording.wheels
    if wheels is None or wheels.clock != recording.command.clock:
        return None
    tick = float(np.median(np.diff(wheels.t)))
    found = delay_of_response(recording.command, spec, (wheels.t - tick, wheels.t, wheels.values))
    if not found.explained > WHEELS_EXPLAINED:
        return None
    return replace(found, sigma=float(np.hypot(found.sigma, WITHIN_TICK * tick)))


def if_certain(value: float, sigma: float, least: float) -> float:
    """A correction, or zero if it is too small or too uncertain to be made."""
    return value if abs(value) > max(CERTAIN * sigma, least) else 0.0
