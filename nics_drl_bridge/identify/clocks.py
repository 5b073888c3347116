"""Clocks: offset, latency and lags of a drive, each the shift that best explains it by commands."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import alignment
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.drive import MIN_STAMPS, Drive, TwistIntervals
from nics_drl_bridge.identify.statistics import (
    CERTAIN,
    compute_unexplained,
    estimate_standard_errors,
    estimate_uncertainty,
    minimise,
)
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec

# start (n,), end (n,) of intervals, and a signal's means (n, K)
Target = tuple[Array, Array, Array]
# residual as a function of a trial delay [s] and possibly the logarithms of lags
Residual = Callable[[Array], Array]
# residual as a function of lags (S,) and a delay [s]
Left = Callable[..., Array]

STEP_S = 0.01
LEAD_S = 2.0  # lead time in which the states forget their initial values
STEPS_S = (0.05, 0.005, 0.0005)
SEARCH_S = 5.0
# steps of the search, in the delay [s] and in log(lag / s)
BOUNDS = (
    (-0.5, np.log(0.005)),
    (0.5, np.log(2.0)),
)
MAX_ROWS = 2000
FEW_ROWS = 1000
EXACT = 1e-6
LONG_STEP = 1.5  # a step longer than this many usual steps is a gap
# minimum fraction of the wheels' variance that the commands must explain
WHEELS_EXPLAINED = 0.5
# Wheel speeds are assumed to be means over the tick that ends at their stamp, but some drivers
# report instantaneous ones: times are uncertain by the spread of a uniform distribution.
WITHIN_TICK = 12.0**-0.5
MIN_TIME_S = 5e-4
NO_LAG_S = 0.005
# fraction of unexplained variance above which no delay is believed
MOST_UNEXPLAINED = 0.5
# commands count as late if allowing that reduces the residual to this fraction
EARLY_WORTH = 0.8
# The delay is sought in this many parts of a drive, this far around that of the whole. It drifts
# if it grows by more than the minimum, and the parts lie on a line to this fraction of the growth.
DRIFT_PARTS = 4
DRIFT_REACH_S = 0.6
DRIFT_STEP_S = 0.03
LEAST_DRIFT_S = 0.12
DRIFT_OFF = 0.25
MIN_EARLY_S = 0.03  # smaller lead times may be the effect of an imperfect lag
SEPARABLE_S = (
    0.005  # a latency less certain than this can't be distinguished from a lag
)


@dataclass(frozen=True)
class DelayEstimate:
    """A delay from the command's stamp to its effect, each on its own clock."""

    value: float  # [s]
    sigma: float  # standard uncertainty [s]
    lags: Array  # (S,) time constants of the inferred states [s]
    lag_sigma: Array  # (S,) standard uncertainty; NaN where not estimated
    explained: float  # fraction of the signal's variance that the response explains


def estimate_response_delay(
    command: Stream,
    spec: RobotSpec,
    target: Target,
    centers: tuple[float, ...] = (0.0,),
    lags: Array | None = None,
) -> DelayEstimate:
    """Estimates a signal's delay around centers [s], and the moved commands' lags if unknown."""
    moved = alignment.select_moved_inputs(command, spec)[: len(spec.state)]
    free = np.flatnonzero(moved if lags is None else [])
    base = alignment.get_nominal_lags(spec) if lags is None else lags
    left_over = make_response_residual(command, spec, target)

    def residual(theta: Array) -> Array:
        tau = base.copy()
        tau[free] = np.exp(theta[1:])
        return left_over(tau, theta[0])

    estimate = _search(residual, centers, base[free])
    tau = base.copy()
    tau[free] = estimate.lags
    sigma = np.full(len(base), np.nan)
    sigma[free] = estimate.lag_sigma
    return replace(estimate, lags=tau, lag_sigma=sigma)


