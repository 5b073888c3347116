"""Refines a model by its open-loop errors over seconds (the output-error method).

Least squares on rates asks for the next instant; a simulator is asked for the next seconds.
Ljung, System Identification, ch. 7; the paper's kept terms stay, their values move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.calibration.calibration import Calibration, Response
from nics_drl_bridge.calibration.free import (
    free_coefficients,
    free_time,
    lag_is_measured,
    linear_term,
    may_turn,
)
from nics_drl_bridge.calibration.least_squares import minimise, uncertainty
from nics_drl_bridge.calibration.problem import (
    HORIZONS_S,
    Problem,
    prediction_errors,
    prediction_slopes,
)
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.statistics import clustered_errors

Array = NDArray[np.float64]

DIVERGED = 1e3
LEAST_SCALE = 0.05
WITHIN = 12.0**-0.5
"""A model moves by what holds at the start of a step: a time is uncertain by where in a step it
lies, as a uniform distribution over the step is."""


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
    """What may move: coefficients (D, K), a time of the calibration, its rotation."""

    coefficients: NDArray[np.bool_]
    time: str | None
    turn: bool

    @property
    def count(self) -> int:
        """How many coefficients."""
        return int(self.coefficients.sum())


def refine(problem: Problem, model: TaylorModel, calibration: Calibration) -> Refined:
    """Moves coefficients and calibration to the least open-loop error.

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
    """Standard errors (D, K); windows that share a stretch of the drive are one cluster."""
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
    """The lag and the gain that the coefficients of the state's rate amount to."""
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
