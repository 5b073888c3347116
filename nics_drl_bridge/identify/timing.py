"""Delays and lags: the shift in time that makes a signal a function of the commands.

Every estimate is a separable least squares: for a given delay (and lags) the best linear
combination of the paper's features (Eq. 1) has a closed form, so the search is over the delay
and the lags only.

Clocks: offset, latency and lags of a recording, from any stream that follows the commands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.identify.least_squares import minimise, uncertainty, unexplained
from nics_drl_bridge.identify.noise import TwistIntervals
from nics_drl_bridge.identify.signals import held, held_features, interval_means, lagged
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

STEP_S = 0.01
LEAD_S = 2.0  # for the states to forget their initial values
STEPS_S = (0.05, 0.005, 0.0005)
SEARCH_S = 5.0
DEFAULT_LAG_S = 0.1
LAG_RANGE_S = (0.005, 2.0)
MAX_ROWS = 2000
EXACT = 1e-6
LONG_STEP = 1.5
"""A step longer than this many usual steps is a gap."""
REGULAR = 0.8


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


def followed(spec: RobotSpec) -> NDArray[np.intp]:
    """Returns the index (S,) of the command that each state variable follows."""
    names = [c.name for c in spec.command]
    return np.array([names.index(str(v.follows)) for v in spec.state], dtype=np.intp)


def moved_commands(command: Stream) -> NDArray[np.bool_]:
    """Returns a mask (C,) of the commands that ever changed."""
    return np.asarray(np.ptp(command.values, axis=0) > 0.0)


def nominal_lags(spec: RobotSpec) -> Array:
    """Returns the spec's time constants (S,), `NAME_lag`, else a typical one [s]."""
    return np.array([spec.parameters.get(f"{v.name}_lag", DEFAULT_LAG_S) for v in spec.state])


def inferred_states(
    command: Stream, spec: RobotSpec, lags: Array, latency: float, grid: Array
) -> Array:
    """Infers states (T, S) at uniform times (T,) on the commands' clock, with gain one.

    Each state follows its command; if the command never changes, the state keeps its value.
    """
    dt = float(grid[1] - grid[0])
    target = held(command, spec, grid - latency, grid + dt - latency)[:, followed(spec)]
    long_ago = np.array([command.t[0] - 2.0])
    initial = held(command, spec, long_ago, long_ago + 1.0)[0, followed(spec)]
    return lagged(target, lags, dt, initial)


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


def fresh(command: Stream, start: Array) -> NDArray[np.bool_]:
    """Returns a mask of the times (n,) at which the command is known; rows may be missing.

    If commands are recorded irregularly, each is assumed to be held until the next.
    """
    span = np.diff(command.t)
    usual = float(np.median(span)) if len(span) else 0.0
    if not (span < LONG_STEP * usual).mean() > REGULAR:
        return np.ones(len(start), dtype=np.bool_)
    row = np.searchsorted(command.t, start + 1e-9, "right") - 1
    return np.asarray(np.append(span, 0.0)[np.clip(row, 0, None)] < LONG_STEP * usual)


def latency_of_state(command: Stream, state: Stream, spec: RobotSpec) -> DelayEstimate | None:
    """Estimates the delay with which a measured state starts to follow the commands.

    None if no command changed; exactly zero if zero explains the state to rounding.
    """
    if not moved_commands(command).any():
        return None
    return _search_or_zero(state_residual(command, state, spec))


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


def delay_of_pose(
    state: Stream, target: tuple[Array, Array, Array], centers: tuple[float, ...]
) -> DelayEstimate:
    """Estimates the delay of the pose's clock behind that of a measured state."""
    return _search_or_zero(residual_by_shift(state, target), centers)


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


def timing_of(recording: Recording, spec: RobotSpec, twists: TwistIntervals) -> TimingEstimate:
    """Estimates clock offset, latency and lags as far as the recording allows."""
    if recording.state is not None:
        return _timing_of_measured_state(recording, recording.state, spec, twists)
    if not moved_commands(recording.command).any():
        nothing = np.full(len(spec.state), np.nan)
        start = recording.command.t[0] - recording.pose.t[0]
        offset = float(start) if abs(start) > 60.0 else 0.0
        return TimingEstimate(offset, 0.0, {}, nominal_lags(spec), nothing, False)
    target = (twists.start, twists.end, twists.twist)
    centers = _likely_shifts(recording)
    if recording.pose.clock == recording.command.clock:
        delay = delay_of_response(recording.command, spec, target)
        latency = if_certain(max(delay.value, 0.0), delay.sigma, MIN_TIME_S)
        sigma = {"command_latency_s": delay.sigma}
        return TimingEstimate(0.0, latency, sigma, delay.lags, delay.lag_sigma, True)
    wheels = _wheel_delay(recording, spec)
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


def _timing_of_measured_state(
    recording: Recording, state: Stream, spec: RobotSpec, twists: TwistIntervals
) -> TimingEstimate:
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
    return TimingEstimate(offset, latency, sigma, nothing, nothing, found is not None)


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
