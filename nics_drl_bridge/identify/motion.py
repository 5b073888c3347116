"""Motion as state: the body twist, taken from the pose, of robots whose state is a part of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import shooting
from nics_drl_bridge.identify.calibration import Calibration, outside_gaps
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.fit import Fit, Library, Order, pruned, regress
from nics_drl_bridge.identify.signals import held, inferred_states, resample, unwrapped
from nics_drl_bridge.identify.statistics import clustered_errors
from nics_drl_bridge.identify.yardstick import structure_of
from nics_drl_bridge.recording.recording import (
    Recording,
    Samples,
    Stream,
    samples_on_one_clock,
)  # fmt: skip
from nics_drl_bridge.robot.curve import InputCurve, curved
from nics_drl_bridge.robot.kinds import steady_twist
from nics_drl_bridge.robot.spec import POSE_RATES, CommandVariable, RobotSpec, StateVariable
from nics_drl_bridge.robot.taylor import TaylorModel

Mask = NDArray[np.bool_]
Powers = NDArray[np.int64]

WIDTHS_S = (0.07, 0.1, 0.15, 0.2)  # half-widths of the parabolas that give the twist
NOISE = 0.02  # share of the usual speed, and turn rate, that the noise of a twist may reach
SAMPLES = 2.5  # half a width holds at least this many samples
FINE_S, COARSE_S, COARSE_FROM_S = 0.01, 0.02, 0.015  # steps of models, by that of the poses
ORDERS = (1, 2, 3)  # of which `auto` chooses
WORTH = 0.95  # a higher order is worth its terms if it takes the error to this share
FOLDS = 3
TOLD_S = 0.005  # by which two estimates of a latency may differ
DELAY_ORDER, DELAY_STEP_S, LONGEST_S = 2, 0.02, 0.4  # of the search for a delay
DELAY_SCALE_S, CURVE_SCALE = 0.05, 0.1  # steps of their refinement
STRONG = 95.0  # percentile of the rates at which limits are first sought
LEVER_SCALE_M, TURN_SCALE = 0.05, 0.1
CV_SPACING_S, CV_EVALUATIONS = 0.5, 25
BASE_ORDER, BASE_EVALUATIONS, BASE_SPACING_S = 2, 40, 0.5
SKETCH = ((0, 0.0), (3, 0.01))  # hypotheses by which actuators are judged
PULLS = (0.1, 0.01, 0.001)  # of which each order chooses
HORIZON_S = 5.0


def by_motion(spec: RobotSpec, recording: Recording) -> bool:
    """True if a state that is a part of the body twist was not measured, or wheels are inputs."""
    if recording.state is not None:
        return False
    return any(v.twist for v in spec.state) or not (spec.state or spec.takes_cmd_vel)


def half_width(drive: Drive) -> float:
    """Returns the half-width [s] over which poses are smoothed: the shortest that quiets them."""
    t, pose = drive.dated.t, unwrapped(drive.dated.values)
    span = float(t[-1] - t[0])
    every = span / max(len(t) - 1, 1)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum() / span
    turn = np.abs(np.diff(pose[:, 2])).sum() / span
    position, heading = drive.pose_noise or (0.0, 0.0)
    for width in WIDTHS_S:
        gain = np.sqrt(12.0 * every / (2.0 * width)) / (2.0 * width)
        if gain * position <= NOISE * speed and gain * heading <= NOISE * max(turn, speed):
            break
    return float(max(width, SAMPLES * every))


def with_motion(drive: Drive, calibration: Calibration, grid: Array, width: float) -> Drive:
    """Returns a drive with the state at uniform times (T,) on the commands' clock.

    Components of the twist of `base_link` are slopes of parabolas over twice the half-width [s];
    states that follow a command do so with the calibration's lags.
    """
    recording, spec, step = drive.recording, drive.spec, float(grid[1] - grid[0])
    t = drive.sample_t + calibration.clock_offset_s
    tracked = resample(t, unwrapped(recording.pose.values), grid, 0.5 * width)
    pose = unwrapped(calibration.to_base(tracked))
    rows = 2 * max(2, round(width / step)) + 1
    rates = savgol_filter(pose, rows, 2, deriv=1, delta=step, axis=0)
    twist = np.concatenate([geometry.rotate(rates[:, :2], -pose[:, 2]), rates[:, 2:]], axis=1)
    columns = [
        twist[:, POSE_RATES.index(v.twist)] if v.twist else _following(v, drive, calibration, grid)
        for v in spec.state
    ]
    values = np.array(columns).reshape(len(columns), len(grid)).T
    state = Stream(grid, values, recording.command.clock)
    return drive.part(replace(recording, state=state))


def _following(
    variable: StateVariable, drive: Drive, calibration: Calibration, grid: Array
) -> Array:
    alone = drive.spec.model_copy(update={"state": (variable,)})
    lag = [r.lag_s for r in calibration.responses if r.state == variable.name]
    latency, command = calibration.command_latency_s, drive.recording.command
    return inferred_states(command, alone, np.array(lag), latency, grid)[:, 0]


def mirrored(spec: RobotSpec) -> tuple[str, ...] | None:
    """Names the variables that change sign in a mirror; None if the textbook does not tell."""
    rng = np.random.default_rng(0)
    some = rng.uniform(0.1, 0.9, (8, len(spec.command))) * np.maximum(
        spec.command_high, -spec.command_low
    )
    try:
        twist = steady_twist(spec, some) * np.array([1.0, -1.0, -1.0])
        for signs in product((1.0, -1.0), repeat=len(spec.command)):
            if np.allclose(steady_twist(spec, some * signs), twist):
                break
        else:
            return None
    except ConfigError:
        return None
    odd = [c.name for c, sign in zip(spec.command, signs, strict=True) if sign < 0.0]
    aside = [v.name for v in spec.state if v.twist in ("vy", "wz") or v.follows in odd]
    return (*aside, *odd)


def library(powers: Powers, spec: RobotSpec) -> Mask:
    """Selects the terms (D, K) that each degree of freedom may have.

    A state that is a component of the twist is so by definition. Slip along y acts in proportion.
    Beyond the first order, what a mirror reverses is made of what it reverses.
    """
    names, odd = spec.variable_names, mirrored(spec)
    order = powers.sum(axis=1)
    slip = [names.index(v.name) for v in spec.state if v.twist == "vy"]
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    allowed[:, (powers[:, slip].sum(axis=1) > 0) & (order > 1)] = False
    if odd is not None:
        reversed_ = powers[:, [n in odd for n in names]].sum(axis=1) % 2 == 1
        for d, name in enumerate(spec.dof_names):
            aside = name in ("vy", "wz") or name.removeprefix("d_") in odd
            allowed[d] &= (reversed_ == aside) | (order <= 1)
    if spec.state:  # commands act through the state
        allowed[:3] &= (powers[:, len(spec.state) :] == 0).all(axis=1)
    if not spec.state or odd is not None:  # who gets no command comes to rest
        allowed &= order > 0
    for i, variable in enumerate(spec.state):
        alone = (order == 1) & (powers[:, i] == 1)
        if variable.twist:
            allowed[POSE_RATES.index(variable.twist)] = alone
        else:
            follows = names.index(str(variable.follows))
            allowed[3 + i] = alone | ((order == 1) & (powers[:, follows] == 1))
    return np.asarray(allowed)


def samples_of(drive: Drive, calibration: Calibration, width: float) -> Samples:
    """Puts a drive `with_motion` on the time axis of its state, poses smoothed like it."""
    state, spec = known_state(drive), drive.spec
    grid = state.t
    step = round(float(grid[-1] - grid[0]) / (len(grid) - 1), 9)
    t = drive.sample_t + calibration.clock_offset_s
    tracked = resample(t, unwrapped(drive.recording.pose.values), grid, 0.5 * width)
    begin, stream = grid - calibration.command_latency_s, drive.recording.command
    bent = replace(stream, values=curved(stream.values, spec, calibration.inputs))
    command = held(bent, spec, begin, begin + step)
    samples = samples_on_one_clock(grid, calibration.to_base(tracked), state.values, command)
    return replace(samples.rows(outside_gaps(samples.t, t, step)), dt=step)


def known_state(drive: Drive) -> Stream:
    """Returns the state of a drive `with_motion`."""
    if drive.recording.state is None:
        raise RecordingError(f"{drive.recording.source}: its motion was not derived yet.")
    return drive.recording.state


def grid_of(drive: Drive, calibration: Calibration, period: float) -> Array:
    """Returns uniform times (T,) of poses on the commands' clock; the step divides a period [s]."""
    pose = drive.recording.pose.t + calibration.clock_offset_s
    usual = float(np.median(np.diff(drive.dated.t)))
    step = period / max(1, round(period / (FINE_S if usual < COARSE_FROM_S else COARSE_S)))
    first = max(pose[0], drive.recording.command.t[0])
    return np.asarray(first + step * np.arange(int((pose[-1] - first) / step + 1e-6) + 1))


