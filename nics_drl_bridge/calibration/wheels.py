"""Wheels: what a unit of their speed means, and whether left and right are interchanged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.clocks import CERTAIN
from nics_drl_bridge.calibration.noise import Motion
from nics_drl_bridge.calibration.signals import interval_means
from nics_drl_bridge.kinematics.recording import Recording
from nics_drl_bridge.kinematics.statistics import standard_errors


def wheels_swapped(recording: Recording, twists: Motion, offset: float) -> bool | None:
    """Whether the left wheel is faster in left turns; None if the wheels don't tell."""
    if recording.wheels is None:
        return None
    start, end = twists.start + offset, twists.end + offset
    wheels = interval_means(recording.wheels.t, recording.wheels.values, start, end)
    difference, turn = wheels[:, 1] - wheels[:, 0], twists.twist[:, 2]
    size = float(np.sqrt((difference**2).mean() * (turn**2).mean()))
    if size <= 0.0:
        return None
    agreement = float((difference * turn).mean()) / size
    return agreement < 0.0 if abs(agreement) > 0.5 else None


def wheel_scales(recording: Recording, twists: Motion, calibration: Calibration) -> Calibration:
    """Adds what a unit of the wheels' speed means, where the drive shows it."""
    if recording.wheels is None:
        return calibration
    start, end = (t + calibration.clock_offset_s for t in (twists.start, twists.end))
    wheels = interval_means(recording.wheels.t, recording.wheels.values, start, end)
    c, s = np.cos(calibration.rotation_rad), np.sin(calibration.rotation_rad)
    turn = twists.twist[:, 2]
    along = c * twists.twist[:, 0] + s * twists.twist[:, 1] + calibration.lever_arm_m[1] * turn
    rows = {
        "wheel_scale": (wheels.mean(axis=1), along),
        "turn_scale": (wheels[:, 1] - wheels[:, 0], turn),
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
