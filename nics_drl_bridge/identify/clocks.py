"""Clocks: offset, latency and lags of a drive, from any stream that follows the commands.

Each is the shift in time that makes a signal a function of the commands, by a separable least
squares: for a given delay (and lags) the best linear combination of the paper's features (Eq. 1)
has a closed form, so the search is over the delay and the lags only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.identify.drive import MIN_STAMPS, Drive, TwistIntervals
from nics_drl_bridge.identify.signals import (
    followed,
    held,
    held_features,
    inferred_states,
    interval_means,
    moved_commands,
    nominal_lags,
    speed_index,
)
from nics_drl_bridge.identify.statistics import minimise, uncertainty, unexplained
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

STEP_S = 0.01
LEAD_S = 2.0  # for the states to forget their initial values
STEPS_S = (0.05, 0.005, 0.0005)
SEARCH_S = 5.0
LAG_RANGE_S = (0.005, 2.0)
MAX_ROWS = 2000
EXACT = 1e-6
LONG_STEP = 1.5
"""A step longer than this many usual steps is a gap."""


@dataclass(frozen=True)
class DelayEstimate:
    """An estimated delay.

    Attributes:
        value: from the command's stamp to its effect, each on its own clock [s].
        sigma: its standard uncertainty [s].
        lags: (S,) time constants of the inferred states [s].
        lag_sigma: (S,) their standard uncertainty; NaN where not estimated.
        explained: share of the signal's variance that the response explains.
    """

    value: float
    sigma: float
    lags: Array
    lag_sigma: Array
    explained: float


def delay_of_response(
    command: Stream,
    spec: RobotSpec,
    target: tuple[Array, Array, Array],
    centers: tuple[float, ...] = (0.0,),
    lags: Array | None = None,
) -> DelayEstimate:
    """Estimates the delay and the lags with which a signal follows the commands.

    Args:
        command: the commands.
        spec: the robot; each of its state variables follows a command.
        target: start (n,), end (n,) of intervals and the signal's mean (n, K) over each.
        centers: of the search for the delay [s].
        lags: (S,) known time constants; None to estimate those of the commands that moved.
    """
    moved = moved_commands(command)[followed(spec)] if spec.state else moved_commands(command)
    free = np.flatnonzero(moved[: len(spec.state)]) if lags is None else np.zeros(0, dtype=np.intp)
    base = nominal_lags(spec) if lags is None else lags
    left_over = response_residual(command, spec, target)

    def residual(theta: Array) -> Array:
        tau = base.copy()
        tau[free] = np.exp(theta[1:])
        return left_over(tau, theta[0])

    theta, sigma, explained = _search(residual, centers, np.log(base[free]))
    found, spread = base.copy(), np.full(len(base), np.nan)
    found[free] = np.exp(theta[1:])
    spread[free] = sigma[1:] * found[free]
    return DelayEstimate(float(theta[0]), float(sigma[0]), found, spread, explained)


def response_residual(
    command: Stream, spec: RobotSpec, target: tuple[Array, Array, Array]
) -> Callable[[Array, float], Array]:
    """Returns the residual of a signal explained by commands, given lags (S,) and a delay [s]."""
    start, end, signal = target
    moved = moved_commands(command)[followed(spec)] if spec.state else moved_commands(command)
    powers = taylor.exponents(len(moved), 2)
    powers = powers[(powers[:, ~moved] == 0).all(axis=1)]
    grid = np.arange(start.min() - LEAD_S, end.max() + STEP_S, STEP_S)

    def residual(lags: Array, delay: float) -> Array:
        if not spec.state:
            means = held_features(command, spec, powers, start - delay, end - delay)
            return unexplained(means, signal)
        chi = taylor.evaluate(inferred_states(command, spec, lags, delay, grid), powers)
        return unexplained(interval_means(grid, chi, start, end), signal)

    return residual


def state_residual(command: Stream, state: Stream, spec: RobotSpec) -> Callable[[Array], Array]:
    """Returns the residual of a measured state's rates, given a delay (1,) of the commands [s]."""
    span = np.diff(state.t)
    keep = np.flatnonzero((span > 0.0) & (span < LONG_STEP * np.median(span)))
    if len(keep) > MAX_ROWS:  # golden-section sampling: no stride that commands could share
        keep = keep[np.unique((np.arange(MAX_ROWS) * 0.6180339887 % 1.0 * len(keep)).astype(int))]
    start, end = state.t[keep], state.t[keep + 1]
    rates = (state.values[keep + 1] - state.values[keep]) / (end - start)[:, None]
    middle = (state.values[keep + 1] + state.values[keep]) / 2.0

    def residual(theta: Array) -> Array:
        u = held(command, spec, start - theta[0], end - theta[0])
        return unexplained(np.concatenate([np.ones((len(u), 1)), middle, u], axis=1), rates)

    return residual


