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
from nics_drl_bridge.calibration.open_loop import Windows, predict, windows
from nics_drl_bridge.calibration.timing import minimise, uncertainty
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Recording
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

HORIZONS_S = (1.0, 2.5, 5.0)
SPACING_S = 0.25
MIN_WINDOWS = 10
HEADING_ARM_M = 0.3
"""A heading error counts as a position error at this distance."""
WORTH = 0.1
"""A term whose loss raises the error by less than this share is left out."""
DIVERGED = 1e3
LEAST_SCALE = 0.05


@dataclass(frozen=True)
class Refined:
    """A refined model.

    Attributes:
        model: the model.
        calibration: with refined offset (or latency), rotation, lags and gains.
        error: root mean square of the open-loop errors on the training part [m].
    """

    model: TaylorModel
    calibration: Calibration
    error: float


@dataclass(frozen=True)
class _Problem:
    recording: Recording
    spec: RobotSpec
    chosen: tuple[Windows, ...]
    free: NDArray[np.bool_]
    time: str | None
    turn: bool


def refine(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    start: float,
    stop: float,
) -> Refined | None:
    """Moves coefficients and calibration to the least open-loop error.

    Args:
        model: the fitted model; its pruned terms stay pruned.
        calibration: of the drive.
        recording: the drive.
        spec: the robot.
        start: of the part of the drive to use, from its first pose [s].
        stop: its end [s].

    Returns:
        The refined model, or None if the part is too short.
    """
    chosen = tuple(
        windows(recording, calibration, start, stop, horizon, SPACING_S) for horizon in HORIZONS_S
    )
    chosen = tuple(w for w in chosen if len(w.start_t) >= MIN_WINDOWS)
    if not chosen:
        return None
    problem = _Problem(
        recording,
        spec,
        chosen,
        free_coefficients(model, calibration, spec),
        _free_time(calibration),
        "rotation_rad" in calibration.uncertainty and not calibration.is_exact,
    )
    theta = _pack(problem, model, calibration)
    scale = np.maximum(np.abs(theta), LEAST_SCALE)
    scale[int(problem.free.sum()) :] = LEAST_SCALE  # s, rad
    theta, jacobian, rest = minimise(
        lambda value: _residual(problem, model, calibration, value), theta, scale
    )
    sigma = uncertainty(jacobian, rest)
    refined = _unpack(problem, model, calibration, theta, sigma)
    return Refined(*refined, float(np.sqrt(np.mean(rest**2))))


def simplify(
    refined: Refined, recording: Recording, spec: RobotSpec, start: float, stop: float
) -> Refined:
    """Leaves out terms of the body twist that hardly help to predict the training part.

    The one that is least certain goes first; the rest is refined anew.
    """
    best, tried = refined, set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while (weakest := _weakest(best, spec, tried)) is not None:
        tried.add(weakest)
        coefficients = best.model.coefficients.copy()
        coefficients[weakest] = 0.0
        shorter = replace(best.model, coefficients=coefficients)
        again = refine(shorter, best.calibration, recording, spec, start, stop)
        if again is not None and again.error < limit:
            best = again
    used = np.abs(best.model.coefficients).sum(axis=0) > 0.0
    model = replace(
        best.model,
        powers=best.model.powers[used],
        coefficients=np.ascontiguousarray(best.model.coefficients[:, used]),
    )
    return replace(best, model=model)


def _weakest(
    refined: Refined, spec: RobotSpec, tried: set[tuple[int, int]]
) -> tuple[int, int] | None:
    """The free term of the twist that weighs least, standardised by the range of X."""
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


