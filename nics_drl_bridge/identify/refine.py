"""Refinement of a model by its open-loop errors over seconds (the output-error method).

Least squares on rates predicts the next instant; a simulator must predict the next seconds.
Ljung, System Identification, ch. 7; the paper's kept terms stay, their values change. Terms that
then hardly improve the prediction are removed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.problem import (
    HORIZONS_S,
    Problem,
    free_coefficients,
    free_time,
    lag_is_measured,
    linear_term,
    may_turn,
    prediction_errors,
    prediction_slopes,
    problem_of,
)
from nics_drl_bridge.identify.statistics import clustered_errors, minimise, uncertainty
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Array = NDArray[np.float64]

DIVERGED = 1e3
LEAST_SCALE = 0.05
WITHIN = 12.0**-0.5
"""A model uses the values at the start of a step, so a time is uncertain by the standard deviation
of a uniform distribution over the step."""
WORTH = 0.1
"""Terms are removed while the error rises by less than this share in total."""
Errors = Mapping[str, Mapping[str, float]]


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


def by_definition(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> tuple[TaylorModel, Calibration]:
    """Scales an inferred speed so that vx = 1 speed, and treats lateral motion as noise.

    `base_link` of a robot without a lateral command is the point without lateral motion.
    """
    coefficients = model.coefficients.copy()
    if not spec.moves_sideways:
        coefficients[1] = 0.0
    responses = list(calibration.responses)
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    if responses and len(speeds) == 1:
        i = speeds[0]
        alone = np.array([v == spec.state[i].name for v in spec.variable_names], dtype=np.int64)
        scale = float(coefficients[0] @ (model.powers == alone).all(axis=1))
        if scale > 0.0:
            coefficients = coefficients / scale ** model.powers[:, i]
            coefficients[3 + i] *= scale
            responses[i] = replace(responses[i], gain=responses[i].gain * scale)
            coefficients[0, (model.powers == alone).all(axis=1)] = 1.0
    model = replace(model, coefficients=coefficients)
    return model, replace(calibration, responses=tuple(responses))


def refined(
    linear: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[TaylorModel, Calibration, str]:
    """Refines a linear fit by its predictions of the training part, and removes terms.

    Returns:
        Model and calibration, and a sentence on what was done, or why it could not be.
    """
    model, calibration = by_definition(linear.with_errors({}), calibration, drive.spec)
    problem = problem_of(model, calibration, drive)
    if problem is None:
        return merged(model, linear, {}), calibration, (
            "The training part is too short to refine the model by its errors over seconds; record "
            "a longer drive."
        )  # fmt: skip
    try:
        best = simplify(problem, refine(problem, model, calibration))
    except np.linalg.LinAlgError:  # the model is unstable: its slopes overflow
        return merged(model, linear, {}), calibration, (
            "The predictions of the fitted model run away on the training part, so that it could "
            "not be refined."
        )  # fmt: skip
    errors = replace(best.model, std_errors=best.std_errors).named_errors
    return merged(best.model, linear, errors), best.calibration, (
        "Coefficients and calibration were refined by the open-loop errors over up to 5 s: "
        f"{best.error:.4f} m (root mean square) is left on the training part."
    )  # fmt: skip


def merged(model: TaylorModel, linear: TaylorModel, refined: Errors) -> TaylorModel:
    """Returns the model with the standard errors of its coefficients.

    Rows that are unchanged from the linear fit keep its errors; a refined coefficient has the
    larger of both.
    """
    first = linear.named_errors
    own = {dof: row for dof, row in first.items() if _same_row(model, linear, dof)}
    refined = {
        dof: {term: max(error, first.get(dof, {}).get(term, 0.0)) for term, error in row.items()}
        for dof, row in refined.items()
    }
    rows = {dof: {**own.get(dof, {}), **refined.get(dof, {})} for dof in model.dofs}
    return model.with_errors(rows)


def _same_row(model: TaylorModel, linear: TaylorModel, dof: str) -> bool:
    d = model.dofs.index(dof)
    before = dict(zip(linear.term_names, linear.coefficients[d], strict=True))
    after = dict(zip(model.term_names, model.coefficients[d], strict=True))
    return all(before.get(name, 0.0) == value for name, value in after.items())


def refine(problem: Problem, model: TaylorModel, calibration: Calibration) -> Refined:
    """Adjusts coefficients and calibration to the least open-loop error; no term is added."""
    free = _Free(
        free_coefficients(model, calibration, problem.drive.spec),
        free_time(calibration),
        may_turn(calibration, problem.drive.spec),
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
    for state in problem.drive.spec.state:
        tied = [linear_term(model, problem.drive.spec, n) for n in (state.name, str(state.follows))]
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
            linear_term(model, problem.drive.spec, n) for n in (response.state, response.command)
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
        responses=tuple(_response(model, problem.drive.spec, r) for r in calibration.responses),
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


def simplify(problem: Problem, refined: Refined) -> Refined:
    """Removes terms of the body twist that hardly improve the prediction of the training part.

    The term with the least weight is tried first; the rest is refined again.
    """
    best, tried = refined, set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while (weakest := _weakest(best, problem.drive.spec, tried)) is not None:
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
