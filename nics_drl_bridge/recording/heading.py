"""Compares a robot's turns by odometry and by gyro, and turns poses by the gyro.

Wheels slip when a robot turns, so odometry may report too much or too little turning. A gyro does
not slip, but has a bias, which shows while the wheels stand still.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array

BLOCK_S = 0.5  # length of the pieces in which both turns are compared
WINDOW_S = 5.0  # time over which the disagreement is reported
LONGEST_GAP_S = 0.25  # maximum gap between two yaw rates that are joined
MAX_POSE_PAUSE_S = 1.0  # maximum time between two poses of one drive
FEWEST_BLOCKS = 6
FEWEST_TO_DRIFT = 10
STANDING_MPS = 0.005  # wheels that roll more slowly in a whole block are at rest
STANDING_RADPS = 0.005
FEWEST_AT_REST = 2  # blocks; with fewer, the bias comes from the drive instead
LEAST_BIAS_STD = 1e-5  # [rad/s]
# Prior deviations of a bias from 0 [rad/s], and of the scale of turns from 1
USUAL_BIAS = 0.01
USUAL_FACTOR = 0.5
LEAST_RATE_NOISE = 1e-3  # minimum noise of a block's mean rate [rad/s]
# Factor on errors, because the blocks of a drive are not independent of each other
UNLIKE_BLOCKS = 2.0
DRIFTS = 4.0  # standard errors beyond which the slope of a bias counts
DRIFT_SPAN_S = 20.0  # a drift of the bias shows only if the rests span this time
LEAST_TURN_RAD = 1.0  # sum of all turns below which a drive does not show a scale
# minimum correlation of two sources that measure the same motion
MIN_SAME_MOTION_CORRELATION = 0.7
# plausible range of odometry's turns, relative to those of the gyro
PLAUSIBLE_SCALES = (0.33, 5.0)
IN_DEGREES = (40.0, 80.0)  # ratio of a rate in degrees to one in radians
LEAST_APART_RAD = 0.02  # a smaller disagreement in `WINDOW_S` is not worth a correction
GYRO_SCALE_STD = 0.015  # relative deviation of a typical gyro's scale
CLEARLY = 3.0  # standard errors


@dataclass(frozen=True)
class GyroBias:
    """The bias of a gyro."""

    bias: float  # bias of the gyro in the middle of its rests or of the drive [rad/s]
    bias_std: float  # [rad/s]
    bias_slope: float  # its change [rad/s^2]; 0 if none shows
    bias_time: float  # time to which `bias` belongs [s]
    rest_s: float  # time at rest that shows the bias; 0 if the drive shows it

    def compute_bias(self, t: Array) -> Array:
        """Returns the bias (T,) at times (T,) [s]."""
        return np.asarray(self.bias + self.bias_slope * (t - self.bias_time))


@dataclass(frozen=True)
class Turning(GyroBias):
    """Comparison of a robot's turns by odometry and by gyro."""

    scale: float  # odometry's turn per turn of the gyro; NaN if the robot turned too little
    scale_std: float
    alike: float  # correlation of both rates; NaN if the robot turned too little
    window_s: float
    apart: float  # root mean square disagreement after `window_s` [rad]; NaN if the drive is short
    apart_std: float  # possible contribution of the gyro's bias and scale to that [rad]

    @property
    def compared(self) -> bool:
        """True if the robot turned enough for a comparison."""
        return bool(np.isfinite(self.alike) and np.isfinite(self.apart))

    @property
    def mirrored(self) -> bool:
        """True if the two turn in opposite directions."""
        return self.compared and self.alike < -MIN_SAME_MOTION_CORRELATION

    @property
    def in_degrees(self) -> bool:
        """True if the gyro seems to measure in degrees per second."""
        low, high = IN_DEGREES
        return self._is_same_motion and low < 1.0 / self.scale < high

    @property
    def plausible(self) -> bool:
        """True if both measure the same motion, in the same unit and direction."""
        low, high = PLAUSIBLE_SCALES
        return self._is_same_motion and low < self.scale < high

    @property
    def _is_same_motion(self) -> bool:
        return self.compared and self.alike > MIN_SAME_MOTION_CORRELATION

    @property
    def contradicts(self) -> bool:
        """True if they disagree by more than the gyro's own errors explain."""
        return self.compared and self.apart > max(
            LEAST_APART_RAD, CLEARLY * self.apart_std
        )