def free_coefficients(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> NDArray[np.bool_]:
    """Which coefficients (D, K) may move: kept, and not fixed by what a state is.

    An inferred speed is by definition the speed along the travel, so that vx = 1 speed; its
    lag stays where the wheels showed it.
    """
    free = model.coefficients != 0.0
    if not calibration.responses:
        free[3:] = False  # the rates of a measured state were fitted to that state itself
    for i, response in enumerate(calibration.responses):
        alone = _linear_term(model, spec, response.state)
        if alone is None:
            continue
        if model.coefficients[0, alone] == 1.0:
            free[0, alone] = False
        else:  # another scale of this state would serve as well: its gain stays
            free[3 + i, _linear_term(model, spec, response.command)] = False
        if _lag_is_measured(calibration):
            free[3 + i, alone] = False
    return np.asarray(free)


def _lag_is_measured(calibration: Calibration) -> bool:
    """Offset and latency are both known only where the wheels showed the response."""
    return {"clock_offset_s", "command_latency_s"} <= set(calibration.uncertainty)


def _linear_term(model: TaylorModel, spec: RobotSpec, name: str) -> int | None:
    """Column of the term that is one variable alone."""
    wanted = np.array([v == name for v in spec.variable_names], dtype=np.int64)
    hits = np.flatnonzero((model.powers == wanted).all(axis=1))
    return int(hits[0]) if len(hits) else None


def _free_time(calibration: Calibration) -> str | None:
    """The time that may move: the clock offset, else the latency; none that the state showed."""
    if not calibration.responses:
        return None
    if "clock_offset_s" in calibration.uncertainty:
        return "clock_offset_s"
    if calibration.command_latency_s > 0.0:
        return "command_latency_s"
    return None


def _pack(problem: _Problem, model: TaylorModel, calibration: Calibration) -> Array:
    tail = [] if problem.time is None else [float(getattr(calibration, problem.time))]
    tail += [calibration.rotation_rad] if problem.turn else []
    return np.append(model.coefficients[problem.free], tail)


def _unpack(
    problem: _Problem,
    model: TaylorModel,
    calibration: Calibration,
    theta: Array,
    sigma: Array | None = None,
) -> tuple[TaylorModel, Calibration]:
    count = int(problem.free.sum())
    coefficients = model.coefficients.copy()
    coefficients[problem.free] = theta[:count]
    for i, response in enumerate(calibration.responses):
        own, command = (
            _linear_term(model, problem.spec, n) for n in (response.state, response.command)
        )
        if own is not None and command is not None and not problem.free[3 + i, command]:
            coefficients[3 + i, command] = -response.gain * coefficients[3 + i, own]
    model = replace(model, coefficients=coefficients)
    tail = list(theta[count:])
    names = ([problem.time] if problem.time else []) + (["rotation_rad"] if problem.turn else [])
    values = dict(zip(names, map(float, tail), strict=True))
    if sigma is None:
        return model, replace(calibration, **values)  # type: ignore[arg-type]
    if "rotation_rad" in values:
        values["rotation_rad"] = float(geometry.wrap_angle(values["rotation_rad"]))
    spread = dict(zip(names, map(float, sigma[count:]), strict=True))
    if _lag_is_measured(calibration) and "clock_offset_s" in spread:
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
    own, command = (_linear_term(model, spec, n) for n in (response.state, response.command))
    if own is None or command is None or not 0.0 < -model.coefficients[d, own] * model.dt < 1.0:
        return response
    rate = -float(model.coefficients[d, own])
    lag = -model.dt / float(np.log1p(-rate * model.dt))
    return replace(response, lag_s=lag, gain=float(model.coefficients[d, command]) / rate)


def _residual(
    problem: _Problem, model: TaylorModel, calibration: Calibration, theta: Array
) -> Array:
    model, calibration = _unpack(problem, model, calibration, theta)
    parts = []
    with np.errstate(all="ignore"):  # a step of the search may diverge; it is then taken back
        for chosen in problem.chosen:
            error = (
                predict(model, calibration, problem.recording, problem.spec, chosen) - chosen.end
            )
            error[:, 2] = HEADING_ARM_M * geometry.wrap_angle(error[:, 2])
            parts.append(error.ravel())
    finite = np.nan_to_num(np.concatenate(parts), nan=DIVERGED)
    return np.asarray(np.clip(finite, -DIVERGED, DIVERGED))