def residual_by_shift(
    state: Stream, target: tuple[Array, Array, Array]
) -> Callable[[Array], Array]:
    """Returns the residual of the pose's rates, given a delay (1,) of the measured state [s]."""
    start, end, signal = target
    chi = taylor.evaluate(state.values, taylor.exponents(state.values.shape[1], 2))

    def residual(theta: Array) -> Array:
        means = interval_means(state.t, chi, start - theta[0], end - theta[0])
        return unexplained(means, signal)

    return residual


def _search_or_zero(
    residual: Callable[[Array], Array], centers: tuple[float, ...] = (0.0,)
) -> DelayEstimate:
    """Estimates a delay; exactly zero if zero explains the signal to rounding."""
    nothing = np.zeros(0)
    if np.sqrt((residual(np.zeros(1)) ** 2).mean()) < EXACT:
        return DelayEstimate(0.0, 0.0, nothing, nothing, 1.0)
    theta, sigma, explained = _search(residual, centers, nothing)
    return DelayEstimate(float(theta[0]), float(sigma[0]), nothing, nothing, explained)


def _search(
    residual: Callable[[Array], Array], centers: tuple[float, ...], log_lags: Array
) -> tuple[Array, Array, float]:
    """Returns delay and log lags of least residual, their uncertainty and the explained share.

    The delay is searched on ever finer grids, then refined together with the lags.
    """
    around = np.array(centers)
    for reach, step in zip((SEARCH_S, *STEPS_S[:-1]), STEPS_S, strict=True):
        tries = np.add.outer(around, np.arange(-reach, reach + step / 2.0, step)).ravel()
        cost = [float((residual(np.append(d, log_lags)) ** 2).sum()) for d in tries]
        around = tries[[int(np.argmin(cost))]]
    start = np.append(around, log_lags)
    low = np.append(start[0] - 0.5, np.full(len(log_lags), np.log(LAG_RANGE_S[0])))
    high = np.append(start[0] + 0.5, np.full(len(log_lags), np.log(LAG_RANGE_S[1])))
    found, jacobian, rest = minimise(residual, start, np.full(len(start), 0.1), (low, high))
    if float((rest**2).sum()) >= min(cost):
        found, rest = start, residual(start)
    return found, uncertainty(jacobian, rest), 1.0 - float((rest**2).mean())


WHEELS_EXPLAINED = 0.5
"""The commands must explain this share of the wheels' variance."""
WITHIN_TICK = 12.0**-0.5
"""Wheel speeds are assumed to be the mean over the tick that ends at their stamp, but some drivers
report instantaneous speeds. A time is uncertain by the standard deviation of a uniform
distribution over the tick."""
MIN_TIME_S = 5e-4
CERTAIN = 3.0
"""A correction below this many standard uncertainties is not made."""


@dataclass(frozen=True)
class TimingEstimate:
    """Offset and latency as in `Calibration`, with lags and uncertainties.

    Attributes:
        offset, latency: [s].
        sigma: standard uncertainty of each estimated value, by its name in `Calibration`.
        lags: (S,) of the inferred states [s]; empty if the state was measured.
        lag_sigma: (S,) [s]; NaN for a nominal lag.
        separated: True if offset and latency could be separated.
    """

    offset: float
    latency: float
    sigma: dict[str, float]
    lags: Array
    lag_sigma: Array
    separated: bool


def timing_of(drive: Drive) -> TimingEstimate:
    """Estimates clock offset, latency and lags as far as the recording allows.

    Raises:
        RecordingError: the state can't be known, or there are too few poses.
    """
    recording, spec = drive.recording, drive.spec
    _require_state(recording, spec)
    twists = drive.twists
    if len(twists.start) < MIN_STAMPS:
        raise RecordingError(
            f"{recording.source}: pose: only {len(twists.start)} usable intervals; record a drive "
            "of 20 s or more without long gaps."
        )
    if recording.state is not None:
        return _timing_of_measured_state(drive, recording.state)
    if not moved_commands(recording.command).any():
        start = recording.command.t[0] - recording.pose.t[0]
        return nominal_timing(drive, float(start) if abs(start) > 60.0 else 0.0)
    target = (twists.start, twists.end, twists.twist)
    if recording.pose.clock == recording.command.clock:
        delay = delay_of_response(recording.command, spec, target)
        latency = if_certain(max(delay.value, 0.0), delay.sigma, MIN_TIME_S)
        sigma = {"command_latency_s": delay.sigma}
        return TimingEstimate(0.0, latency, sigma, delay.lags, delay.lag_sigma, True)
    return _timing_of_two_clocks(recording, spec, target)


