"""Noise of the odometry: how far the velocities that the wheels report are from the motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.noise_model import MEASURED, Level, Noise
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Recording, Samples

Array = NDArray[np.float64]

WITHIN_SIGMA = 68.27
"""So many per cent of a normal distribution lie within one standard deviation."""
MIN_ROWS = 40
BLOCKS = 8


def odometry_noise(
    recording: Recording, calibration: Calibration, model: TaylorModel, samples: Samples
) -> tuple[Level, Level]:
    """Linear and angular noise, against the twist that the fitted model gives.

    From the recorded odometry; else from the wheels, if the calibration knows their scale; else
    the assumed values of `Noise`.
    """
    default = Noise()
    rest = odometry_residual(recording, calibration, model, samples)
    if rest is None:
        return default.odom_linear, default.odom_angular
    linear = max((_level(rest[:, i], "m/s") for i in (0, 1)), key=lambda found: found.std)
    return linear, _level(rest[:, 2], "rad/s")


def odometry_residual(
    recording: Recording, calibration: Calibration, model: TaylorModel, samples: Samples
) -> Array | None:
    """Reported twist less that of the model (n, 3); None if there is nothing to compare."""
    stream = recording.odometry
    if stream is not None:
        t, twist = stream.t, stream.values
        if stream.clock == recording.pose.clock:
            t = t + calibration.clock_offset_s
    elif recording.wheels is not None and calibration.wheel_scale is not None:
        t, wheels = recording.wheels.t, recording.wheels.values
        twist = np.zeros((len(t), 3))
        twist[:, 0] = calibration.wheel_scale * wheels.mean(axis=1)
        twist[:, 2] = (calibration.turn_scale or 0.0) * (wheels[:, 1] - wheels[:, 0])
    else:
        return None
    inside = (t >= samples.t[0]) & (t <= samples.t[-1])
    if inside.sum() < MIN_ROWS:
        return None
    rates = model.rates(samples.x)[:, :3]
    # The rates hold from each sample to the next: at the middle of the step.
    middle = samples.t + samples.dt / 2.0
    expected = np.stack([np.interp(t[inside], middle, column) for column in rates.T], axis=1)
    return np.asarray(twist[inside] - expected)


def _level(rest: Array, unit: str) -> Level:
    """A level that single outliers do not change."""
    parts = np.array([_sigma(part) for part in np.array_split(rest, BLOCKS)])
    return Level(
        std=_sigma(rest),
        unit=unit,
        source=MEASURED,
        uncertainty=float(parts.std(ddof=1) / np.sqrt(BLOCKS)),
    )


def _sigma(rest: Array) -> float:
    return float(np.percentile(np.abs(rest - np.median(rest)), WITHIN_SIGMA))
