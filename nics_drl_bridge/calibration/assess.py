"""Assessment of a model: standard errors of what was refined, and its quality on unseen data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.calibration.align import align
from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.open_loop import OpenLoop
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.fit import Fit
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.quality import Quality
from nics_drl_bridge.kinematics.recording import Recording, Samples
from nics_drl_bridge.kinematics.robust import plausible
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.statistics import errors_of

Array = NDArray[np.float64]
Errors = Mapping[str, Mapping[str, float]]

MIN_ROWS = 20


def merged(model: TaylorModel, linear: TaylorModel, refined: Errors) -> TaylorModel:
    """The model with the standard errors of its coefficients.

    Args:
        model: the model.
        linear: the linear fit; its errors hold where a row of the model is the fit's own.
        refined: errors of the coefficients that were refined; where the linear fit was less
            certain, its own stand.
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
    """The samples of the part of a drive that a fit did not see; None if there are too few."""
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
    """The model with its figures of merit."""
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
