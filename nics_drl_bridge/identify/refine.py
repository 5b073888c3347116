"""Refinement of a model by its open-loop errors over seconds (the output-error method).

Least squares on rates predicts the next instant; a simulator must predict the next seconds.
Ljung, System Identification, ch. 7; the paper's kept terms stay, their values change.

Free parameters of a refinement; the others are fixed by definition or by measurement.

Removal of refined terms that hardly improve the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.least_squares import minimise, uncertainty
from nics_drl_bridge.identify.statistics import clustered_errors
from nics_drl_bridge.identify.windows import (
    HORIZONS_S,
    Problem,
    prediction_errors,
    prediction_slopes,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Array = NDArray[np.float64]

DIVERGED = 1e3
LEAST_SCALE = 0.05
WITHIN = 12.0**-0.5
"""A model uses the values at the start of a step, so a time is uncertain by the standard deviation
of a uniform distribution over the step."""


@dataclass(frozen=True)
class Refined:
    """A refined model.

    Attributes:
        model: the model.
        calibration: with refined offset (or latency), rotation, lags and gains.
        error: root mean square of the open-loop errors on the training part [m].
        std_errors: (D, K) standard errors of the refined coefficients; NaN for the others.
    """

    model: TaylorModel
    calibration: Calibration
    error: float
    std_errors: Array


@dataclass(frozen=True)
class _Free:
    """Free parameters: coefficients (D, K), a time of the calibration, its rotation."""

    coefficients: NDArray[np.bool_]
    time: str | None
    turn: bool

    @property
    def count(self) -> int:
        """Number of free coefficients."""
        return int(self.coefficients.sum())


def refine(problem: Problem, model: TaylorModel, calibration: Calibration) -> Refined:
    """Adjusts coefficients and calibration to the least open-loop error.

    Args:
        problem: the windows to predict.
        model: the fitted model; its pruned terms stay pruned.
        calibration: of the drive.
    """
    free = _Free(
        free_coefficients(model, calibration, problem.spec),
        free_time(calibration),
        may_turn(calibration, problem.spec),
    )
    theta = _pack(free, model, calibration)
    scale = np.maximum(np.abs(theta), LEAST_SCALE)
    scale[free.count :] = LEAST_SCALE  # s, rad

    def residual(value: Array) -> Array:
        there = _unpack(problem, free, model, calibration, value)
        return _bounded(prediction_errors(problem, *there))

    def jacobian(value: Array) -> Array:
        there = _unpack(problem, free, model, calibration, value)
        return prediction_slopes(problem, *there, free.coefficients, free.turn)

    theta, slope, rest = minimise(
        residual, theta, scale, jacobian=jacobian if problem.courses else None
    )
    sigma = uncertainty(slope, rest)
    refined = _unpack(problem, free, model, calibration, theta, sigma)
    error = float(np.sqrt(np.mean(rest**2)))
    return Refined(*refined, error, _coefficient_errors(problem, free, slope, rest, refined[0]))


def _coefficient_errors(
    problem: Problem, free: _Free, jacobian: Array, rest: Array, model: TaylorModel
) -> Array:
    """Returns standard errors (D, K); windows of one stretch of the drive form a cluster."""
    starts = np.concatenate([np.repeat(w.start_t, 3) for w in problem.chosen])
    cluster = np.floor((starts - starts.min()) / max(HORIZONS_S)).astype(np.intp)
    errors = np.full(model.coefficients.shape, np.nan)
    errors[free.coefficients] = clustered_errors(jacobian, rest, cluster)[: free.count]
    for state in problem.spec.state:
        tied = [linear_term(model, problem.spec, n) for n in (state.name, str(state.follows))]
        d = model.dofs.index(f"d_{state.name}")
        if None in tied or not free.coefficients[d, tied[0]] or free.coefficients[d, tied[1]]:
            continue
        gain = abs(model.coefficients[d, tied[1]] / model.coefficients[d, tied[0]])
        errors[d, tied[1]] = gain * errors[d, tied[0]]
    return errors


def _pack(free: _Free, model: TaylorModel, calibration: Calibration) -> Array:
    tail = [] if free.time is None else [float(getattr(calibration, free.time))]
    tail += [calibration.rotation_rad] if free.turn else []
    return np.append(model.coefficients[free.coefficients], tail)


def _unpack(
    problem: Problem,
    free: _Free,
    model: TaylorModel,
    calibration: Calibration,
    theta: Array,
    sigma: Array | None = None,
) -> tuple[TaylorModel, Calibration]:
    coefficients = model.coefficients.copy()
    coefficients[free.coefficients] = theta[: free.count]
    for i, response in enumerate(calibration.responses):
        own, command = (
            linear_term(model, problem.spec, n) for n in (response.state, response.command)
        )
        if own is not None and command is not None and not free.coefficients[3 + i, command]:
            coefficients[3 + i, command] = -response.gain * coefficients[3 + i, own]
    model = replace(model, coefficients=coefficients)
    names = ([free.time] if free.time else []) + (["rotation_rad"] if free.turn else [])
    values = dict(zip(names, map(float, theta[free.count :]), strict=True))
    if sigma is None:
        return model, replace(calibration, **values)  # type: ignore[arg-type]
    if "rotation_rad" in values:
        values["rotation_rad"] = float(geometry.wrap_angle(values["rotation_rad"]))
    spread = dict(zip(names, map(float, sigma[free.count :]), strict=True))
    if free.time:
        spread[free.time] = float(np.hypot(spread[free.time], WITHIN * model.dt))
    if lag_is_measured(calibration) and "clock_offset_s" in spread:
        spread["clock_offset_s"] = float(
            np.hypot(spread["clock_offset_s"], calibration.uncertainty["command_latency_s"])
        )
    return model, replace(
        calibration,
        **values,  # type: ignore[arg-type]
        uncertainty={**calibration.uncertainty, **spread},
        responses=tuple(_response(model, problem.spec, r) for r in calibration.responses),
    )


def _response(model: TaylorModel, spec: RobotSpec, response: Response) -> Response:
    """Returns the lag and gain that correspond to the coefficients of the state's rate."""
    d = model.dofs.index(f"d_{response.state}")
    own, command = (linear_term(model, spec, n) for n in (response.state, response.command))
    if own is None or command is None or not 0.0 < -model.coefficients[d, own] * model.dt < 1.0:
        return response
    rate = -float(model.coefficients[d, own])
    lag = -model.dt / float(np.log1p(-rate * model.dt))
    return replace(response, lag_s=lag, gain=float(model.coefficients[d, command]) / rate)


