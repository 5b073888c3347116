"""Followers: delay, lag, dead zone and limits of each unmeasured state that follows a command."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import clocks, signals
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.excitation import list_moving_dofs
from nics_drl_bridge.identify.signals import Motors
from nics_drl_bridge.identify.statistics import (
    CERTAIN,
    estimate_clustered_errors,
    minimise,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.curve import InputCurve, delays
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.spec import RobotSpec, StateVariable

# fall, rise and dead zone of a motor without limits
FREE = (-np.inf, np.inf, 0.0)
# lags tried together with limits
LAGS_S = (0.05, 0.15, 0.4)
DELAYS_S = (0.0, 0.05, 0.1, 0.2)
# trial limits, in the command's range per second
RATES = (0.25, 0.5, 1.0, 2.0, 4.0)
# trial dead zones, as fractions of the command's maximum
DEAD = (0.03, 0.07, 0.15, 0.3)
HELPS = 0.95  # a trial must reduce the sum of squares to this fraction
WORTH = 0.8  # and to this fraction once everything is readjusted
# Standard deviation of a uniform distribution about one of its ends, as a fraction of its width: a
# lag before a limit looks like a delay, so the true delay may be anything down to zero.
END = 3.0**-0.5
# a component of the twist counts if commands leave less than this fraction unexplained
EXPLAINED = 0.5
# a limit or dead zone that changes less than this fraction of the residual is undetermined
NO_EFFECT = 1e-6
WIDER = 5.0  # factor by which a limit may change during adjustment


@dataclass(frozen=True)
class _Following:
    """Parameters by which states follow their commands, each (S,)."""

    lags: Array  # [s]
    delays: Array  # from the pose's clock [s]
    motors: Motors


@dataclass(frozen=True)
class _Adjusted:
    """The best parameters, and their errors."""

    best: _Following
    cost: float  # sum of squared residuals
    # (2, m) of delays, and of delay plus lag, for the states that moved [s]
    sigma: Array
    motor_sigma: Array  # (S, 3) of fall, rise and dead zone


def separate_followers(
    drive: Drive, timing: clocks.TimingEstimate
) -> clocks.TimingEstimate:
    """Refines a timing by a separate delay and lag for each command, and the effects of motors.

    Dynamics beyond a single lag, such as those of a higher-order servo, add to a command's delay.
    The latency is the minimum of these delays.
    """
    if drive.recording.state is not None or not drive.spec.state or not timing.sigma:
        return timing
    states = drive.spec.state
    moved = np.flatnonzero(
        signals.select_moved_inputs(drive.recording.command, drive.spec)
    )
    adjusted = _find_following(drive, timing, moved)
    delay = adjusted.best.delays[moved]
    sigma = adjusted.sigma
    if not np.isfinite(sigma).all():
        return timing
    first = int(np.argmin(delay + CERTAIN * sigma[0]))
    spread = CERTAIN * np.hypot(sigma[0], sigma[0, first])
    alike = np.abs(delay - delay[first]) <= spread
    by_wheels = len(timing.sigma) > 1  # the wheels determined the latency
    motors = adjusted.best.motors
    limited = motors.limited
    if by_wheels and alike.all() and not (limited.any() or motors.dead.any()):
        return timing
    least = float(np.average(delay[alike], weights=sigma[0, alike] ** -2.0))
    sigma = np.hypot(sigma, clocks.WITHIN_TICK * clocks.STEP_S)
    delay_sigma = np.hypot(sigma[0], END * np.where(limited[moved], delay - least, 0.0))
    by_limits = 0.0  # a lag before a limit looks like a delay
    if limited.any():
        by_limits = END * max(DELAYS_S)
        if timing.separated and not by_wheels:
            by_limits = END * least
    errors = {}
    for name, error in timing.sigma.items():
        own = error if by_wheels else sigma[0, first]
        errors[name] = float(np.hypot(own, by_limits))
    if timing.separated and not by_wheels:
        least = clocks.keep_if_certain(
            max(least, 0.0), float(sigma[0, first]), clocks.MIN_TIME_S
        )
    if timing.separated and errors["command_latency_s"] > clocks.SEPARABLE_S:
        names = (_name_sum(states[i].name) for i in moved)
        errors |= zip(names, map(float, sigma[1]), strict=True)
    further = 0.0 * timing.lags
    further[moved] = np.where(alike, 0.0, np.maximum(delay - least, 0.0))
    sums = delay + adjusted.best.lags[moved]
    lags = timing.lags.copy()
    lags[moved] = np.maximum(sums - least - further[moved], 0.0)
    lag_sigma = timing.lag_sigma.copy()
    lag_sigma[moved] = np.hypot(*sigma)
    for i, error in zip(moved, delay_sigma.tolist(), strict=True):
        if further[i] > 0.0:
            errors[f"{states[i].follows}.delay"] = error
    errors |= _name_motor_errors(states, adjusted.motor_sigma)
    if by_wheels:
        latency = timing.latency
    elif timing.separated:
        latency = least
    else:
        latency = 0.0
    return replace(
        timing,
        offset=latency - least,
        latency=latency,
        sigma=errors,
        lags=lags,
        lag_sigma=lag_sigma,
        delays=further,
        motors=motors,
    )


def _name_motor_errors(
    states: Sequence[StateVariable], motor_sigma: Array
) -> dict[str, float]:
    """Returns the standard errors (S, 3) that are known, by the names of their parameters."""
    errors = {}
    for variable, row in zip(states, motor_sigma.tolist(), strict=True):
        name = variable.name
        keys = (f"{name}.fall", f"{name}.rise", f"{variable.follows}.dead")
        for key, error in zip(keys, row, strict=True):
            if error > 0.0:
                errors[key] = error
    return errors


def list_late_inputs(
    spec: RobotSpec, timing: clocks.TimingEstimate
) -> tuple[InputCurve, ...]:
    """Returns the input curves of commands that have a dead zone, or act later than others."""
    dead = timing.motors.dead if timing.motors else np.zeros(len(timing.delays))
    rows = zip(spec.state, timing.delays.tolist(), dead.tolist(), strict=False)
    curves = {}
    for variable, delay, zone in rows:
        if delay > 0.0 or zone > 0.0:
            name = str(variable.follows)
            curves[name] = InputCurve(command=name, dead=zone, delay=delay)
    return tuple(curves.values())


def list_limits(
    spec: RobotSpec, timing: clocks.TimingEstimate
) -> dict[str, tuple[float, float]]:
    """Returns the maximum fall and rise of limited states, at a gain of one."""
    if timing.motors is None:
        return {}
    fall, rise, _ = timing.motors
    return {
        spec.state[i].name: (float(fall[i]), float(rise[i]))
        for i in np.flatnonzero(timing.motors.limited)
    }


def scale_limits(calibration: Calibration, spec: RobotSpec) -> Array:
    """Returns the maximum fall and rise (S, 2) of the states, at the gains of their responses."""
    limits = np.tile([-np.inf, np.inf], (len(spec.state), 1))
    for i, variable in enumerate(spec.state):
        limits[i] = calibration.limits.get(variable.name, limits[i])
    gains = [response.gain for response in calibration.responses] or [1.0]
    return np.asarray(limits * np.array(gains)[:, None])


def remove_limits(
    samples: Samples, calibration: Calibration, spec: RobotSpec
) -> Samples:
    """Returns samples with the rates that limited states would have without limits."""
    rates = samples.dq.copy()
    names = [c.name for c in spec.command]
    for i, response in enumerate(calibration.responses):
        if response.state in calibration.limits:
            command = len(spec.state) + names.index(response.command)
            target = response.gain * samples.x[:, command]
            share = -np.expm1(-samples.dt / max(response.lag_s, clocks.MIN_TIME_S))
            rates[:, 3 + i] = share * (target - samples.x[:, i]) / samples.dt
    return replace(samples, dq=rates)


def _find_following(
    drive: Drive, timing: clocks.TimingEstimate, moved: NDArray[np.intp]
) -> _Adjusted:
    """Finds how moved states follow; with limits and dead zones only if they clearly help."""
    twists = drive.twists
    command = drive.recording.command
    spec = drive.spec
    rows = clocks.select_some_rows(len(twists.start), clocks.FEW_ROWS)
    moving = list(list_moving_dofs(twists.twist))
    begin = twists.start[rows]
    shift = timing.latency - timing.offset
    size = len(timing.lags)
    start = _Following(
        timing.lags, np.full(size, shift), signals.make_free_motors(size)
    )
    for _ in range(2):  # twice, because unexplained commands hide the effects of motors
        target = (begin, twists.end[rows], twists.twist[rows][:, moving])
        left = clocks.make_response_residual(command, spec, target, MAX_ORDER)
        rest = left(*vars(start).values()).reshape(len(rows), -1)
        is_explained = np.mean(rest**2, axis=0) < EXPLAINED
        if is_explained.all() or not is_explained.any():
            break
        moving = np.array(moving)[is_explained].tolist()
    cluster = np.repeat(
        ((begin - begin[0]) / clocks.CLUSTER_S).astype(np.intp), len(moving)
    )
    best = _adjust(left, start, moved, shift, cluster)
    with_limits = partial(_try_limits, shift=shift)
    # the effect of one may hide that of another
    for change in (with_limits, _try_dead_zones, with_limits):
        for i in moved:
            sent = command.values[:, signals.list_followed_commands(spec)[i]]
            least = np.inf
            for trial in change(best.best, i, sent):
                cost = float((left(*vars(trial).values()) ** 2).sum())
                if cost < least:
                    least = cost
                    option = trial
            if least < HELPS * best.cost:
                adjusted = _adjust(left, option, moved, shift, cluster)
                if adjusted.cost < WORTH * best.cost:
                    best = adjusted
    return best


def _try_limits(
    now: _Following, i: int, sent: Array, shift: float
) -> Iterator[_Following]:
    """Yields trials in which state i has limits, with a smaller lag and delay."""
    trial_delays = {*(shift + delay for delay in DELAYS_S), *now.delays}
    for rate, lag, delay in product(RATES, LAGS_S, trial_delays):
        size = rate * float(np.ptp(sent))
        fall = _replace_value(now.motors.fall, i, -size)
        rise = _replace_value(now.motors.rise, i, size)
        motors = now.motors._replace(fall=fall, rise=rise)
        yield _Following(
            _replace_value(now.lags, i, lag),
            _replace_value(now.delays, i, delay),
            motors,
        )


def _try_dead_zones(now: _Following, i: int, sent: Array) -> Iterator[_Following]:
    """Yields trials in which the command of state i has a dead zone."""
    for share in DEAD:
        dead = _replace_value(now.motors.dead, i, share * float(np.abs(sent).max()))
        yield replace(now, motors=now.motors._replace(dead=dead))


def _replace_value(values: Array, i: int, value: float) -> Array:
    return np.where(np.arange(len(values)) == i, value, values)


def _adjust(
    left: clocks.Left,
    start: _Following,
    moved: NDArray[np.intp],
    shift: float,
    cluster: NDArray[np.intp],
) -> _Adjusted:
    """Adjusts delays and lags of moved states, and any limits and dead zones."""
    count = len(moved)
    first = np.stack(start.motors, axis=1)  # (S, 3)
    effects = np.nonzero(np.isfinite(first) & (first != 0.0))
    size = np.abs(first[effects])

    def at(theta: Array) -> _Following:
        lags = start.lags.copy()
        delays = start.delays.copy()
        motors = first.copy()
        delays[moved] = theta[:count]
        lags[moved] = np.exp(theta[count : 2 * count])
        motors[effects] = first[effects] * np.exp(theta[2 * count :])
        return _Following(lags, delays, Motors(*motors.T))

    def residual(theta: Array) -> Array:
        return left(*vars(at(theta)).values())

    reach = np.full(len(size), np.log(WIDER))
    low, high = (
        np.repeat([shift + delay, log_lag], count) for delay, log_lag in clocks.BOUNDS
    )
    begun = np.clip(
        np.append(start.delays[moved], np.log(start.lags[moved])), low, high
    )
    theta, jacobian, rest = minimise(
        residual,
        np.append(begun, 0.0 * reach),
        np.full(len(begun) + len(reach), 0.1),
        (np.append(low, -reach), np.append(high, reach)),
    )
    best = at(theta)
    values = np.stack(best.motors, axis=1)
    by_lag = jacobian[:, count : 2 * count] / best.lags[moved]
    by_size = jacobian[:, 2 * count :] / np.abs(values[effects])
    by_sum = np.concatenate([jacobian[:, :count] - by_lag, by_lag, by_size], axis=1)
    sigma = np.maximum(estimate_clustered_errors(by_sum, rest, cluster), clocks.EXACT)
    effect = np.linalg.norm(by_size, axis=0) * size
    sure = (effect > NO_EFFECT * np.linalg.norm(rest)) & (sigma[2 * count :] < size)
    motor_sigma = np.zeros(first.shape)
    motor_sigma[effects] = np.where(sure, sigma[2 * count :], 0.0)
    motors = np.where(motor_sigma > 0.0, values, FREE)
    return _Adjusted(
        replace(best, motors=Motors(*motors.T)),
        float((rest**2).sum()),
        sigma[: 2 * count].reshape(2, count),
        motor_sigma,
    )


def _name_sum(state: str) -> str:
    """Returns the name of the uncertainty of a latency and a lag together."""
    return f"command_latency_and_{state}_lag_s"


def describe_sums(calibration: Calibration) -> Iterator[str]:
    """Yields a sentence on latencies and lags that could not be separated."""
    commands = [response.command for response in calibration.responses]
    further = delays(commands, calibration.inputs).tolist()
    for response, delay in zip(calibration.responses, further, strict=True):
        sigma = calibration.uncertainty.get(_name_sum(response.state))
        if sigma is not None:
            both = calibration.command_latency_s + delay + response.lag_s
            finding = f"Latency and the lag of {response.state} can hardly be separated"
            yield f"{finding}: trust their sum, {both:.4f} s (+- {sigma:.4f} s)."
