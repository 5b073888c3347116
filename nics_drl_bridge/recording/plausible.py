"""Poses that no robot can have had: which unit explains them, and how a mapping says so."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array

LARGEST_TURN = 1.5  # a larger turn between neighbouring samples [rad] is implausible,
TOO_FAST = 20.0  # and so is a speed of more than this many times the greatest command
SPEED_OVER_S = 0.5
SLOWEST_SAMPLING_S = 2.0
# Acceleration that no wheeled robot reaches for a quarter of the time [m/s^2]: one whose radius is
# below 1 m; and any, as race cars press themselves to the ground.
HARDEST, HARDEST_OF_CARS, SMALL_M = 14.0, 60.0, 1.0
SLOWEST_IN_CM = 300.0  # speed from which on millimetres are likelier than centimetres [m/s]
FASTEST_TURN = 15.0  # a robot that turns faster for long [rad/s] does so in degrees
FULL_TURN_DEG = 360.0
UNITS_OF_STEP = (
    ("milliseconds", "ms", 1e3),
    ("microseconds", "us", 1e6),
    ("nanoseconds", "ns", 1e9),
)


class Implausible(NamedTuple):
    """A fault of poses, and what explains it."""

    reason: str
    cause: str
    line: str  # for the mapping, as `heading_unit: deg`


def implausible_pose(
    t: Array, pose: Array, fastest: float = np.inf, radius: float = 0.0
) -> Implausible | None:
    """Finds poses (T, 3) at t (T,) [s] that degrees, centimetres or milliseconds explain.

    `fastest` is the greatest speed that is commanded [m/s], inf if it is not known; `radius` [m]
    that of the robot.
    """
    hardest = HARDEST if radius < SMALL_M else HARDEST_OF_CARS
    return _too_slow(t) or _degrees(t, pose[:, 2]) or _too_fast(t, pose, fastest, hardest)


def _degrees(t: Array, heading: Array) -> Implausible | None:
    cause = "it must be in radians (degrees look like this)"
    turn = np.percentile(np.abs(geometry.wrap_angle(np.diff(heading))), 95)
    if turn > LARGEST_TURN:
        reason = f"the heading jumps by {turn:.1f} rad between neighbouring samples"
        return Implausible(reason, cause, "heading_unit: deg")
    if np.abs(heading).max() <= 2.0 * np.pi + 0.1:
        return None
    step = np.diff(heading)
    around = np.abs(np.abs(step) - FULL_TURN_DEG) < FULL_TURN_DEG / 10.0
    every = _spaced(t)
    rate = np.abs(np.diff(np.unwrap(heading, period=FULL_TURN_DEG)[every])) / np.diff(t[every])
    if not around.any() and not (len(rate) and np.percentile(rate, 90) > FASTEST_TURN):
        return None
    reason = f"the heading is up to {np.abs(heading).max():.4g} rad"
    return Implausible(reason, cause, "heading_unit: deg")


def _spaced(t: Array) -> NDArray[np.intp]:
    """Returns the samples that are about half a second apart."""
    every = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], SPEED_OVER_S)))
    return np.asarray(every[np.append(True, np.diff(t[every]) > 0.0)])


def _too_fast(t: Array, pose: Array, fastest: float, hardest: float) -> Implausible | None:
    every = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], SPEED_OVER_S)))
    step, took = np.diff(pose[every, :2], axis=0), np.diff(t[every])
    if not len(took):
        return None
    velocity = step / np.maximum(took, 1e-9)[:, None]
    speed = np.percentile(np.hypot(*velocity.T), 90)
    cause = "positions must be in metres and stamps in seconds"
    line = "unit: mm" if speed > SLOWEST_IN_CM else "unit: cm"
    if speed > TOO_FAST * fastest:
        reason = f"moves at {speed:.3g} m/s, a robot whose commands end at {fastest:g} m/s"
        return Implausible(reason, cause, line)
    if np.isfinite(fastest) or len(took) < 3:
        return None
    hard = np.percentile(np.hypot(*np.diff(velocity, axis=0).T) / np.maximum(took[1:], 1e-9), 75)
    if hard <= hardest:
        return None
    reason = f"moves at {speed:.3g} m/s and changes that by {hard:.3g} m/s^2"
    return Implausible(reason, cause, line)


def _too_slow(t: Array) -> Implausible | None:
    span = np.median(np.diff(t))
    if span <= SLOWEST_SAMPLING_S:
        return None
    fitting = (each for each in UNITS_OF_STEP if span / each[2] < SLOWEST_SAMPLING_S)
    name, unit, _ = next(fitting, UNITS_OF_STEP[0])
    reason = f"there are {span:.3g} s between samples"
    cause = f"stamps must be in seconds ({name} look like this)"
    return Implausible(reason, cause, f"time: {{from: ..., unit: {unit}}}")
