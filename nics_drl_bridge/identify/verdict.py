"""Verdict on a drive: sentences on what it could not show, or a refusal.

Assessment of a model: standard errors of refined coefficients, and quality on unseen data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify.align import align
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.excitation import plausible
from nics_drl_bridge.identify.fit import Fit
from nics_drl_bridge.identify.open_loop import OpenLoop
from nics_drl_bridge.identify.statistics import errors_of
from nics_drl_bridge.recording.recording import Recording, Samples
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import Quality, TaylorModel

FEW_LEVELS = 2
ILL_CONDITIONED = 1e6
FAR_OFF = 0.25
"""Predictions whose mean error exceeds this share of the path are not to be trusted."""
UNEXPLAINED = 0.5
MANY_OUTLIERS = 0.001


def refuse_unexcited(linear: Fit, spec: RobotSpec) -> None:
    """Refuses a drive that did not move every input independently.

    Raises:
        FitError: names the inputs.
    """
    still = linear.excitation.unmoved
    commands = [c.name for c in spec.command]
    named = [name for name in still if name in commands] or list(still)
    if named:
        raise FitError(
            f"{_list(named)} never moved in this drive; drive with {_list(named)} changing over "
            "the whole range, or allow a model without."
        )
    if linear.excitation.together:
        raise FitError(
            f"{_list(linear.excitation.together)} always moved together in this drive; drive with "
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


Array = NDArray[np.float64]
Errors = Mapping[str, Mapping[str, float]]

MIN_ROWS = 20


def merged(model: TaylorModel, linear: TaylorModel, refined: Errors) -> TaylorModel:
    """Returns the model with the standard errors of its coefficients.

    Args:
        model: the model.
        linear: the linear fit; its errors apply to rows that the model has unchanged from it.
        refined: errors of the refined coefficients; the larger of these and the linear fit's
            errors is used.
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


def unseen_samples(
    recording: Recording, calibration: Calibration, spec: RobotSpec, until: float
) -> Samples | None:
    """Returns the samples of the part of a drive that the fit did not see; None if too few."""
    try:
        samples = align(recording, calibration, spec)
    except RecordingError:
        return None
    begin = recording.pose.t[0] + calibration.clock_offset_s + until
    samples = samples.rows(samples.t > begin)
    return samples if len(samples.t) >= MIN_ROWS else None


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
    low, high = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    return samples.rows(plausible(samples.x, low, high))