def surrogate(spec: RobotSpec) -> RobotSpec:
    """Returns a robot whose state follows its commands, one by one: for delays and lags."""

    def follows(command: CommandVariable) -> StateVariable:
        given = command.model_dump(include={"unit", "min", "max"})
        return StateVariable(name=f"{command.name}_state", follows=command.name, **given)

    return spec.model_copy(update={"state": tuple(map(follows, spec.command))})


@dataclass(frozen=True)
class Actuators:
    """Findings on motors besides their gains and lags: input curves, friction, limits."""

    curves: tuple[InputCurve, ...] = ()
    friction: tuple[str, ...] = ()  # states with dry friction
    limits: tuple[str, ...] = ()  # states with a greatest fall and rise


def problem_of(drive: Drive, samples: Samples, actuators: Actuators) -> shooting.Shooting:
    """Returns the prediction problem of a drive on one time axis; its inputs: `inputs_of`."""
    command, spec, t, dt = drive.recording.command, drive.spec, samples.t, samples.dt

    def commands(values: Array) -> Array:
        begin, curves = t - float(values[0]), curves_at(actuators, values)
        bent = replace(command, values=curved(command.values, spec, curves))
        return held(bent, spec, begin, begin + dt)

    def shaped(model: TaylorModel, values: Array) -> TaylorModel:
        return with_actuators(model, spec, actuators, values)

    noise, _ = drive.pose_noise or (0.0, 0.0)
    return shooting.Shooting(samples, commands, shaped, not spec.state, noise)


