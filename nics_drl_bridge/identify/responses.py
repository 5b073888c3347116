"""Responses: states that were not measured and follow commands, and the scale of the wheels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.clocks import CERTAIN, TimingEstimate
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.signals import (
    followed,
    interval_means,
    moved_commands,
    speed_index,
)
from nics_drl_bridge.identify.statistics import standard_errors

Array = NDArray[np.float64]


def responses_of(
    drive: Drive, calibration: Calibration, timing: TimingEstimate, expected: Array | None
) -> tuple[Response, ...]:
    """Returns the inferred states; a speed is scaled to the speed along the direction of travel.

    `expected` (n,) is that speed over the intervals of the twists at gain 1; None if unknown.
    """
    spec = drive.spec
    if drive.recording.state is not None:
        return ()
    gains = np.ones(len(spec.state))
    speed = speed_index(spec)
    moved = moved_commands(drive.recording.command)[followed(spec)]
    if speed is not None and expected is not None and moved[speed]:
        along = speed_along(drive, calibration)
        gains[speed] = float(expected @ along / (expected @ expected))
    return tuple(
        Response(v.name, str(v.follows), float(lag), float(gain))
        for v, lag, gain in zip(spec.state, timing.lags, gains, strict=True)
    )


def speed_along(drive: Drive, calibration: Calibration) -> Array:
    """Returns the speed (n,) of `base_link` along its x axis over the intervals of the twists."""
    c, s = np.cos(calibration.rotation_rad), np.sin(calibration.rotation_rad)
    twist = drive.twists.twist
    along = c * twist[:, 0] + s * twist[:, 1]
    return np.asarray(along + calibration.lever_arm_m[1] * twist[:, 2])


def wheel_means(drive: Drive, calibration: Calibration) -> Array | None:
    """Returns mean wheel speeds (n, 2) over the intervals of the twists; None without wheels."""
    wheels = drive.recording.wheels
    if wheels is None:
        return None
    start, end = drive.twists.on_clock(calibration.clock_offset_s)
    return interval_means(wheels.t, wheels.values, start, end)


def with_wheels(drive: Drive, calibration: Calibration) -> Calibration:
    """Adds the scales of the wheel speeds and interchanged wheels, as far as the drive shows them.

    The left wheel of interchanged wheels is faster in left turns.
    """
    wheels = wheel_means(drive, calibration)
    if wheels is None:
        return calibration
    difference, turn = wheels[:, 1] - wheels[:, 0], drive.twists.twist[:, 2]
    size = float(np.sqrt((difference**2).mean() * (turn**2).mean()))
    if size > 0.0:
        agreement = float((difference * turn).mean()) / size
        swapped = agreement < 0.0 if abs(agreement) > 0.5 else None
        calibration = replace(calibration, wheels_swapped=swapped)
    rows = {
        "wheel_scale": (wheels.mean(axis=1), speed_along(drive, calibration)),
        "turn_scale": (difference, turn),
    }
    for name, (units, moved) in rows.items():
        if not float(units @ units) > 0.0:
            continue
        scale = float(units @ moved / (units @ units))
        sigma = float(standard_errors(units[:, None], moved - scale * units)[0])
        if abs(scale) > CERTAIN * sigma:
            known: dict[str, Any] = {name: scale}
            uncertainty = {**calibration.uncertainty, name: sigma}
            calibration = replace(calibration, uncertainty=uncertainty, **known)
    return calibration