def nominal_timing(drive: Drive, offset: float = 0.0) -> TimingEstimate:
    """Returns a timing with nominal lags and no latency, of which nothing was estimated."""
    lags = nominal_lags(drive.spec) if drive.recording.state is None else np.zeros(0)
    return TimingEstimate(offset, 0.0, {}, lags, np.full(len(lags), np.nan), False)


def _require_state(recording: Recording, spec: RobotSpec) -> None:
    missing = [v.name for v in spec.state if v.follows is None]
    if recording.state is None and missing:
        raise RecordingError(
            f"{recording.source}: has no measured state, and {missing[0]!r} of robot {spec.name!r} "
            "follows no command; record the state too, or add `follows:` to the robot's YAML file."
        )


def _timing_of_two_clocks(
    recording: Recording, spec: RobotSpec, target: tuple[Array, Array, Array]
) -> TimingEstimate:
    """Estimates offset and latency apart if the wheels follow the commands, else their sum."""
    centers, wheels = _likely_shifts(recording), _wheel_delay(recording, spec)
    delay = delay_of_response(
        recording.command, spec, target, centers, None if wheels is None else wheels.lags
    )
    if wheels is None:
        sigma = {"clock_offset_s": delay.sigma}
        return TimingEstimate(-delay.value, 0.0, sigma, delay.lags, delay.lag_sigma, False)
    sigma = {
        "clock_offset_s": float(np.hypot(wheels.sigma, delay.sigma)),
        "command_latency_s": wheels.sigma,
    }
    latency = max(wheels.value, 0.0)
    return TimingEstimate(
        latency - delay.value, latency, sigma, wheels.lags, wheels.lag_sigma, True
    )


def _timing_of_measured_state(drive: Drive, state: Stream) -> TimingEstimate:
    recording, twists, sigma = drive.recording, drive.twists, {}
    latency, offset, nothing = 0.0, 0.0, np.zeros(0)
    separated = bool(moved_commands(recording.command).any())
    if separated:
        found = _search_or_zero(state_residual(recording.command, state, drive.spec))
        sigma["command_latency_s"] = found.sigma
        least = 0.05 * float(np.median(np.diff(state.t)))
        latency = if_certain(max(found.value, 0.0), found.sigma, least)
    if recording.pose.clock != state.clock:
        by_shift = residual_by_shift(state, (twists.start, twists.end, twists.twist))
        delay = _search_or_zero(by_shift, _likely_shifts(recording))
        sigma["clock_offset_s"] = delay.sigma
        offset = -if_certain(delay.value, delay.sigma, MIN_TIME_S)
    return TimingEstimate(offset, latency, sigma, nothing, nothing, separated)


def _likely_shifts(recording: Recording) -> tuple[float, ...]:
    """Returns search centres for the delay of the pose's clock: no shift, or a common start [s]."""
    return 0.0, float(recording.pose.t[0] - recording.command.t[0])


def _wheel_delay(recording: Recording, spec: RobotSpec) -> DelayEstimate | None:
    """Returns the delay of the wheels; None on another clock or if they do not follow commands."""
    wheels = recording.wheels
    if wheels is None or wheels.clock != recording.command.clock:
        return None
    tick = float(np.median(np.diff(wheels.t)))
    found = delay_of_response(recording.command, spec, (wheels.t - tick, wheels.t, wheels.values))
    if not found.explained > WHEELS_EXPLAINED:
        return None
    return replace(found, sigma=float(np.hypot(found.sigma, WITHIN_TICK * tick)))


def if_certain(value: float, sigma: float, least: float) -> float:
    """Returns a correction, or zero if it is too small or too uncertain."""
    return value if abs(value) > max(CERTAIN * sigma, least) else 0.0


def expected_states(drive: Drive, twists: TwistIntervals, timing: TimingEstimate) -> Array:
    """Returns the mean state (n, S) over the intervals of the twists; inferred ones at gain 1."""
    recording, (start, end) = drive.recording, twists.on_clock(timing.offset)
    if recording.state is not None:
        return interval_means(recording.state.t, recording.state.values, start, end)
    grid = np.arange(min(start[0], recording.command.t[0]) - 1.0, end[-1] + 0.01, 0.01)
    states = inferred_states(recording.command, drive.spec, timing.lags, timing.latency, grid)
    return interval_means(grid, states, start, end)


def expected_speed(drive: Drive, timing: TimingEstimate) -> Array | None:
    """Returns the speed (n,) over the intervals of the twists, at gain 1; None if not unique."""
    speed = speed_index(drive.spec)
    return None if speed is None else expected_states(drive, drive.twists, timing)[:, speed]