def make_response_residual(command: Stream, spec: RobotSpec, target: Target) -> Left:
    """Returns the residual of a signal explained by commands, given lags (S,) and a delay [s]."""
    start, end, signal = target
    moved = alignment.select_moved_inputs(command, spec)
    powers = taylor.list_exponents(len(moved), 2)
    powers = powers[(powers[:, ~moved] == 0).all(axis=1)]
    grid = np.arange(start.min() - LEAD_S, end.max() + STEP_S, STEP_S)

    def residual(lags: Array, delay: Array | float) -> Array:
        if not spec.state:
            means = alignment.average_held(
                command, spec, start - delay, end - delay, powers
            )
            return compute_unexplained(means, signal)
        states = alignment.infer_states(command, spec, lags, delay, grid)
        chi = taylor.evaluate(states, powers)
        return compute_unexplained(
            alignment.average_between_stamps(grid, chi, start, end), signal
        )

    return residual


def make_state_residual(command: Stream, state: Stream, spec: RobotSpec) -> Residual:
    """Returns the residual of a measured state's rates, given a delay (1,) of the commands [s]."""
    span = np.diff(state.t)
    keep = np.flatnonzero((span > 0.0) & (span < LONG_STEP * np.median(span)))
    keep = keep[select_some_rows(len(keep), MAX_ROWS)]
    start = state.t[keep]
    end = state.t[keep + 1]
    rates = (state.values[keep + 1] - state.values[keep]) / (end - start)[:, None]
    middle = (state.values[keep + 1] + state.values[keep]) / 2.0

    def residual(theta: Array) -> Array:
        u = alignment.average_held(command, spec, start - theta[0], end - theta[0])
        return compute_unexplained(
            np.concatenate([np.ones((len(u), 1)), middle, u], axis=1), rates
        )

    return residual


def select_some_rows(count: int, most: int) -> NDArray[np.intp]:
    """Returns the indices, in order, of at most `most` of `count` rows."""
    if count <= most:
        return np.arange(count)
    # Golden-section sampling: a regular stride could coincide with a period of the commands.
    return np.unique((np.arange(most) * 0.6180339887 % 1.0 * count).astype(np.intp))


def make_shift_residual(state: Stream, target: Target) -> Residual:
    """Returns the residual of the pose's rates, given a delay (1,) of the measured state [s]."""
    start, end, signal = target
    chi = taylor.evaluate(state.values, taylor.list_exponents(state.values.shape[1], 2))

    def residual(theta: Array) -> Array:
        means = alignment.average_between_stamps(
            state.t, chi, start - theta[0], end - theta[0]
        )
        return compute_unexplained(means, signal)

    return residual


def _search_or_zero(
    residual: Residual, centers: tuple[float, ...] = (0.0,)
) -> DelayEstimate:
    if np.sqrt((residual(np.zeros(1)) ** 2).mean()) < EXACT:
        return DelayEstimate(0.0, 0.0, np.zeros(0), np.zeros(0), 1.0)
    return _search(residual, centers, np.zeros(0))


def _search(
    residual: Residual, centers: tuple[float, ...], lags: Array
) -> DelayEstimate:
    """Finds the delay on successively finer grids, then refines it together with the log lags."""
    delay, cost = _scan_delays(residual, centers, lags)
    start = np.append(delay, np.log(lags))
    low, high = (
        np.append(delay + reach, np.full(len(lags), limit)) for reach, limit in BOUNDS
    )
    theta, jacobian, rest = minimise(
        residual, start, np.full(len(start), 0.1), (low, high)
    )
    if float((rest**2).sum()) >= cost:
        theta = start
        rest = residual(start)
    sigma = estimate_uncertainty(jacobian, rest)
    tau = np.exp(theta[1:])
    explained = 1.0 - float((rest**2).mean())
    return DelayEstimate(
        float(theta[0]), float(sigma[0]), tau, sigma[1:] * tau, explained
    )


def _scan_delays(
    residual: Residual, centers: tuple[float, ...], lags: Array
) -> tuple[float, float]:
    """Returns the delay around the centers that leaves least at given lags, and what it leaves."""
    around = np.array(centers)
    log_lags = np.log(lags)
    for reach, step in zip((SEARCH_S, *STEPS_S[:-1]), STEPS_S, strict=True):
        offsets = np.arange(-reach, reach + step / 2.0, step)
        trials = np.add.outer(around, offsets).ravel()
        cost = [float((residual(np.append(d, log_lags)) ** 2).sum()) for d in trials]
        around = trials[[int(np.argmin(cost))]]
    return float(around[0]), min(cost)


