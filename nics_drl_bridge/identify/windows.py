"""Prediction problem of a refinement: windows of a drive, errors and their derivatives.

Courses of X over windows, independent of the coefficients of the body twist.

If the state was measured, state and commands of a window are known before the twist is: the
model of the state's rates stays as fitted. One pass through a window then gives the pose at its
end and its derivatives by all coefficients of the twist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.kernels import follow
from nics_drl_bridge.identify.open_loop import Windows, from_measured_states, predict, windows
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.kernels import term_arrays
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
        recording, spec: the drive and the robot.
        chosen: windows of each horizon, without those that contain a jump of the pose.
        courses: of X over them if the state was measured, else empty.
    """

    recording: Recording
    spec: RobotSpec
    chosen: tuple[Windows, ...]
    courses: tuple[Course, ...]


def problem_of(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    start: float,
    stop: float,
) -> Problem | None:
    """Selects the windows that a refinement predicts.

    Args:
        model: the fitted model.
        calibration: of the drive.
        recording: the drive.
        spec: the robot.
        start: start of the part of the drive to use, from its first pose [s].
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


def _without_outliers(
    chosen: Windows,
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
) -> Windows:
    """Drops windows that contain a jump of the pose, or have one at an end."""
    error = predict(model, calibration, recording, spec, chosen) - chosen.end
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
                predicted = predict(model, calibration, problem.recording, problem.spec, chosen)
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


@dataclass(frozen=True)
class Course:
    """X over windows, step by step.

    Attributes:
        chosen: the windows.
        x: (W, T, V + 1) X during each step, and a last entry of 1.
        steps: (W,) whole steps to the end of each window.
        share: (W,) remaining fraction of one more step.
    """

    chosen: Windows
    x: Array
    steps: NDArray[np.intp]
    share: Array


def course_of(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    chosen: Windows,
) -> Course:
    """Returns the course of X over windows, each started from its measured state."""
    states, command, steps, share = from_measured_states(
        model, calibration, recording, spec, chosen
    )[1:]
    ones = np.ones((*command.shape[:2], 1))
    x = np.concatenate([states[:, :-1], command, ones], axis=2)
    return Course(chosen, np.ascontiguousarray(x), steps, share)


def relative_ends(
    course: Course, model: TaylorModel, free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Returns the end poses relative to the starts, and their derivatives by coefficients.

    Args:
        course: of the windows.
        model: its body twist is integrated.
        free: (D, K) coefficients to differentiate by, even where they are zero.

    Returns:
        (W, 3) with unwrapped headings, and (W, 3, P).
    """
    asked = np.zeros(model.coefficients.shape, dtype=np.bool_) if free is None else free
    used = (model.coefficients != 0.0) | asked
    used[3:] = False
    dofs, places = np.nonzero(used)
    terms = term_arrays(replace(model, coefficients=used.astype(np.float64)))
    terms = terms._replace(coefficient=model.coefficients[dofs, places])
    moving = np.flatnonzero(asked[dofs, places]).astype(np.int64)
    ends = np.zeros((len(course.steps), 3))
    moved = np.zeros((len(course.steps), 3, len(moving)))
    follow(ends, moved, course.x, course.steps, course.share, terms, moving, model.dt)
    return ends, moved


def tracked_ends(course: Course, calibration: Calibration, ends: Array) -> Array:
    """Returns poses (W, 3) of the tracked body after `base_link` moved by `ends` (W, 3)."""
    base = calibration.to_base(course.chosen.start)
    return calibration.to_tracked(geometry.compose(base, ends))


def tracked_slopes(course: Course, calibration: Calibration, ends: Array, moved: Array) -> Array:
    """Returns derivatives (W, 3, P) of `tracked_ends`, from those of the relative poses."""
    heading = calibration.to_base(course.chosen.start)[:, 2]
    arm = geometry.rotate(np.broadcast_to(calibration.mounting[:2], (len(ends), 2)), ends[:, 2])
    across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None]
    inside = moved[:, :2] + across * moved[:, 2:]
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = inside[:, 0], inside[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, moved[:, 2]], axis=1)
