"""Curves behind the timing: what a shift in time leaves unexplained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.calibrate import tracked_twists
from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.timing import (
    moved_commands,
    nominal_lags,
    pose_residual,
    response_residual,
    state_residual,
)
from nics_drl_bridge.kinematics.recording import Recording
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.threads import one_blas_thread

Array = NDArray[np.float64]

REACH_S = 0.5
POINTS = 81


@dataclass(frozen=True)
class ShiftCurve:
    """What is left unexplained, against a time that was estimated.

    Attributes:
        name: of the estimate, as in `Calibration`.
        value: of the time (n,) [s].
        unexplained: (n,) root mean square, in shares of the signal's spread.
    """

    name: str
    value: Array
    unexplained: Array


@one_blas_thread
def timing_curves(
    recording: Recording, spec: RobotSpec, calibration: Calibration
) -> tuple[ShiftCurve, ...]:
    """A curve for the clock offset and one for the latency, each where it was estimated."""
    if not moved_commands(recording.command).any():
        return ()
    curves = []
    for name in ("clock_offset_s", "command_latency_s"):
        if name in calibration.uncertainty:
            found = _curve(recording, spec, calibration, name)
            curves += [found] if found is not None else []
    return tuple(curves)


def _curve(
    recording: Recording, spec: RobotSpec, calibration: Calibration, name: str
) -> ShiftCurve | None:
    value = float(getattr(calibration, name)) + np.linspace(-REACH_S, REACH_S, POINTS)
    twists = tracked_twists(recording)
    pose = twists.start, twists.end, twists.twist
    lags = np.array([r.lag_s for r in calibration.responses])
    lags = lags if len(lags) == len(spec.state) else nominal_lags(spec)
    state, wheels, command = recording.state, recording.wheels, recording.command
    if name == "clock_offset_s" and state is not None:
        by_state = pose_residual(state, pose)
        rest = [by_state(np.array([-v])) for v in value]
    elif name == "clock_offset_s":
        by_command = response_residual(command, spec, pose)
        rest = [by_command(lags, calibration.command_latency_s - v) for v in value]
    elif state is not None:
        by_delay = state_residual(command, state, spec)
        rest = [by_delay(np.array([v])) for v in value]
    elif recording.pose.clock == command.clock:
        by_command = response_residual(command, spec, pose)
        rest = [by_command(lags, v) for v in value]
    elif wheels is not None:
        tick = float(np.median(np.diff(wheels.t)))
        by_command = response_residual(command, spec, (wheels.t - tick, wheels.t, wheels.values))
        rest = [by_command(lags, v) for v in value]
    else:
        return None
    return ShiftCurve(name, value, np.array([np.sqrt(np.mean(r**2)) for r in rest]))
