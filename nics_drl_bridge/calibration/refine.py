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
from nics_drl_bridge.calibration.course import (
    Course,
    course_of,
    relative_ends,
    tracked_ends,
    tracked_slopes,
)
from nics_drl_bridge.calibration.free import (
    free_coefficients,
    free_time,
    lag_is_measured,
    linear_term,
    may_turn,
)
from nics_drl_bridge.calibration.open_loop import Windows, predict, windows
from nics_drl_bridge.calibration.timing import minimise, uncertainty
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Recording
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.statistics import clustered_errors

Array = NDArray[np.float64]

HORIZONS_S = (1.0, 2.5, 5.0)
SPACING_S = 0.25
MIN_WINDOWS = 10
HEADING_ARM_M = 0.3
"""A heading error counts as a position error at this distance."""
DIVERGED = 1e3
OUTLYING = 10.0
"""A window that ends this many times the usual error away holds a jump,"""
OUTLYING_SHARE = 0.25
"""if that is also more than this share of the longest path."""
MOST_OUTLIERS = 0.3
LEAST_SCALE = 0.05
TURN_RAD = 1e-5
"""By so much the rotation is turned to see what that does."""


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
class Problem:
    """What a refinement predicts: windows of one drive, the same for every model tried on them.

    Attributes:
        recording, spec: the drive and the robot.
        chosen: windows of each horizon, without those that hold a jump of the pose.
        courses: of X over them where the state was measured, else empty.
    """

    recording: Recording
    spec: RobotSpec
    chosen: tuple[Windows, ...]
    courses: tuple[Course, ...]


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


def problem_of(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    start: float,
    stop: float,
) -> Problem | None:
    """Chooses the windows that a refinement predicts.

    Args:
        model: the fitted model.
        calibration: of the drive.
        recording: the drive.
        spec: the robot.
        start: of the part of the drive to use, from its first pose [s].
        stop: its end [s].

    Returns:
        The problem, or None if the part is too short.
    """
    chosen = tuple(
        windows(recording, calibration, start, stop, horizon, SPACING_S) for horizon in HORIZONS_S
    )
    chosen = tuple(
        _without_outliers(w, model, calibration, recording, spec)
        for w in chosen
        if len(w.start_t) >= MIN_WINDOWS
    )
    if not chosen:
        return None
    courses: tuple[Course, ...] = ()
    if recording.state is not None:
        courses = tuple(course_of(model, calibration, recording, spec, w) for w in chosen)
    return Problem(recording, spec, chosen, courses)


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
        return _bounded(_errors(problem, *_unpack(problem, free, model, calibration, value)))

    def jacobian(value: Array) -> Array:
        return _derivatives(problem, free, *_unpack(problem, free, model, calibration, value))

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


def _without_outliers(
    chosen: Windows,
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
) -> Windows:
    """Leaves out windows that a jump of the pose lies in, or at an end."""
    error = predict(model, calibration, recording, spec, chosen) - chosen.end
    size = np.hypot(error[:, 0], error[:, 1])
    far = max(OUTLYING * float(np.median(size)), OUTLYING_SHARE * float(chosen.path.max()))
    inside = size <= far
    if inside.all() or inside.mean() < 1.0 - MOST_OUTLIERS or inside.sum() < MIN_WINDOWS:
        return chosen
    return Windows(*(values[inside] for values in vars(chosen).values()))


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


def _errors(problem: Problem, model: TaylorModel, calibration: Calibration) -> Array:
    """Errors (n,) of all predictions: x, y and heading of each window [m]."""
    parts = []
    with np.errstate(all="ignore"):  # a step of the search may diverge; it is then taken back
        for k, chosen in enumerate(problem.chosen):
            if problem.courses:
                ends = relative_ends(problem.courses[k], model)[0]
                predicted = tracked_ends(problem.courses[k], calibration, ends)
            else:
                predicted = predict(model, calibration, problem.recording, problem.spec, chosen)
            error = predicted - chosen.end
            error[:, 2] = HEADING_ARM_M * geometry.wrap_angle(error[:, 2])
            parts.append(error.ravel())
    return np.concatenate(parts)


def _bounded(error: Array) -> Array:
    finite = np.nan_to_num(error, nan=DIVERGED)
    return np.asarray(np.clip(finite, -DIVERGED, DIVERGED))


def _derivatives(
    problem: Problem, free: _Free, model: TaylorModel, calibration: Calibration
) -> Array:
    """Derivatives (n, P) of `_errors` by the free coefficients and the rotation."""
    parts = []
    for course in problem.courses:
        ends, moved = relative_ends(course, model, free.coefficients)
        slope = tracked_slopes(course, calibration, ends, moved)
        if free.turn:
            turned = [
                tracked_ends(course, replace(calibration, rotation_rad=angle), ends)
                for angle in calibration.rotation_rad + np.array([-TURN_RAD, TURN_RAD])
            ]
            aside = (turned[1] - turned[0])[:, :, None]
            aside[:, 2] = geometry.wrap_angle(aside[:, 2])
            slope = np.concatenate([slope, aside / (2.0 * TURN_RAD)], axis=2)
        slope[:, 2] *= HEADING_ARM_M
        parts.append(slope.reshape(-1, slope.shape[2]))
    return np.nan_to_num(np.concatenate(parts), nan=0.0)