def _bounded(error: Array) -> Array:
    finite = np.nan_to_num(error, nan=DIVERGED)
    return np.asarray(np.clip(finite, -DIVERGED, DIVERGED))


def free_coefficients(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> NDArray[np.bool_]:
    """Selects the free coefficients (D, K): kept, and not fixed by the definition of a state.

    An inferred speed is by definition the speed along the direction of travel, so that
    vx = 1 speed; its lag is fixed if the wheels showed it.
    """
    free = model.coefficients != 0.0
    if not calibration.responses:
        free[3:] = False  # the rates of a measured state were fitted to that state itself
    for i, response in enumerate(calibration.responses):
        alone = linear_term(model, spec, response.state)
        if alone is None:
            continue
        if model.coefficients[0, alone] == 1.0:
            free[0, alone] = False
        else:  # the scale of this state is arbitrary, so its gain is fixed
            free[3 + i, linear_term(model, spec, response.command)] = False
        if lag_is_measured(calibration):
            free[3 + i, alone] = False
    return np.asarray(free)


def lag_is_measured(calibration: Calibration) -> bool:
    """True if both offset and latency are known: only the wheels' response separates them."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def linear_term(model: TaylorModel, spec: RobotSpec, name: str) -> int | None:
    """Returns the column of the term that is one variable alone; None without such a term."""
    wanted = np.array([v == name for v in spec.variable_names], dtype=np.int64)
    hits = np.flatnonzero((model.powers == wanted).all(axis=1))
    return int(hits[0]) if len(hits) else None


def may_turn(calibration: Calibration, spec: RobotSpec) -> bool:
    """True if the rotation is free.

    It is defined by the direction in which a robot can't move. An omnidirectional robot can be
    described equally well in any other frame, with other coefficients.
    """
    everywhere = spec.moves_sideways
    return "rotation_rad" in calibration.uncertainty and not calibration.is_exact and not everywhere


def free_time(calibration: Calibration) -> str | None:
    """Returns the free time: the clock offset, else the latency; None if neither is free.

    Times estimated from a measured state are fixed.
    """
    if not calibration.responses:
        return None
    if "clock_offset_s" in calibration.uncertainty:
        return "clock_offset_s"
    if calibration.command_latency_s > 0.0:
        return "command_latency_s"
    return None


WORTH = 0.1
"""Terms are removed while the error rises by less than this share in total."""


def simplify(problem: Problem, refined: Refined) -> Refined:
    """Removes terms of the body twist that hardly improve the prediction of the training part.

    The term with the least weight is tried first; the rest is refined again.
    """
    best, tried = refined, set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while (weakest := _weakest(best, problem.spec, tried)) is not None:
        tried.add(weakest)
        coefficients = best.model.coefficients.copy()
        coefficients[weakest] = 0.0
        if not coefficients[:3].any():  # the last term: without it the robot would not move
            break
        shorter = replace(best.model, coefficients=coefficients)
        try:
            again = refine(problem, shorter, best.calibration)
        except np.linalg.LinAlgError:  # the remaining model is unstable: its slopes overflow
            continue
        if again.error < limit:
            best = again
    used = np.abs(best.model.coefficients).sum(axis=0) > 0.0
    model = replace(
        best.model,
        powers=best.model.powers[used],
        coefficients=np.ascontiguousarray(best.model.coefficients[:, used]),
    )
    return replace(best, model=model, std_errors=best.std_errors[:, used])


def _weakest(
    refined: Refined, spec: RobotSpec, tried: set[tuple[int, int]]
) -> tuple[int, int] | None:
    """Returns the untried free term of the twist with the least weight over the range of X."""
    model = refined.model
    free = free_coefficients(model, refined.calibration, spec)[:3]
    reach = np.maximum(np.abs(model.low), np.abs(model.high))
    size = np.abs(model.coefficients[:3]) * np.prod(reach**model.powers, axis=1)
    size = size / np.maximum(size.sum(axis=1, keepdims=True), 1e-12)
    order = np.argsort(np.where(free, size, np.inf), axis=None)
    for flat in order:
        d, k = divmod(int(flat), size.shape[1])
        if free[d, k] and (d, k) not in tried:
            return d, k
    return None
