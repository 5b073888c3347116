"""Least-squares problem of a refinement: windows of a drive, errors, slopes, free parameters.

Parameters are fixed by definition or by measurement, or free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import (
    Course,
    Windows,
    course_of,
    predict,
    relative_ends,
    tracked_ends,
    tracked_slopes,
    windows,
)
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

Array = NDArray[np.float64]

HORIZONS_S = (1.0, 2.5, 5.0)
SPACING_S = 0.25
MIN_WINDOWS = 10
HEADING_ARM_M = 0.3
"""A heading error counts as a position error at this distance."""
OUTLYING = 10.0
"""A window whose error is this many times the median contains a jump,"""
OUTLYING_SHARE = 0.25
"""if the error is also more than this share of the longest path."""
MOST_OUTLIERS = 0.3
STEEPEST = 1e100
"""Slopes of a diverging model are clipped here, so that their scaling stays finite."""
TURN_RAD = 1e-5
"""Step of the finite difference by the rotation [rad]."""


@dataclass(frozen=True)
class Problem:
    """Prediction problem of a refinement: windows of one drive, the same for every trial model.

    Attributes:
        drive: the drive.
        chosen: windows of each horizon, without those that contain a jump of the pose.
        courses: of X over them if the state was measured, else empty.
    """

    drive: Drive
    chosen: tuple[Windows, ...]
    courses: tuple[Course, ...]


def problem_of(model: TaylorModel, calibration: Calibration, drive: Drive) -> Problem | None:
    """Selects the windows of a training part to predict; None if it is too short."""
    until = drive.settings.train_until_s
    found = (windows(drive, calibration, 0.0, until, h, SPACING_S) for h in HORIZONS_S)
    chosen = tuple(
        _without_outliers(w, model, calibration, drive)
        for w in found
        if len(w.start_t) >= MIN_WINDOWS
    )
    if not chosen:
        return None
    courses: tuple[Course, ...] = ()
    if drive.recording.state is not None:
        courses = tuple(course_of(model, calibration, drive, w) for w in chosen)
    return Problem(drive, chosen, courses)


def _without_outliers(
    chosen: Windows, model: TaylorModel, calibration: Calibration, drive: Drive
) -> Windows:
    """Drops windows that contain a jump of the pose, or have one at an end."""
    error = predict(model, calibration, drive, chosen) - chosen.end
    size = np.hypot(error[:, 0], error[:, 1])
    far = max(OUTLYING * float(np.median(size)), OUTLYING_SHARE * float(chosen.path.max()))
    inside = size <= far
    if inside.all() or inside.mean() < 1.0 - MOST_OUTLIERS or inside.sum() < MIN_WINDOWS:
        return chosen
    return Windows(*(values[inside] for values in vars(chosen).values()))


def prediction_errors(problem: Problem, model: TaylorModel, calibration: Calibration) -> Array:
    """Returns the errors (n,) of all predictions: x, y and heading of each window [m]."""
    parts = []
    with np.errstate(all="ignore"):  # a trial step may diverge; it is then rejected
        for k, chosen in enumerate(problem.chosen):
            if problem.courses:
                ends = relative_ends(problem.courses[k], model)[0]
                predicted = tracked_ends(problem.courses[k], calibration, ends)
            else:
                predicted = predict(model, calibration, problem.drive, chosen)
            error = predicted - chosen.end
            error[:, 2] = HEADING_ARM_M * geometry.wrap_angle(error[:, 2])
            parts.append(error.ravel())
    return np.concatenate(parts)


def prediction_slopes(
    problem: Problem,
    model: TaylorModel,
    calibration: Calibration,
    coefficients: NDArray[np.bool_],
    turn: bool,
) -> Array:
    """Returns the derivatives (n, P) of `prediction_errors` for a measured state.

    Args:
        problem: the windows to predict.
        model: the model.
        calibration: of the drive.
        coefficients: (D, K) mask of the coefficients to differentiate by.
        turn: True to differentiate by the rotation too, in the last column.
    """
    parts = []
    for course in problem.courses:
        ends, moved = relative_ends(course, model, coefficients)
        slope = tracked_slopes(course, calibration, ends, moved)
        if turn:
            turned = [
                tracked_ends(course, replace(calibration, rotation_rad=angle), ends)
                for angle in calibration.rotation_rad + np.array([-TURN_RAD, TURN_RAD])
            ]
            aside = (turned[1] - turned[0])[:, :, None]
            aside[:, 2] = geometry.wrap_angle(aside[:, 2])
            slope = np.concatenate([slope, aside / (2.0 * TURN_RAD)], axis=2)
        slope[:, 2] *= HEADING_ARM_M
        parts.append(slope.reshape(-1, slope.shape[2]))
    slopes = np.nan_to_num(np.concatenate(parts), nan=0.0)
    return np.clip(slopes, -STEEPEST, STEEPEST)


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
    known = "rotation_rad" in calibration.uncertainty
    return known and not calibration.is_exact and not spec.moves_sideways


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