def curves_at(actuators: Actuators, values: Array) -> tuple[InputCurve, ...]:
    """Returns the input curves for values (I,)."""
    rows = values[1 : 1 + 3 * len(actuators.curves)].reshape(-1, 3).tolist()
    return tuple(
        InputCurve(
            command=c.command, dead=max(dead, 0.0), least=min(least, 0.0), most=max(most, 0.0)
        )
        for c, (dead, least, most) in zip(actuators.curves, rows, strict=True)
    )


def with_actuators(
    model: TaylorModel, spec: RobotSpec, actuators: Actuators, values: Array
) -> TaylorModel:
    """Returns a model with friction and limits for values (I,)."""
    names, place = [v.name for v in spec.state], 1 + 3 * len(actuators.curves)
    friction, limits = np.zeros(len(names)), np.tile([-np.inf, np.inf], (len(names), 1))
    for name in actuators.friction:
        friction[names.index(name)] = max(values[place], 0.0)
        place += 1
    for name in actuators.limits:
        limits[names.index(name)] = -abs(values[place]), abs(values[place + 1])
        place += 2
    return replace(model, friction=friction, limits=limits)


def inputs_of(
    drive: Drive, latency: float, samples: Samples, actuators: Actuators
) -> shooting.Inputs:
    """Returns the values that are sought besides coefficients: latency, and those of actuators."""
    one_clock = drive.recording.pose.clock == drive.recording.command.clock
    least = min(latency, 0.0) if one_clock else latency - LONGEST_S
    rows = [(latency, DELAY_SCALE_S, least, latency + LONGEST_S)]  # start, scale, low, high
    for curve in actuators.curves:
        size = max(abs(curve.least), abs(curve.most))
        step = CURVE_SCALE * size
        rows += [
            (curve.dead, step, 0.0, 0.5 * size if curve.dead else 0.0),
            (curve.least, step, 1.5 * curve.least, 0.5 * curve.least),
            (curve.most, step, 0.5 * curve.most, 1.5 * curve.most),
        ]
    names = [v.name for v in drive.spec.state]
    rates = {name: samples.dq[:, 3 + i] for i, name in enumerate(names)}
    for name in actuators.friction:
        size = float(np.percentile(np.abs(rates[name]), STRONG))
        rows.append((0.1 * size, 0.1 * size, 0.0, size))
    for name in actuators.limits:
        for rate in (-rates[name], rates[name]):
            size = max(float(np.percentile(rate, STRONG)), 1e-3)
            rows.append((size, 0.3 * size, 0.1 * size, 10.0 * size))
    if not drive.spec.state:  # what is left of the mounting
        reach = 2.0 * drive.spec.footprint_radius
        aside = reach if sided(drive.spec) else 0.0
        rows += [(0.0, LEVER_SCALE_M, -reach, reach), (0.0, LEVER_SCALE_M, -aside, aside),
                 (0.0, TURN_SCALE, -np.pi, np.pi)]  # fmt: skip
    return shooting.Inputs(*np.array(rows).T)


