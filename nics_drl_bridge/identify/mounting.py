"""Mounting: position and rotation of the tracked body on the robot.

Uncertainty of a mounting by the delete-one-block jackknife.

Efron, Tibshirani: An Introduction to the Bootstrap, ch. 11. It covers what least-squares formulas
miss: wheel slip that is correlated over seconds, and errors of the regressors themselves.

Wheels: the scale of their speeds, and interchanged left and right wheels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import rotate, wrap_angle
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.noise import TwistIntervals
from nics_drl_bridge.identify.signals import interval_means
from nics_drl_bridge.identify.statistics import standard_errors
from nics_drl_bridge.identify.timing import CERTAIN
from nics_drl_bridge.recording.recording import Recording

Array = NDArray[np.float64]

TURN_SCALE_M = 0.2
"""Weighs yaw rates against speeds: a yaw rate counts as the speed at this distance."""
DISTINCT = 4.0
"""The second direction of motion must exceed the noise by this factor."""
MIN_SECOND = 0.05
"""It must have at least this share of the size of the first."""
STILL = 1e-3


@dataclass(frozen=True)
class Mounting:
    """Rotation and lever arm, as in `Calibration`, with standard uncertainty.

    Attributes:
        rotation: heading of `base_link` minus that of the tracked body [rad].
        lever: (2,) position of the tracked point in `base_link` [m].
        rotation_sigma: [rad].
        lever_sigma: (2,) [m]; NaN for a component that could not be learnt.
        turns: True if the robot turned at all.
    """

    rotation: float
    lever: Array
    rotation_sigma: float
    lever_sigma: Array
    turns: bool


def mounting_without_lateral_motion(motion: TwistIntervals, forward: Array) -> Mounting | None:
    """Estimates the mounting on a robot whose `base_link` never moves sideways.

    The lateral speed of the tracked point is then yaw rate x lever arm:
    `cos(rotation) uy - sin(rotation) ux - lever_x wz = 0`, the direction in which the twists
    have no extent. If the path has a single curvature, rotation and lever arm can't be
    separated, and the lever arm is set to zero.

    Args:
        motion: twists of the tracked body.
        forward: (n,) commanded or measured forward speed; only its sign matters.

    Returns:
        The mounting, with unknown lever arm along y. None if nothing moved.
    """
    rows = motion.twist * np.array([1.0, 1.0, TURN_SCALE_M])
    size, axes = np.linalg.svd(rows, full_matrices=False)[1:]
    size = size / np.sqrt(len(rows))
    if size[0] < STILL:
        return None
    turns = bool(np.abs(rows[:, 2]).mean() > STILL)
    if size[1] < max(DISTINCT * size[2], MIN_SECOND * size[0]):
        direction = axes[0, :2]
        sigma = size[1] / size[0] / np.sqrt(len(rows))
        travel = float(np.arctan2(direction[1], direction[0]))
        return _facing(motion, forward, travel, (0.0, np.nan), sigma, turns)
    normal = axes[2]
    flat = float(np.hypot(normal[0], normal[1]))
    sigma = size[2] / size[1] / np.sqrt(len(rows)) / flat
    travel = float(np.arctan2(-normal[0], normal[1]))
    lever = -float(normal[2]) * TURN_SCALE_M / flat
    return _facing(motion, forward, travel, (lever, sigma * TURN_SCALE_M), sigma, turns)


def _facing(
    motion: TwistIntervals,
    forward: Array,
    travel: float,
    lever_x: tuple[float, float],
    sigma: float,
    turns: bool,
) -> Mounting:
    """Resolves forward and backward; `travel` is the direction of travel in the tracked frame."""
    lever, lever_sigma = lever_x
    along = motion.twist[:, :2] @ np.array([np.cos(travel), np.sin(travel)])
    if float(along @ forward) < 0.0:
        travel, lever = travel + np.pi, -lever
    return Mounting(
        float(wrap_angle(travel)),
        np.array([lever, 0.0]),
        float(sigma),
        np.array([lever_sigma, np.nan]),
        turns,
    )


def lateral_lever(motion: TwistIntervals, rotation: float, speed: Array) -> tuple[float, float]:
    """Estimates the lever arm along y and its uncertainty [m] from a speed (n,).

    The speed is measured or inferred from commands. The tracked point is faster than `base_link`
    on the outside of a curve: `ux = gain speed - lever_y wz`. The uncertainty is NaN if all
    curves were alike.
    """
    along = rotate(motion.twist[:, :2], -rotation)[:, 0]
    chi = np.stack([speed, motion.twist[:, 2]], axis=1)
    size = np.linalg.svd(chi * np.array([1.0, TURN_SCALE_M]), compute_uv=False)
    if size[1] < 2.0 * MIN_SECOND * size[0]:
        return 0.0, float("nan")
    beta = np.linalg.lstsq(chi, along, rcond=None)[0]
    return -float(beta[1]), float(standard_errors(chi, along - chi @ beta)[1])


def mounting_by_commands(motion: TwistIntervals, response: Array) -> Mounting | None:
    """Estimates the mounting on an omnidirectional robot.

    Args:
        motion: twists of the tracked body.
        response: (n, 3) twist of `base_link` expected from state or commands, up to one factor.

    Returns:
        The mounting, or None unless the robot moved along x and y and turned.
    """
    size = np.linalg.svd(response, compute_uv=False)
    if size[2] <= MIN_SECOND * size[0]:
        return None
    gain, *_ = np.linalg.lstsq(response, motion.twist, rcond=None)
    rest = motion.twist - response @ gain
    spread = np.stack([standard_errors(response, column) for column in rest.T], axis=1)
    rotation = float(np.arctan2(gain[0, 1] - gain[1, 0], gain[0, 0] + gain[1, 1]))
    across = rotate(gain[2, :2], -rotation) / gain[2, 2]  # (-lever_y, lever_x)
    scale = float(np.hypot(gain[0, 0], gain[0, 1]))
    return Mounting(
        float(wrap_angle(rotation)),
        np.array([across[1], -across[0]]),
        float(spread[0, 1] / scale),
        np.full(2, float(spread[2, 0] / abs(gain[2, 2]))),
        True,
    )


BLOCKS = 8
Estimate = Callable[[Recording, TwistIntervals], Mounting | None]


def jackknifed(
    recording: Recording, twists: TwistIntervals, offset: float, estimate: Estimate
) -> Mounting | None:
    """Estimates a mounting, with at least the uncertainty of the delete-one-block jackknife.

    Args:
        recording: the drive.
        twists: of the tracked body.
        offset: of the pose's clock, as in `Calibration` [s].
        estimate: estimates the mounting from a drive and its twists.

    Returns:
        The mounting from the whole drive; None if it can't be estimated.
    """
    whole = estimate(recording, twists)
    if whole is None:
        return None
    edges = np.linspace(twists.start[0], twists.end[-1], BLOCKS + 1)
    parts = [
        estimate(*_without(recording, twists, offset, begin, end)) for begin, end in pairwise(edges)
    ]
    found = [part for part in parts if part is not None]
    if len(found) < BLOCKS:
        return whole
    rotation = wrap_angle(np.array([p.rotation - whole.rotation for p in found]))
    lever = np.array([p.lever for p in found])
    return replace(
        whole,
        rotation_sigma=max(whole.rotation_sigma, float(_spread(rotation))),
        lever_sigma=np.maximum(whole.lever_sigma, _spread(lever)),
    )


def _spread(values: Array) -> Array:
    """Returns standard errors (...) from estimates (B, ...) that each omit one block."""
    return np.asarray(np.sqrt((len(values) - 1.0) * values.var(axis=0)))


def _without(
    recording: Recording, twists: TwistIntervals, offset: float, begin: float, end: float
) -> tuple[Recording, TwistIntervals]:
    """Drops the twists and the measured state between two times of the pose's clock [s]."""
    rows = (twists.end <= begin) | (twists.start >= end)
    kept = TwistIntervals(twists.start[rows], twists.end[rows], twists.twist[rows])
    state = recording.state
    if state is None:
        return recording, kept
    outside = (state.t < begin + offset) | (state.t > end + offset)
    cut = replace(state, t=state.t[outside], values=state.values[outside])
    return replace(recording, state=cut), kept


def wheels_swapped(recording: Recording, twists: TwistIntervals, offset: float) -> bool | None:
    """True if the left wheel is faster in left turns; None if the wheels do not show it."""
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


def wheel_scales(
    recording: Recording, twists: TwistIntervals, calibration: Calibration
) -> Calibration:
    """Adds the scales of the wheel speeds, as far as the drive shows them."""
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
