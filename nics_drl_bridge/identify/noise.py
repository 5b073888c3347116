"""Noise of the pose, and body twists over intervals long enough for that noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.repair import Bursts, find_bursts
from nics_drl_bridge.identify.signals import unwrapped
from nics_drl_bridge.recording.recording import Stream

Array = NDArray[np.float64]

DIFFERENCE = 6
DIFFERENCE_GAIN = np.sqrt(924.0)  # white noise grows by this in a sixth difference
GAUSSIAN_MAD = 0.6745
UNEVEN = 0.5
LEAST_WHOLE = 0.1  # share of gap-free stretches from which on only those are used
NEGLIGIBLE = 1e-6  # m, rad
REST_SAMPLES = 12
REST_DRIFT = 3.0  # standard errors; straight motion shows at least 4
SLOPE_NOISE = 0.05
MAX_SPAN_S = 0.2
MAX_GAP_S = 0.25


@dataclass(frozen=True)
class TwistIntervals:
    """Twists of the tracked body over intervals.

    Attributes:
        start, end: (n,) of the intervals, on the pose's clock [s].
        twist: (n, 3) constant twist whose arc joins the poses at both ends, in the frame of the
            tracked body.
    """

    start: Array
    end: Array
    twist: Array


def pose_noise(
    pose: Array, bursts: Bursts | None, t: Array | None = None
) -> tuple[float, float] | None:
    """Returns standard deviations of position [m] and heading [rad] of poses (T, 3) at times (T,).

    They come from sixth differences, in which smooth motion vanishes, over gap-free stretches. In
    bursts, whose sample times are not known well enough, they come from the stretches in which
    the robot stood still. None if there are none.
    """
    pose = unwrapped(pose)
    if bursts is None:
        rest = _high_differences(pose, t)
        if len(rest) < DIFFERENCE:
            return None
        sigma = np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD
    else:
        found = _spread_at_rest(pose)
        if found is None:
            return None
        sigma = found
    sigma = np.where(sigma < NEGLIGIBLE, 0.0, sigma)
    return float(np.hypot(sigma[0], sigma[1]) / np.sqrt(2.0)), float(sigma[2])


def pose_residual(pose: Stream) -> Array | None:
    """Returns the noise (n, 3) of poses at its own scale; None for bursts or too few poses."""
    if find_bursts(pose.t) is not None or len(pose.t) <= 2 * DIFFERENCE:
        return None
    return _high_differences(unwrapped(pose.values), pose.t)


def _high_differences(pose: Array, t: Array | None) -> Array:
    """Returns sixth differences (n, 3) at the scale of the noise, over gap-free stretches."""
    rest = np.diff(pose, DIFFERENCE, axis=0) / DIFFERENCE_GAIN
    if t is None or not len(rest):
        return np.asarray(rest)
    span = np.diff(t)
    even = np.abs(span - np.median(span)) < UNEVEN * np.median(span)
    whole = np.convolve(even, np.ones(DIFFERENCE), "valid") > DIFFERENCE - 0.5
    return np.asarray(rest[whole] if whole.mean() > LEAST_WHOLE else rest)


def white_noise(values: Array) -> float:
    """Returns the standard deviation of white noise on an otherwise smooth, even series (T,)."""
    if len(values) <= 2 * DIFFERENCE:
        return 0.0
    rest = np.diff(values, DIFFERENCE) / DIFFERENCE_GAIN
    return float(np.median(np.abs(rest)) / GAUSSIAN_MAD)


def _spread_at_rest(pose: Array) -> Array | None:
    """Returns the spread (3,) in stretches whose two halves do not differ; None if too few."""
    count = len(pose) // REST_SAMPLES
    blocks = pose[: count * REST_SAMPLES].reshape(count, REST_SAMPLES, 3)
    spread = blocks.std(axis=1, ddof=1)
    half = REST_SAMPLES // 2
    drift = np.abs(blocks[:, :half].mean(axis=1) - blocks[:, half:].mean(axis=1))
    still = (drift < REST_DRIFT * spread / np.sqrt(half)).all(axis=1)
    still &= (spread < 10.0 * np.maximum(spread.min(axis=0), NEGLIGIBLE)).all(axis=1)
    if still.sum() < 2:
        return None
    return np.asarray(np.sqrt((spread[still] ** 2).mean(axis=0)))


def motion(
    t: Array, pose: Array, bursts: Bursts | None, noise: tuple[float, float]
) -> TwistIntervals:
    """Returns twists of the tracked body over intervals long enough for the noise.

    Args:
        t: (T,) sample times [s], of each burst only the newest.
        pose: (T, 3).
        bursts: of the stream.
        noise: of position [m] and heading [rad].
    """
    stride = 1 if bursts is not None else _stride(t, pose, noise)
    limit = 1.8 * bursts.period_s if bursts is not None else MAX_GAP_S
    t, pose = t[::stride], pose[::stride]
    span = np.diff(t)
    usable = (span > 0.0) & (span < max(limit, 3.0 * float(np.median(span))))
    relative = geometry.between(pose[:-1], pose[1:])[usable]
    return TwistIntervals(
        t[:-1][usable], t[1:][usable], geometry.log(relative) / span[usable, None]
    )


def _stride(t: Array, pose: Array, noise: tuple[float, float]) -> int:
    """Returns the number of samples between poses that makes motion stand out of the noise."""
    dt = float(np.median(np.diff(t)))
    coarse = max(1, round(MAX_SPAN_S / dt))
    far = geometry.log(geometry.between(pose[:-coarse:coarse], pose[coarse::coarse])) / (
        coarse * dt
    )
    speed = float(np.sqrt((far[:, :2] ** 2).sum(axis=1).mean())) if len(far) else 0.0
    turn = float(np.sqrt((far[:, 2] ** 2).mean())) if len(far) else 0.0
    needed = max(
        noise[0] / max(SLOPE_NOISE * speed, 1e-9), noise[1] / max(SLOPE_NOISE * turn, 1e-9)
    )
    return int(np.clip(np.ceil(np.sqrt(2.0) * needed / dt), 1, coarse))