def sided(spec: RobotSpec) -> bool:
    """True if a lever arm along y can be told from unequal wheels: not if one turns the robot."""
    return spec.moves_sideways or mirrored(spec) is not None


@dataclass(frozen=True)
class Trial:
    """A trial of one order, on parts of the training part that its fits did not see."""

    order: int  # 0: of the textbook's terms alone
    pull: float  # to the textbook's terms
    error: float  # mean error after `HORIZON_S`, as a share of the path
    errors: dict[float, Array]  # (W,) distances at the ends of predictions, by horizon [m]


def likely_delay(drive: Drive, calibration: Calibration, samples: Samples) -> float:
    """Returns the delay [s] of the commands by which they best explain the rates of the state."""
    actuators, now = Actuators(calibration.inputs), calibration.command_latency_s
    problem = problem_of(drive, samples, actuators)
    inputs = inputs_of(drive, now, samples, actuators)
    one_clock = drive.recording.pose.clock == drive.recording.command.clock
    tries = np.arange(0.0, LONGEST_S, DELAY_STEP_S) - (0.0 if one_clock else LONGEST_S / 2.0)
    states, left = len(drive.spec.state), []
    free = [3 + i for i, v in enumerate(drive.spec.state) if v.twist] or [0, 2]
    for delay in tries:
        command = problem.commands(np.append(delay, inputs.start[1:]))
        x = np.concatenate([samples.x[:, :states], command], axis=1)
        found = linear_fit(replace(samples, x=x), drive.spec, DELAY_ORDER)
        left.append(float((1.0 - found.r2[free]).sum()))
    return float(tries[int(np.argmin(left))]) if np.isfinite(left).all() else now


@dataclass(frozen=True)
class Base:
    """The textbook's terms with the actuators that predict best: what models depart from."""

    actuators: Actuators
    problem: shooting.Shooting
    inputs: shooting.Inputs  # started from the values found
    found: shooting.Predictive


def base_of(
    drive: Drive, calibration: Calibration, samples: Samples, clear: tuple[InputCurve, ...] = (),
    known: Base | None = None,
) -> Base:  # fmt: skip
    """Fits the textbook with and without input curves, friction and limits; keeps what predicts.

    Clear curves are not doubted. A known base is fitted anew, to other data.
    """

    def fitted(actuators: Actuators) -> Base:
        problem = problem_of(drive, samples, actuators)
        inputs = inputs_of(drive, calibration.command_latency_s, samples, actuators)
        found = fit_base(replace(problem, spacing_s=BASE_SPACING_S), drive.spec, inputs)
        return Base(actuators, problem, replace(inputs, start=found.values), found)

    def attempt(actuators: Actuators) -> tuple[float, Base]:
        base = fitted(actuators)
        trials = tried(base.problem, drive.spec, SKETCH, base.found.values)
        return min(trial.error for trial in trials), base

    if known is not None:
        return fitted(replace(known.actuators, curves=calibration.inputs))
    error, best = attempt(Actuators(calibration.inputs))
    speeds = tuple(v.name for v in drive.spec.state if v.twist == "vx")
    doubted = len(calibration.inputs) > len(clear)
    plain = [lambda now: replace(now, curves=clear)] if doubted else []
    more = [lambda now: replace(now, friction=speeds), lambda now: replace(now, limits=speeds)]
    for change in (*plain, *(more if speeds else ())):
        other, base = attempt(change(best.actuators))
        if other < (1.0 if change in plain else WORTH) * error:
            error, best = other, base
    return best


def linear_fit(samples: Samples, spec: RobotSpec, order: int, allowed: Library = library) -> Fit:
    """Fits all terms of the library of an order to the rates (Eq. 1)."""
    return pruned(regress(samples, spec, order, allowed=allowed), spec, 1.0)