def compare_turning(
    t: Array, pose: Array, gyro_t: Array, yaw_rate: Array, window_s: float = WINDOW_S
) -> Turning | None:
    """Compares poses (T, 3) at t (T,) with yaw rates (G,) at gyro_t (G,), all on one clock.

    Returns None if they overlap for too short a time.
    """
    if min(len(t), len(gyro_t)) < FEWEST_BLOCKS:
        return None
    blocks = _split_blocks(t, pose, gyro_t, yaw_rate)
    if len(blocks.span) < FEWEST_BLOCKS:
        return None
    bias = _estimate_bias(blocks)
    unbiased = blocks.gyro_rate - bias.compute_bias(blocks.middle)
    scale, scale_std, alike = _estimate_scale(blocks.odom_rate, unbiased, blocks.span)
    apart = _compute_rms(blocks, blocks.odom_rate - unbiased, window_s)
    turned = _compute_rms(blocks, unbiased, window_s)
    return Turning(
        **vars(bias),
        scale=scale,
        scale_std=scale_std,
        alike=alike,
        window_s=window_s,
        apart=apart,
        apart_std=float(np.hypot(bias.bias_std * window_s, GYRO_SCALE_STD * turned)),
    )


def turn_by_gyro(
    t: Array, pose: Array, gyro_t: Array, yaw_rate: Array, turning: Turning
) -> tuple[Array, float]:
    """Returns poses (T, 3) from the wheels' displacements along the heading of the gyro.

    Also returns the fraction of the driving time that the gyro covers; elsewhere the wheels turn
    the robot.
    """
    gyro_turn, covered = _integrate_gyro(
        t, gyro_t, yaw_rate - turning.compute_bias(gyro_t)
    )
    step = geometry.log(geometry.between(pose[:-1], pose[1:]))
    standing = (step == 0.0).all(axis=1)
    step[covered, 2] = gyro_turn[covered]
    step[standing, 2] = 0.0
    turned = chain_poses(pose[0], geometry.exp(step))
    span = np.diff(t)
    driven = span < MAX_POSE_PAUSE_S  # a longer span separates two recordings
    driven_s = max(float(span[driven].sum()), 1e-9)
    return turned, float(span[covered & driven].sum()) / driven_s


def chain_poses(pose: Array, relative: Array) -> Array:
    """Returns poses (T + 1, 3) from `pose` (3,) on, each `relative` (T, 3) to the one before."""
    heading = pose[2] + geometry.accumulate(relative[:, 2])
    shift = geometry.rotate(relative[:, :2], heading[:-1])
    position = pose[:2] + np.append(np.zeros((1, 2)), np.cumsum(shift, axis=0), axis=0)
    return np.concatenate([position, geometry.wrap_angle(heading)[:, None]], axis=1)


@dataclass(frozen=True)
class _Blocks:
    """The n pieces of a drive that both sources cover."""

    middle: Array  # (n,) time [s]
    span: Array  # (n,) [s]
    odom_rate: Array  # (n,) mean yaw rate by odometry [rad/s]
    gyro_rate: Array  # (n,) mean yaw rate by the gyro [rad/s]
    speed: Array  # (n,) path of the wheels over time [m/s]


