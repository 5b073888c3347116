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
    chosen = tuple(
        _without_outliers(w, model, calibration, recording, spec)
        for w in chosen
        if len(w.start_t) >= MIN_WINDOWS
    )
    if not chosen:
        return None
    problem = _Problem(
        recording,
        spec,
        chosen,
        free_coefficients(model, calibration, spec),
        _free_time(calibration),
        _may_turn(calibration, spec),
    )
    theta = _pack(problem, model, calibration)
    scale = np.maximum(np.abs(theta), LEAST_SCALE)
    scale[int(problem.free.sum()) :] = LEAST_SCALE  # s, rad
    theta, jacobian, rest = minimise(
        lambda value: _residual(problem, model, calibration, value), theta, scale
    )
    sigma = uncertainty(jacobian, rest)
    refined = _unpack(problem, model, calibration, theta, sigma)
    error = float(np.sqrt(np.mean(rest**2)))
    return Refined(*refined, error, _coefficient_errors(problem, jacobian, rest, refined[0]))


def _coefficient_errors(
    problem: _Problem, jacobian: Array, rest: Array, model: TaylorModel
) -> Array:
    """Standard errors (D, K); windows that share a stretch of the drive are one cluster."""
    starts = np.concatenate([np.repeat(w.start_t, 3) for w in problem.chosen])
    cluster = np.floor((starts - starts.min()) / max(HORIZONS_S)).astype(np.intp)
    errors = np.full(model.coefficients.shape, np.nan)
    count = int(problem.free.sum())
    errors[problem.free] = clustered_errors(jacobian, rest, cluster)[:count]
    for state in problem.spec.state:
        tied = [_linear_term(model, problem.spec, n) for n in (state.name, str(state.follows))]
        d = model.dofs.index(f"d_{state.name}")
        if None in tied or not problem.free[d, tied[0]] or problem.free[d, tied[1]]:
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


def _may_turn(calibration: Calibration, spec: RobotSpec) -> bool:
    """Whether the rotation may move.

    It is known by the direction in which a robot can't move. One that moves in every direction
    would be described as well in any other frame, with other coefficients.
    """
    everywhere = any(command.cmd_vel == "linear.y" for command in spec.command)
    return "rotation_rad" in calibration.uncertainty and not calibration.is_exact and not everywhere


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