@dataclass(frozen=True)
class TimingEstimate:
    """Offset and latency as in `Calibration`, with lags and uncertainties."""

    offset: float  # [s]
    latency: float  # [s]
    sigma: dict[str, float]  # standard uncertainties by the names in `Calibration`
    lags: Array  # (S,) of the inferred states [s]; empty if the state was measured
    lag_sigma: Array  # (S,) [s]; NaN for a nominal lag
    separated: bool  # True if offset and latency could be separated
    # how far motion on the commands' clock precedes the commands, which means another clock [s]
    early: float = 0.0
    # rate at which the pose's clock gains on the commands' [s/s]; 0 if none is found
    drift: float = 0.0


def check_state_is_known(recording: Recording, spec: RobotSpec) -> None:
    """Raises RecordingError for a state that nothing measured, and that nothing determines."""
    missing = [v.name for v in spec.state if v.must_be_measured]
    if recording.state is not None or not missing:
        return
    place = recording.source
    fault = f"no measured state, and {missing[0]!r} of robot {spec.name!r} follows no command"
    inspect = f"`nics inspect {place} --map my.yaml`"
    advice = f"start a mapping, which needs no `follows:`, with {inspect}"
    advice += ", or record the state too, or add `follows:` to the robot's YAML file"
    raise RecordingError(f"{place}: {fault}; {advice}.")


def measure_timing(drive: Drive) -> TimingEstimate:
    """Estimates clock offset, latency and lags as far as the recording allows (RecordingError)."""
    recording = drive.recording
    spec = drive.spec
    twists = drive.twists
    command = recording.command
    state = recording.state
    place = recording.source
    check_state_is_known(recording, spec)
    if len(twists.start) < MIN_STAMPS:
        fault = f"pose: only {len(twists.start)} usable intervals"
        raise RecordingError(
            f"{place}: {fault}; record a drive of 20 s or more without long gaps."
        )
    if state is not None:
        return _estimate_by_measured_state(drive, state)
    if not alignment.select_moved_commands(command).any():
        start = command.t[0] - recording.pose.t[0]
        return make_nominal_timing(drive, float(start) if abs(start) > 60.0 else 0.0)
    target = (twists.start, twists.end, twists.twist)
    if recording.pose.clock != command.clock:
        return _estimate_on_two_clocks(recording, spec, target)
    delay = estimate_response_delay(command, spec, target)
    latency = keep_if_certain(max(delay.value, 0.0), delay.sigma, MIN_TIME_S)
    sigma = {"command_latency_s": delay.sigma}
    early = keep_if_certain(max(-delay.value, 0.0), delay.sigma, MIN_EARLY_S)
    left_over = make_response_residual(command, spec, target)
    if early and not _is_explained(left_over, delay):
        early = 0.0
    drift = 0.0 if recording.episodes else _find_drift(command, spec, target, delay)
    return TimingEstimate(
        0.0, latency, sigma, delay.lags, delay.lag_sigma, True, early, drift
    )


def _is_explained(left_over: Left, delay: DelayEstimate) -> bool:
    """True if a delay explains a motion well enough to be believed."""
    quick = np.minimum(delay.lags, NO_LAG_S)
    at_once = min(
        float((left_over(lags, 0.0) ** 2).mean()) for lags in (delay.lags, quick)
    )
    left = 1.0 - delay.explained
    return left < MOST_UNEXPLAINED and left < EARLY_WORTH * at_once


def _find_drift(
    command: Stream, spec: RobotSpec, target: Target, delay: DelayEstimate
) -> float:
    """Returns the rate [s/s] at which a delay grows over a drive; 0 unless it grows steadily."""
    middles = []
    delays = []
    for part in np.array_split(np.arange(len(target[0])), DRIFT_PARTS):
        if len(part) < FEW_ROWS // 10:
            return 0.0
        start, end, signal = (values[part] for values in target)
        left_over = make_response_residual(command, spec, (start, end, signal))
        found = _find_delay_near(left_over, delay)
        if found is None:
            return 0.0
        middles.append(float(start.mean()))
        delays.append(found)
    rate, begin = np.polyfit(middles, delays, 1)
    off = np.abs(np.array(delays) - rate * np.array(middles) - begin).max()
    grown = abs(delays[-1] - delays[0])
    if grown > LEAST_DRIFT_S and off < DRIFT_OFF * grown:
        return float(rate)
    return 0.0