def by_textbook(powers: Powers, spec: RobotSpec) -> Mask:
    """Selects the terms (D, K) by which the twist follows commands with a lag, as textbooks do."""
    names, states, order = spec.variable_names, len(spec.state), powers.sum(axis=1)
    allowed, given = library(powers, spec) & (order <= 1), structure_of(spec)
    if given is None or not states:
        return np.asarray(allowed)
    moves, bicycle = given
    first = np.eye(len(names), dtype=np.int64)
    speed = [i for i, v in enumerate(spec.state) if v.twist == "vx"]

    def has(d: int, *rows: NDArray[np.int64]) -> None:
        for row in rows:
            allowed[d] |= (powers == row).all(axis=1)

    for i, variable in enumerate(spec.state):
        if variable.twist is None:
            continue
        part = POSE_RATES.index(variable.twist)
        allowed[3 + i] = False
        has(3 + i, first[i])  # without a constant: who gets no command comes to rest
        commands = first[states:][np.abs(moves[part]) > 0.0]
        if bicycle.used and variable.twist == "wz" and speed:
            has(3 + i, first[speed[0]], *(commands + first[speed[0]]))
        elif len(commands):
            has(3 + i, *commands)
    return np.asarray(allowed)


def fit_base(
    problem: shooting.Shooting, spec: RobotSpec, inputs: shooting.Inputs,
    inside: Mask | None = None,
) -> shooting.Predictive:  # fmt: skip
    """Fits the textbook's terms, gains and lags, to predictions over seconds."""
    samples = problem.samples if inside is None else problem.samples.rows(inside)
    model = by_definition(linear_fit(samples, spec, BASE_ORDER, by_textbook).model, spec)
    free = (model.coefficients != 0.0) & ~defined(spec)[:, None]
    return shooting.fitted(problem, model, free, inputs, inside, BASE_EVALUATIONS)


def refined(
    problem: shooting.Shooting, base: TaylorModel, linear: TaylorModel, spec: RobotSpec,
    inputs: shooting.Inputs, inside: Mask | None = None, evaluations: int = shooting.EVALUATIONS,
    pull: float = shooting.PULL,
) -> shooting.Predictive:  # fmt: skip
    """Adjusts the terms of a linear fit, and those of a base to which they are pulled."""
    base, first = together(base, by_definition(linear, spec))
    free = ((base.coefficients != 0.0) | (first != 0.0)) & ~defined(spec)[:, None]
    return shooting.fitted(problem, base, free, inputs, inside, evaluations, pull, first)


def together(base: TaylorModel, other: TaylorModel) -> tuple[TaylorModel, Array]:
    """Returns a model over the terms of both, and the other's coefficients (D, K) for them."""
    rows = {tuple(row): k for k, row in enumerate(other.powers.tolist())}
    more = [row for row in base.powers.tolist() if tuple(row) not in rows]
    rows |= {tuple(row): len(rows) + k for k, row in enumerate(more)}
    powers = np.array(list(rows), dtype=np.int64)
    coefficients, first = np.zeros((2, len(base.dofs), len(powers)))
    coefficients[:, [rows[tuple(row)] for row in base.powers.tolist()]] = base.coefficients
    first[:, : len(other.powers)] = other.coefficients
    none = np.zeros((0, 0))
    return replace(base, powers=powers, coefficients=coefficients, std_errors=none), first


def defined(spec: RobotSpec) -> Mask:
    """Selects the degrees of freedom (D,) that are not fitted: those of which the state tells."""
    by_state = np.zeros(len(spec.dof_names), dtype=np.bool_)
    for i, variable in enumerate(spec.state):
        by_state[POSE_RATES.index(variable.twist) if variable.twist else 3 + i] = True
    return by_state


def by_definition(model: TaylorModel, spec: RobotSpec) -> TaylorModel:
    """Sets the rows of the twist that are states."""
    coefficients, order = model.coefficients.copy(), model.powers.sum(axis=1)
    if not spec.moves_sideways:  # what is left of lateral motion is noise, unless it is a state
        coefficients[1] = 0.0
    for i, variable in enumerate(spec.state):
        if variable.twist:
            d = POSE_RATES.index(variable.twist)
            coefficients[d] = ((order == 1) & (model.powers[:, i] == 1)).astype(np.float64)
    return replace(model, coefficients=coefficients, bounded=True)


Hypothesis = tuple[int, float]  # order, 0 for the textbook's terms alone, and pull to these


