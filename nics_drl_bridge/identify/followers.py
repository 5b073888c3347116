"""Followers: delay, lag, dead zone and limits of each unmeasured state that follows a command."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import clocks, signals
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.excitation import moving_dofs
from nics_drl_bridge.identify.signals import Motors
from nics_drl_bridge.identify.statistics import clustered_errors, minimise
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.curve import InputCurve, delays
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.spec import RobotSpec

# fall, rise and dead zone of a motor without limits
FREE = (
    -np.inf,
    np.inf,
    0.0,
)
# lags tried together with limits
LAGS_S = (0.05, 0.15, 0.4)
DELAYS_S = (0.0, 0.05, 0.1, 0.2)
# trial limits, in the command's range per second
RATES = (
    0.25,
    0.5,
    1.0,
    2.0,
    4.0,
)
# trial dead zones, as fractions of the command's maximum
DEAD = (
    0.03,
    0.07,
    0.15,
    0.3,
)
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


def apart(drive: Drive, timing: clocks.TimingEstimate) -> clocks.TimingEstimate:
    """Refines a timing by a separate delay and lag for each command, and the effects of motors.

    Dynamics beyond a single lag, such as those of a higher-order servo, add to a command's delay.
    The latency is the minimum of these delays.
    """
    if drive.recording.state is not None or not drive.spec.state or not timing.sigma:
        return timing
    moved = np.flatnonzero(signals.moved_inputs(drive.recording.command, drive.spec))
    found = _found(drive, timing, moved)
    delay = found.best.delays[moved]
    sigma = found.sigma
    if not np.isfinite(sigma).all():
        return timing
    first = int(np.argmin(delay + clocks.CERTAIN * sigma[0]))
    alike = np.abs(delay - delay[first]) <= clocks.CERTAIN * np.hypot(
        sigma[0], sigma[0, first]
    )
    # True if the wheels determined the latency
    told = len(timing.sigma) > 1
    motors = found.best.motors
    held = motors.limited
    if told and alike.all() and not (held.any() or motors.dead.any()):
        return timing
    least = float(np.average(delay[alike], weights=sigma[0, alike] ** -2.0))
    sigma = np.hypot(sigma, clocks.WITHIN_TICK * clocks.STEP_S)
    own = np.hypot(sigma[0], END * np.where(held[moved], delay - least, 0.0))
    unsure = (
        END * (least if timing.separated and not told else max(DELAYS_S)) * held.any()
    )
    errors = {
        n: float(np.hypot(sigma[0, first] if len(timing.sigma) == 1 else e, unsure))
        for n, e in timing.sigma.items()
    }
    if timing.separated and not told:
        least = clocks.if_certain(
            max(least, 0.0), float(sigma[0, first]), clocks.MIN_TIME_S
        )
    if timing.separated and errors["command_latency_s"] > clocks.TOLD_S:
        names = (_of_sum(drive.spec.state[i].name) for i in moved)
        errors |= zip(names, map(float, sigma[1]), strict=True)
    lags = timing.lags.copy()
    lag_sigma = timing.lag_sigma.copy()
    further = 0.0 * timing.lags
    further[moved] = np.where(alike, 0.0, np.maximum(delay - least, 0.0))
    sums = delay + found.best.lags[moved]
    lags[moved], lag_sigma[moved] = (
        np.maximum(sums - least - further[moved], 0.0),
        np.hypot(*sigma),
    )
    for i, error in zip(moved, own.tolist(), strict=True):
        if further[i] > 0.0:
            errors[f"{drive.spec.state[i].follows}.delay"] = error
    for v, row in zip(drive.spec.state, found.motor_sigma.tolist(), strict=True):
        keys = f"{v.name}.fall", f"{v.name}.rise", f"{v.follows}.dead"
        errors |= {key: own for key, own in zip(keys, row, strict=True) if own > 0.0}
    if told:
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


def late_inputs(
    spec: RobotSpec, timing: clocks.TimingEstimate
) -> tuple[InputCurve, ...]:
    """Returns the input curves of commands that have a dead zone, or act later than others."""
    dead = timing.motors.dead if timing.motors else np.zeros(len(timing.delays))
    rows = zip(spec.state, timing.delays.tolist(), dead.tolist(), strict=False)
    each = {v.follows: (d, zone) for v, d, zone in rows if d > 0.0 or zone > 0.0}
    return tuple(
        InputCurve(command=str(n), dead=zone, delay=d) for n, (d, zone) in each.items()
    )


def limits_of(
    spec: RobotSpec, timing: clocks.TimingEstimate
) -> dict[str, tuple[float, float]]:
    """Returns the maximum fall and rise of limited states, at a gain of one."""
    if timing.motors is None:
        return {}
    rows = zip(
        spec.state,
        timing.motors.fall.tolist(),
        timing.motors.rise.tolist(),
        strict=True,
    )
    return {
        v.name: (fall, rise)
        for v, fall, rise in rows
        if np.isfinite([fall, rise]).any()
    }


def scaled_limits(calibration: Calibration, spec: RobotSpec) -> Array:
    """Returns the maximum fall and rise (S, 2) of the states, at the gains of their responses."""
    limits = np.tile([-np.inf, np.inf], (len(spec.state), 1))
    gains = calibration.responses
    for i, v in enumerate(spec.state):
        limits[i] = calibration.limits.get(v.name, limits[i])
    return np.asarray(limits * np.array([r.gain for r in gains] or [1.0])[:, None])


def unlimited(samples: Samples, calibration: Calibration, spec: RobotSpec) -> Samples:
    """Returns samples with the rates that limited states would have without limits."""
    rates = samples.dq.copy()
    names = [c.name for c in spec.command]
    for i, response in enumerate(calibration.responses):
        if response.state in calibration.limits:
            target = (
                response.gain
                * samples.x[:, len(spec.state) + names.index(response.command)]
            )
            share = -np.expm1(-samples.dt / max(response.lag_s, clocks.MIN_TIME_S))
            rates[:, 3 + i] = share * (target - samples.x[:, i]) / samples.dt
    return replace(samples, dq=rates)


def _found(
    drive: Drive, timing: clocks.TimingEstimate, moved: NDArray[np.intp]
) -> _Adjusted:
    """Finds how moved states follow; with limits and dead zones only if they clearly help."""
    twists = drive.twists
    command = drive.recording.command
    spec = drive.spec
    rows = clocks.some_of(len(twists.start), clocks.FEW_ROWS)
    moving = list(moving_dofs(twists.twist))
    begin = twists.start[rows]
    shift = timing.latency - timing.offset
    size = len(timing.lags)
    start = _Following(timing.lags, np.full(size, shift), signals.free_motors(size))
    for _ in range(2):  # twice, because unexplained commands hide the effects of motors
        target = (begin, twists.end[rows], twists.twist[rows][:, moving])
        left = clocks.response_residual(command, spec, target, MAX_ORDER)
        unexplained = np.mean(
            left(*vars(start).values()).reshape(len(rows), -1) ** 2, axis=0
        )
        if (unexplained < EXPLAINED).all() or not (unexplained < EXPLAINED).any():
            break
        moving = [
            dof
            for dof, rest in zip(moving, unexplained, strict=True)
            if rest < EXPLAINED
        ]
    cluster = np.repeat(
        ((begin - begin[0]) / clocks.CLUSTER_S).astype(np.intp), len(moving)
    )
    best = _adjusted(left, start, moved, shift, cluster)
    # the effect of one may hide that of another
    for tries in (
        _with_limits,
        _with_dead_zones,
        _with_limits,
    ):
        for i in moved:
            tried = tries(
                best.best, i, command.values[:, signals.followed(spec)[i]], shift
            )
            options = [
                (float((left(*vars(each).values()) ** 2).sum()), each) for each in tried
            ]
            cost, option = min(options, key=lambda each: each[0])
            if cost < HELPS * best.cost:
                other = _adjusted(left, option, moved, shift, cluster)
                best = other if other.cost < WORTH * best.cost else best
    return best


def _with_limits(
    now: _Following, i: int, reach: Array, shift: float
) -> Iterator[_Following]:
    """Yields trials in which state i has limits, with a smaller lag and delay."""
    for rate, lag, delay in product(
        RATES, LAGS_S, {*(shift + d for d in DELAYS_S), *now.delays}
    ):
        size = rate * float(np.ptp(reach))
        fall = _put(now.motors.fall, i, -size)
        rise = _put(now.motors.rise, i, size)
        motors = now.motors._replace(fall=fall, rise=rise)
        yield _Following(_put(now.lags, i, lag), _put(now.delays, i, delay), motors)


def _with_dead_zones(
    now: _Following, i: int, reach: Array, _: float
) -> Iterator[_Following]:
    for share in DEAD:
        dead = _put(now.motors.dead, i, share * float(np.abs(reach).max()))
        yield replace(now, motors=now.motors._replace(dead=dead))


def _put(values: Array, i: int, value: float) -> Array:
    return np.where(np.arange(len(values)) == i, value, values)


def _adjusted(
    left: clocks.Left,
    start: _Following,
    moved: NDArray[np.intp],
    shift: float,
    cluster: NDArray[np.intp],
) -> _Adjusted:
    """Adjusts delays and lags of moved states, and any limits and dead zones."""
    count = len(moved)
    given = np.stack(start.motors, axis=1)  # (S, 3)
    held = np.nonzero(np.isfinite(given) & (given != 0.0))
    size = np.abs(given[held])

    def at(theta: Array) -> _Following:
        lags = start.lags.copy()
        delays = start.delays.copy()
        motors = given.copy()
        delays[moved], lags[moved] = theta[:count], np.exp(theta[count : 2 * count])
        motors[held] = given[held] * np.exp(theta[2 * count :])
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
    found, jacobian, rest = minimise(
        residual,
        np.append(begun, 0.0 * reach),
        np.full(len(begun) + len(reach), 0.1),
        (np.append(low, -reach), np.append(high, reach)),
    )
    best = at(found)
    by_lag = jacobian[:, count : 2 * count] / best.lags[moved]
    by_size = jacobian[:, 2 * count :] / np.abs(np.stack(best.motors, axis=1)[held])
    by_sum = np.concatenate([jacobian[:, :count] - by_lag, by_lag, by_size], axis=1)
    sigma = np.maximum(clustered_errors(by_sum, rest, cluster), clocks.EXACT)
    motor_sigma = np.zeros(given.shape)
    effect = np.linalg.norm(by_size, axis=0) * size
    sure = (effect > NO_EFFECT * np.linalg.norm(rest)) & (sigma[2 * count :] < size)
    motor_sigma[held] = np.where(sure, sigma[2 * count :], 0.0)
    motors = np.where(motor_sigma > 0.0, np.stack(best.motors, axis=1), FREE)
    return _Adjusted(
        replace(best, motors=Motors(*motors.T)),
        float((rest**2).sum()),
        sigma[: 2 * count].reshape(2, count),
        motor_sigma,
    )


def _of_sum(state: str) -> str:
    """Returns the name of the uncertainty of a latency and a lag together."""
    return f"command_latency_and_{state}_lag_s"


def about_sums(calibration: Calibration) -> Iterator[str]:
    """Yields a sentence on latencies and lags that could not be separated."""
    own = delays(
        [r.command for r in calibration.responses], calibration.inputs
    ).tolist()
    for response, delay in zip(calibration.responses, own, strict=True):
        sigma = calibration.uncertainty.get(_of_sum(response.state))
        if sigma is not None:
            both = calibration.command_latency_s + delay + response.lag_s
            finding = f"Latency and the lag of {response.state} can hardly be separated"
            yield f"{finding}: trust their sum, {both:.4f} s (+- {sigma:.4f} s)."