def _find_delay_near(left_over: Left, delay: DelayEstimate) -> float | None:
    """Returns the delay [s] around that of a whole drive that leaves least; None if too much."""
    trials = delay.value + np.arange(
        -DRIFT_REACH_S, DRIFT_REACH_S + DRIFT_STEP_S, DRIFT_STEP_S
    )
    left = [float((left_over(delay.lags, trial) ** 2).mean()) for trial in trials]
    if min(left) > MOST_UNEXPLAINED:
        return None
    return float(trials[int(np.argmin(left))])


def make_nominal_timing(drive: Drive, offset: float = 0.0) -> TimingEstimate:
    """Returns nominal lags and no latency, without any estimation."""
    if drive.recording.state is None:
        lags = alignment.get_nominal_lags(drive.spec)
    else:
        lags = np.zeros(0)
    return TimingEstimate(offset, 0.0, {}, lags, np.full(len(lags), np.nan), False)


def _estimate_on_two_clocks(
    recording: Recording, spec: RobotSpec, target: Target
) -> TimingEstimate:
    """Estimates offset and latency separately if the wheels follow the commands, else their sum."""
    wheels = _find_wheel_delay(recording, spec)
    lags = None if wheels is None else wheels.lags
    delay = estimate_response_delay(
        recording.command, spec, target, _list_likely_shifts(recording), lags
    )
    if wheels is None:
        sigma = {"clock_offset_s": delay.sigma}
        return TimingEstimate(
            -delay.value, 0.0, sigma, delay.lags, delay.lag_sigma, False
        )
    both = float(np.hypot(wheels.sigma, delay.sigma))
    latency = max(wheels.value, 0.0)
    sigma = {"clock_offset_s": both, "command_latency_s": wheels.sigma}
    offset = latency - delay.value
    return TimingEstimate(offset, latency, sigma, wheels.lags, wheels.lag_sigma, True)


def _estimate_by_measured_state(drive: Drive, state: Stream) -> TimingEstimate:
    recording = drive.recording
    twists = drive.twists
    sigma = {}
    latency = 0.0
    offset = 0.0
    early = 0.0
    separated = bool(alignment.select_moved_commands(recording.command).any())
    if separated:
        delay = _search_or_zero(
            make_state_residual(recording.command, state, drive.spec)
        )
        sigma["command_latency_s"] = delay.sigma
        least = 0.05 * float(np.median(np.diff(state.t)))
        latency = keep_if_certain(max(delay.value, 0.0), delay.sigma, least)
        early = keep_if_certain(max(-delay.value, 0.0), delay.sigma, MIN_EARLY_S)
    if recording.pose.clock != state.clock:
        by_shift = make_shift_residual(state, (twists.start, twists.end, twists.twist))
        delay = _search_or_zero(by_shift, _list_likely_shifts(recording))
        sigma["clock_offset_s"] = delay.sigma
        offset = -keep_if_certain(delay.value, delay.sigma, MIN_TIME_S)
    return TimingEstimate(
        offset, latency, sigma, np.zeros(0), np.zeros(0), separated, early
    )


def _list_likely_shifts(recording: Recording) -> tuple[float, ...]:
    """Returns search centres for the delay of the pose's clock [s]: no shift, or a common start."""
    return 0.0, float(recording.pose.t[0] - recording.command.t[0])


def _find_wheel_delay(recording: Recording, spec: RobotSpec) -> DelayEstimate | None:
    """Returns the wheels' delay; None if they are on another clock or ignore the commands."""
    wheels = recording.wheels
    if wheels is None or wheels.clock != recording.command.clock:
        return None
    tick = float(np.median(np.diff(wheels.t)))
    target = (wheels.t - tick, wheels.t, wheels.values)
    delay = estimate_response_delay(recording.command, spec, target)
    if not delay.explained > WHEELS_EXPLAINED:
        return None
    return replace(delay, sigma=float(np.hypot(delay.sigma, WITHIN_TICK * tick)))