def hypotheses(spec: RobotSpec, order: Order) -> tuple[Hypothesis, ...]:
    """Returns those that are tried for an order, from the least free to the freest."""
    orders = ORDERS if order == "auto" else (order,)
    return ((0, 0.0), *((o, pull) for o in orders for pull in PULLS))


def tried(
    problem: shooting.Shooting, spec: RobotSpec, asked: tuple[Hypothesis, ...], values: Array
) -> tuple[Trial, ...]:
    """Fits each hypothesis to all but one of `FOLDS` parts of a drive, and predicts that part."""
    sparse = replace(problem, spacing_s=CV_SPACING_S, fixed=values)
    everything = np.arange(len(problem.samples.t))
    errors: dict[Hypothesis, list[Array]] = {hypothesis: [] for hypothesis in asked}
    paths, judge = [], replace(sparse, horizons=BANDS_S)
    for block in np.array_split(everything, FOLDS):
        left = np.isin(everything, block)
        base = fit_base(sparse, spec, shooting.NOTHING_FREE, ~left)
        linear: dict[int, TaylorModel] = {}
        for order, pull in asked:
            model = base.model
            if order:
                if order not in linear:
                    linear[order] = linear_fit(problem.samples.rows(~left), spec, order).model
                model = refined(
                    sparse, base.model, linear[order], spec, shooting.NOTHING_FREE, ~left,
                    CV_EVALUATIONS, pull,
                ).model  # fmt: skip
            error, path = judge.errors(model, values, left)
            errors[order, pull].append(np.hypot(error[..., 0], error[..., 1]))
        paths.append(path)
    length = max(float(np.nanmean(np.concatenate(paths)[:, -1])), 1e-9)
    return tuple(
        Trial(order, pull, float(np.nanmean(far[:, -1])) / length,
              {h: each[~np.isnan(each)] for h, each in zip(BANDS_S, far.T, strict=True)})
        for (order, pull), blocks in errors.items() for far in [np.concatenate(blocks)]
    )  # fmt: skip


BANDS_S = (0.5, 1.0, 2.0, HORIZON_S)


def chosen(trials: Sequence[Trial]) -> Trial:
    """Returns the first trial that none clearly improves on."""
    best = trials[0]
    for trial in trials[1:]:
        if trial.error < WORTH * best.error:
            best = trial
    return best


def lags_of(model: TaylorModel, spec: RobotSpec) -> dict[str, float]:
    """Returns the lags [s] by which a base's states follow, by name."""
    alone, found = model.powers.sum(axis=1) == 1, {}
    for i, variable in enumerate(spec.state):
        rate = float(model.coefficients[3 + i, alone & (model.powers[:, i] == 1)].sum())
        if variable.twist and rate < 0.0:
            found[variable.name] = -1.0 / rate
    return found


def apart(calibration: Calibration, other: float, lags: dict[str, float]) -> tuple[str, ...]:
    """Says of a latency that predictions and regression [s] tell differently: trust its sums."""
    latency = calibration.command_latency_s
    if abs(latency - other) <= TOLD_S or not lags:
        return ()
    sums = ", ".join(f"{latency + lag:.3f} s for {name}" for name, lag in lags.items())
    ways = f"{latency:.3f} s by predictions, {other:.3f} s by regression"
    return (f"Latency can't be told from the lags ({ways}): trust their sums, {sums}.",)


def standard_errors(found: shooting.Predictive) -> Array:
    """Returns standard errors (D, K) of the free coefficients; NaN for the others."""
    span = max(shooting.HORIZONS_S)
    cluster = np.floor((found.starts - found.starts.min()) / span).astype(np.intp)
    errors = np.full(found.free.shape, np.nan)
    errors[found.free] = clustered_errors(found.jacobian, found.residual, cluster)
    return errors


def remounted(calibration: Calibration, found: shooting.Predictive) -> Calibration:
    """Adds the mounting that predictions show to what the calibration has."""
    mounting = geometry.compose(calibration.mounting, found.values[-3:])
    x, y, heading = map(float, mounting)
    names = ("lever_arm_x_m", "lever_arm_y_m", "rotation_rad")
    sigma = dict(zip(names, map(float, found.value_errors[-3:]), strict=True))
    return replace(
        calibration, rotation_rad=-heading, lever_arm_m=(x, y),
        uncertainty={**calibration.uncertainty, **sigma},
    )  # fmt: skip
