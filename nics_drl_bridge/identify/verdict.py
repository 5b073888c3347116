"""Verdict on a drive and its model: quality on unseen data, doubts, usefulness, or a refusal."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.excitation import Excitation, plausible
from nics_drl_bridge.identify.findings import Identified
from nics_drl_bridge.identify.fit import ORDER, Fit
from nics_drl_bridge.identify.open_loop import HORIZON_S, OpenLoop, open_loop_error
from nics_drl_bridge.identify.statistics import errors_of
from nics_drl_bridge.recording.recording import Recording, Samples
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import Quality, TaylorModel

Array = NDArray[np.float64]

MIN_ROWS = 20
FEW_LEVELS = 2
ILL_CONDITIONED = 1e6
FAR_OFF = 0.25
"""Predictions whose mean error exceeds this share of the path are not to be trusted."""
UNEXPLAINED = 0.5
MANY_OUTLIERS = 0.001
MOST_LEFT = 0.5
"""Share of the error of standing still above which a model is hardly better."""
COARSE = 2.0 / 3.0
"""A state that changes by this share of its range between two rows is sampled too coarsely."""
ENDS = (1.0, 99.0)
"""Percentiles that bound the range of a state."""
MIRRORED = -0.5
"""Correlation of yaw rate and steering below which the robot turns the wrong way."""


def refuse_unexcited(excitation: Excitation, spec: RobotSpec) -> None:
    """Refuses a drive that did not move every input independently.

    Raises:
        FitError: names the inputs.
    """
    still = excitation.unmoved
    commands = [c.name for c in spec.command]
    named = [name for name in still if name in commands] or list(still)
    if named:
        raise FitError(
            f"{_list(named)} never moved in this drive; drive with {_list(named)} changing over "
            "the whole range, or allow a model without."
        )
    if excitation.together:
        raise FitError(
            f"{_list(excitation.together)} always moved together in this drive; drive with "
            "each changing on its own, or allow a model without."
        )


def unlearnt(linear: Fit, calibration: Calibration, spec: RobotSpec) -> tuple[str, ...]:
    """Returns sentences on inputs that the drive did not move, or not independently.

    Also on states that depended on others, and on commands with two values only.
    """
    already = {r.command for r in calibration.responses} | {r.state for r in calibration.responses}
    excitation = linear.excitation
    missing = [name for name in excitation.unmoved if name not in already]
    notes = []
    if excitation.unmoved:
        notes.append(
            f"The model has no terms of {', '.join(excitation.unmoved)}, which never moved: it "
            "holds for this drive's constant value only."
        )
    if missing:
        notes.append(
            f"Drive with {', '.join(missing)} changing over the whole range to learn them."
        )
    if excitation.together:
        notes.append(
            f"{_list(excitation.together)} always moved together, so their effects can't be told "
            "apart: the model holds for this proportion only; drive with each changing on its own."
        )
    copies = [v.name for v in spec.state if v.name in linear.dependent]
    if copies:
        notes.append(
            f"{_list(copies)} always followed from the other variables, so their effects can't be "
            "told apart: the model does without, and holds for as long as that is so."
        )
    coarse = [
        c.name
        for c in spec.command
        if excitation.levels[c.name] == FEW_LEVELS and c.name not in excitation.unmoved
    ]
    if coarse:
        notes.append(
            f"{_list(coarse)} took two values only: between them the model is a straight line, "
            "whatever the robot does; drive with values in between."
        )
    return tuple(notes)


def doubts(linear: Fit, held_out: OpenLoop | None, exact: bool) -> tuple[str, ...]:
    """Returns a sentence on each reason to doubt the fit or its predictions."""
    notes = []
    for d, dof in enumerate(linear.model.dofs):
        if linear.outliers[d] > MANY_OUTLIERS:
            notes.append(
                f"{linear.outliers[d]:.1%} of the rows of {dof} were outliers and were left out "
                "of the fit."
            )
        if linear.condition[d] > ILL_CONDITIONED:
            notes.append(
                f"The terms of {dof} are nearly copies of each other on this drive (condition "
                f"number {linear.condition[d]:.1g}): their coefficients are no use one by one; "
                "lower the order or drive with more variety."
            )
    lost = [n for n, r2 in zip(linear.model.dofs, linear.r2, strict=True) if r2 < UNEXPLAINED]
    lost = [n for n in lost if exact and n in {c.dof for c in linear.curves} and n != "vy"]
    if lost:
        notes.append(
            f"The model explains less than half of {_list(lost)}: the robot did not follow its "
            "commands in a way that a polynomial can describe; do not trust its predictions."
        )
    if held_out is not None and held_out.mean_path_m > 0.0:
        share = held_out.mean_position_error_m / held_out.mean_path_m
        end = f"end {share:.0%} of their path away" if isfinite(share) else "run away"
        if not share <= FAR_OFF:
            notes.append(
                f"On unseen data the predictions {end}: the response does not follow the commands "
                "as the model has it; do not train with this model."
            )
    return tuple(notes)


def _list(names: tuple[str, ...] | list[str]) -> str:
    """Joins names: `a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def mirror_note(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns a sentence if the robot turns right when commanded to turn left."""
    for i, command in enumerate(spec.command, start=len(spec.state)):
        if command.cmd_vel != "angular.z":
            continue
        turn, wanted = samples.dq[:, 2], samples.x[:, i]
        if command.unit == "rad":
            wanted = wanted * np.sign(samples.dq[:, 0])
        if min(turn.std(), wanted.std()) > 1e-3 and np.corrcoef(turn, wanted)[0, 1] < MIRRORED:
            return (
                f"The robot turns right where {command.name} is positive: the recording is a "
                "mirror image (y and heading reversed), or the sign of the command is; the model "
                "moves as recorded.",
            )
    return ()


def unseen_samples(samples: Samples, drive: Drive, calibration: Calibration) -> Samples | None:
    """Returns the samples of the part of a drive that the fit did not see; None if too few."""
    begin = drive.recording.pose.t[0] + calibration.clock_offset_s + drive.settings.train_until_s
    unseen = samples.rows(samples.t > begin)
    return unseen if len(unseen.t) >= MIN_ROWS else None


def tried(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> tuple[OpenLoop | None, tuple[str, ...]]:
    """Tries a model on the part of a drive that the fit did not see.

    Returns:
        Open-loop errors; or None, and a sentence, if the part is too short.
    """
    until = drive.settings.train_until_s
    try:
        return open_loop_error(model, calibration, drive, until, drive.duration_s), ()
    except RecordingError:
        left = max(drive.duration_s - until, 0.0)
        return None, (
            f"The last {left:.1f} s, held out of the fit, are too short for a prediction over "
            f"{HORIZON_S:g} s: the model was not tried on unseen data; record 20 s or more.",
        )


def with_quality(
    model: TaylorModel,
    linear: Fit,
    unseen: Samples | None,
    held_out: OpenLoop | None,
    spec: RobotSpec,
) -> TaylorModel:
    """Returns the model with its figures of merit."""
    dofs = model.dofs

    def by_dof(values: Array) -> dict[str, float]:
        return {dof: float(value) for dof, value in zip(dofs, values, strict=True)}

    rmse, r2 = ({}, {}) if unseen is None else map(by_dof, errors_of(model, _usable(unseen, spec)))
    quality = Quality(
        samples=linear.samples,
        outliers=by_dof(linear.outliers),
        condition=by_dof(linear.condition),
        rmse=by_dof(linear.rmse),
        r2=by_dof(linear.r2),
        held_out_rmse=rmse,
        held_out_r2=r2,
    )
    if held_out is not None:
        quality = replace(
            quality,
            open_loop_horizon_s=held_out.horizon_s,
            open_loop_position_error_m=held_out.mean_position_error_m,
            open_loop_heading_error_rad=held_out.mean_heading_error_rad,
            open_loop_path_m=held_out.mean_path_m,
        )
    return replace(model, quality=quality)


def _usable(samples: Samples, spec: RobotSpec) -> Samples:
    return samples.rows(plausible(samples.x, spec))


def is_useless(error: float, standing: float, path: float, radius: float) -> bool:
    """True if predictions are hardly better than assuming that the robot stands still.

    Persistence is the usual baseline of a forecast (Murphy: Skill scores based on the mean square
    error, Monthly Weather Review, 1988). A robot that drives in circles or turns on the spot
    returns to its start: there the path and the robot's size set the scale.

    Args:
        error: median position error of the predictions [m]; NaN or inf if they diverge.
        standing: median position error on the same windows if the robot stood still [m].
        path: mean length of the measured path [m].
        radius: of the robot [m].
    """
    return not error <= max(MOST_LEFT * standing, FAR_OFF * path, radius)


def why_useless(identified: Identified, spec: RobotSpec, order: int = ORDER) -> str:
    """Returns one sentence on why a model is useless; empty if it is useful or untested.

    The median counts: a single permanent jump of the pose spoils only some of the predictions.
    """
    held_out, recording = identified.held_out, identified.recording
    if held_out is None:
        return ""
    error, standing = held_out.median_position_error_m, held_out.median_displacement_m
    if not np.isfinite(held_out.mean_position_error_m):
        error = np.inf
    if not is_useless(error, standing, held_out.mean_path_m, spec.footprint_radius):
        return ""
    return (
        f"{recording.source}: the fitted model is of no use: on unseen data its predictions "
        f"{_end(error)} after {held_out.horizon_s:g} s and a path of {held_out.mean_path_m:.2f} m, "
        f"where a robot that stood still would be {standing:.2f} m off; "
        f"{_suspicion(identified, spec, order)}."
    )


def _end(error: float) -> str:
    return f"end {error:.3g} m off" if np.isfinite(error) else "have run away"


def _suspicion(identified: Identified, spec: RobotSpec, order: int) -> str:
    """Returns the likely cause of a bad fit, and its remedy."""
    recording, unmoved = identified.recording, identified.fit.unmoved
    coarsest = max(_steps(recording, spec, unmoved), default=(0.0, ""))
    rows = recording.pose if recording.state is None else recording.state
    apart = f"{np.median(np.diff(rows.t)):.2g} s apart"
    if coarsest[0] > COARSE:
        return (
            f"{coarsest[1]} changes by {coarsest[0]:.0%} of its range between rows that are "
            f"{apart}, so record at a higher rate"
        )
    if unmoved:
        return (
            f"{', '.join(unmoved)} never moved in its first {identified.train_until_s:.0f} s, from "
            "which it is learnt, so change it from the beginning on"
        )
    if identified.alpha != "auto" or order < ORDER:
        return f"it may lack terms, so leave the order at {ORDER} and alpha at `auto`"
    return (
        "the recording does not show why, so make sure that nothing held the robot up, that it got "
        f"each command, that its pose did not jump and that rows {apart} show how it responds, and "
        "record anew"
    )


def _steps(
    recording: Recording, spec: RobotSpec, unmoved: tuple[str, ...]
) -> list[tuple[float, str]]:
    """Returns the step between rows and the name of each measured state that moved.

    The step is the 99th percentile, as a share of the state's range.
    """
    if recording.state is None:
        return []
    moved = [i for i, v in enumerate(spec.state) if v.name not in unmoved]
    values = recording.state.values[:, moved]
    spread = np.ptp(np.percentile(values, ENDS, axis=0), axis=0)
    steps = np.percentile(np.abs(np.diff(values, axis=0)), ENDS[1], axis=0)
    return [
        (float(step / size), spec.state[i].name)
        for i, step, size in zip(moved, steps, spread, strict=True)
        if size > 0.0
    ]