def _integrate_gyro(
    t: Array, gyro_t: Array, yaw_rate: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Returns the gyro's turns (T - 1,) [rad] between times (T,), and whether it covers them."""
    span = np.diff(gyro_t)
    total = geometry.accumulate(0.5 * (yaw_rate[1:] + yaw_rate[:-1]) * span)
    turn = np.diff(np.interp(t, gyro_t, total))
    # Time without a gyro up to each moment; an interval that contains any is not covered.
    lost = geometry.accumulate(np.where(span > LONGEST_GAP_S, span, 0.0))
    without = np.diff(np.interp(t, gyro_t, lost))
    inside = (t[:-1] >= gyro_t[0] - 1e-9) & (t[1:] <= gyro_t[-1] + 1e-9)
    return turn, np.asarray(inside & (without < 1e-9))


def _split_blocks(t: Array, pose: Array, gyro_t: Array, yaw_rate: Array) -> _Blocks:
    """Splits a drive at the poses nearest to multiples of `BLOCK_S`, and averages both rates."""
    place = np.unique(np.searchsorted(t, np.arange(t[0], t[-1] + 1e-9, BLOCK_S)))
    place = place[place < len(t)]
    at = t[place]
    heading = np.unwrap(pose[:, 2])
    path = geometry.measure_path(pose)
    gyro_turn, covered = _integrate_gyro(at, gyro_t, yaw_rate)
    span = np.diff(at)
    usable = covered & (span > 0.5 * BLOCK_S) & (span < 2.0 * BLOCK_S)
    span = span[usable]
    return _Blocks(
        middle=(0.5 * (at[1:] + at[:-1]))[usable],
        span=span,
        odom_rate=np.diff(heading[place])[usable] / span,
        gyro_rate=gyro_turn[usable] / span,
        speed=np.diff(path[place])[usable] / span,
    )


def _estimate_bias(blocks: _Blocks) -> GyroBias:
    """Estimates the bias, and its slope if significant, at rest; else while driving."""
    rest = (blocks.speed < STANDING_MPS) & (np.abs(blocks.odom_rate) < STANDING_RADPS)
    if rest.sum() < FEWEST_AT_REST:
        return _estimate_bias_while_driving(blocks)
    rate = blocks.gyro_rate[rest]
    when = blocks.middle[rest]
    rest_s = float(blocks.span[rest].sum())
    usual = float(np.median(rate))
    scatter = 1.4826 * float(np.median(np.abs(rate - usual)))
    # Blocks in which somebody turned the robot are ignored.
    near = np.abs(rate - usual) <= max(5.0 * scatter, 1e-3)
    rate = rate[near]
    when = when[near]
    bias = float(rate.mean())
    middle = float(when.mean())
    residual = rate - bias
    slope = 0.0
    if len(rate) >= FEWEST_TO_DRIFT and float(np.ptp(when)) >= DRIFT_SPAN_S:
        since_middle = when - middle
        power = float(since_middle @ since_middle)
        fitted_slope = float(since_middle @ rate) / power
        unexplained = residual - fitted_slope * since_middle
        slope_std = max(float(unexplained.std()), LEAST_BIAS_STD) / np.sqrt(power)
        if abs(fitted_slope) >= DRIFTS * slope_std:
            slope = fitted_slope
            residual = unexplained
    std = max(float(residual.std() / np.sqrt(len(rate))), LEAST_BIAS_STD)
    return GyroBias(bias, std, slope, middle, rest_s)


def _estimate_bias_while_driving(blocks: _Blocks) -> GyroBias:
    """Fits the bias together with a factor on odometry's turns."""
    # A robot that turns at only one rate does not show both, so both have priors.
    chi = np.stack([np.ones_like(blocks.odom_rate), blocks.odom_rate], axis=1)
    coefficients, *_ = np.linalg.lstsq(chi, blocks.gyro_rate, rcond=None)
    residual = blocks.gyro_rate - chi @ coefficients
    variance = float(residual @ residual) / max(len(residual) - 2, 1)
    noise = UNLIKE_BLOCKS**2 * max(variance, LEAST_RATE_NOISE**2)
    usual = np.array([0.0, 1.0])
    deviation = np.array([USUAL_BIAS, USUAL_FACTOR])
    spread = np.linalg.inv(chi.T @ chi / noise + np.diag(deviation**-2.0))
    bias = (spread @ (chi.T @ blocks.gyro_rate / noise + usual / deviation**2))[0]
    std = max(float(np.sqrt(spread[0, 0])), LEAST_BIAS_STD)
    return GyroBias(float(bias), std, 0.0, float(blocks.middle.mean()), 0.0)


def _estimate_scale(
    odom_rate: Array, gyro_rate: Array, span: Array
) -> tuple[float, float, float]:
    """Returns odometry's turn per turn of the gyro, its deviation, and their correlation."""
    turned = max(float(np.abs(rate) @ span) for rate in (odom_rate, gyro_rate))
    power = float(gyro_rate @ gyro_rate)
    odom_power = float(odom_rate @ odom_rate)
    if turned < LEAST_TURN_RAD or power * odom_power == 0.0:
        return np.nan, np.nan, np.nan
    together = float(odom_rate @ gyro_rate)
    scale = together / power
    residual = odom_rate - scale * gyro_rate
    variance = residual @ residual / max(len(residual) - 1, 1)
    std = UNLIKE_BLOCKS * float(np.sqrt(variance / power))
    return scale, std, together / float(np.sqrt(power * odom_power))


def _compute_rms(blocks: _Blocks, rate: Array, window_s: float) -> float:
    """Returns the root mean square of turns at rates (n,) over windows [rad]."""
    turn = rate * blocks.span
    count = max(1, round(window_s / BLOCK_S))
    if len(turn) < count:
        return np.nan
    total = geometry.accumulate(turn)
    sums = total[count:] - total[:-count]
    # A window across a gap contains less time than its length suggests.
    half = 0.5 * blocks.span
    end = blocks.middle + half
    begin = blocks.middle - half
    is_whole = end[count - 1 :] - begin[: len(sums)] < 1.5 * window_s
    if not is_whole.any():
        return np.nan
    return float(np.sqrt(np.mean(sums[is_whole] ** 2)))