def keep_if_certain(value: float, sigma: float, least: float) -> float:
    """Returns a correction, or zero if it is too small or too uncertain."""
    return value if abs(value) > max(CERTAIN * sigma, least) else 0.0


def average_expected_states(
    drive: Drive, twists: TwistIntervals, timing: TimingEstimate
) -> Array:
    """Returns the mean state (n, S) over the twists' intervals; inferred ones at a gain of 1."""
    command = drive.recording.command
    state = drive.recording.state
    start, end = twists.on_clock(timing.offset)
    if state is not None:
        return alignment.average_between_stamps(state.t, state.values, start, end)
    grid = np.arange(min(start[0], command.t[0]) - 1.0, end[-1] + 0.01, 0.01)
    states = alignment.infer_states(
        command, drive.spec, timing.lags, timing.latency, grid
    )
    return alignment.average_between_stamps(grid, states, start, end)


def list_responses(
    drive: Drive, calibration: Calibration, timing: TimingEstimate
) -> tuple[Response, ...]:
    """Returns the inferred states; the gain of a speed is that of the motion."""
    spec = drive.spec
    if drive.recording.state is not None:
        return ()
    gains = np.ones(len(spec.state))
    speed = alignment.find_speed_index(spec)
    moved = alignment.select_moved_inputs(drive.recording.command, spec)
    if speed is not None and moved[speed]:
        expected = average_expected_states(drive, drive.twists, timing)[:, speed]
        driven = compute_forward_speed(drive, calibration)
        gains[speed] = float(expected @ driven / (expected @ expected))
    return tuple(
        Response(v.name, str(v.follows), float(lag), float(gain))
        for v, lag, gain in zip(spec.state, timing.lags, gains, strict=True)
    )


def compute_forward_speed(drive: Drive, calibration: Calibration) -> Array:
    """Returns the speed (n,) of `base_link` along x over the intervals of the twists."""
    angle = calibration.rotation_rad
    ux, uy, wz = drive.twists.twist.T
    return np.asarray(
        np.cos(angle) * ux + np.sin(angle) * uy + calibration.lever_arm_m[1] * wz
    )


def average_wheel_speeds(drive: Drive, calibration: Calibration) -> Array | None:
    """Returns mean wheel speeds (n, 2) over the intervals of the twists; None without wheels."""
    wheels = drive.recording.wheels
    if wheels is None:
        return None
    start, end = drive.twists.on_clock(calibration.clock_offset_s)
    return alignment.average_between_stamps(wheels.t, wheels.values, start, end)


def add_wheel_scales(drive: Drive, calibration: Calibration) -> Calibration:
    """Adds scales of wheel speeds; wheels are swapped if the left one is faster in left turns."""
    wheels = average_wheel_speeds(drive, calibration)
    if wheels is None:
        return calibration
    difference = wheels[:, 1] - wheels[:, 0]
    turn = drive.twists.twist[:, 2]
    size = float(np.sqrt((difference**2).mean() * (turn**2).mean()))
    if size > 0.0:
        agreement = float((difference * turn).mean()) / size
        swapped = agreement < 0.0 if abs(agreement) > 0.5 else None
        calibration = replace(calibration, wheels_swapped=swapped)
    speed = compute_forward_speed(drive, calibration)
    calibration = _add_scale(calibration, "wheel_scale", wheels.mean(axis=1), speed)
    return _add_scale(calibration, "turn_scale", difference, turn)


def _add_scale(
    calibration: Calibration, name: str, units: Array, moved: Array
) -> Calibration:
    """Adds the scale by which a motion (n,) follows units (n,) of the wheels, if it is certain."""
    if not float(units @ units) > 0.0:
        return calibration
    scale = float(units @ moved / (units @ units))
    error = float(estimate_standard_errors(units[:, None], moved - scale * units)[0])
    if abs(scale) <= CERTAIN * error:
        return calibration
    named: dict[str, Any] = {name: scale}
    uncertainty = calibration.uncertainty | {name: error}
    return replace(calibration, **named, uncertainty=uncertainty)
