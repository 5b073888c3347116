"""Judgement of a model: its predictions of unseen data, their band, and those of yardsticks."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import hypotheses, shooting
from nics_drl_bridge.identify.acceptance import comparison_noise
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.forms import problem_of
from nics_drl_bridge.identify.open_loop import (
    HORIZON_S,
    SPACING_S,
    Windows,
    predict,
    windows,
)
from nics_drl_bridge.identify.refine import readjust
from nics_drl_bridge.identify.terms import select_defined_dofs
from nics_drl_bridge.identify.yardstick import (
    Yardstick,
    fit_yardstick,
    kept_twist,
    twists_before,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors, TaylorModel

HORIZONS_S = (0.5, 1.0, 2.0, HORIZON_S, 10.0)
BANDED_S = HORIZONS_S[:4]
FOLDS = 5
# limit for the fits to all parts but one, which start from the fit to all parts
EVALUATIONS = 8
# percentage of ends within a band, and the minimum number of ends for it
WITHIN = 95.0
FEWEST = 20


def textbook_of(drive: Drive, calibration: Calibration) -> Yardstick | None:
    """Fits the textbook to the training part; None for an exact drive, or one that is too short."""
    if calibration.is_exact:
        return None
    with suppress(RecordingError):  # the training part is too short
        return fit_yardstick(
            drive, drive.settings.train_until_s, calibration.clock_offset_s
        )
    return None


def judged(
    model: TaylorModel,
    calibration: Calibration,
    drive: Drive,
    bands: dict[float, float],
    textbook: Yardstick | None,
) -> tuple[HorizonErrors, ...]:
    """Compares predictions of the held-out part, at the horizons that fit into it.

    `bands` are the distances within which 95 % of the ends are expected [m], by horizon [s].
    """
    begin = drive.settings.train_until_s
    told = []
    for horizon in HORIZONS_S:
        chosen = windows(
            drive, calibration, begin, drive.duration_s, horizon, SPACING_S
        )
        if not len(chosen.start_t):
            break
        ends = predict(model, calibration, drive, chosen)
        twist = twists_before(drive, chosen.start_t)
        kept = kept_twist(drive, chosen, twist)
        if textbook is None:
            by_textbook = None
        else:
            by_textbook = textbook.predict(drive, chosen, twist)
        far = distances(ends, chosen)
        band = bands.get(horizon)
        told.append(
            HorizonErrors(
                horizon_s=horizon,
                windows=len(far),
                path_m=float(chosen.path.mean()),
                model=errors_of_ends(ends, chosen),
                kept_twist=errors_of_ends(kept, chosen),
                textbook=None
                if by_textbook is None
                else errors_of_ends(by_textbook, chosen),
                band_m=band,
                coverage=None if band is None else float((far <= band).mean()),
                kept_twist_noise_m=noise_beside(ends, kept, chosen, horizon),
                textbook_noise_m=noise_beside(ends, by_textbook, chosen, horizon),
                standing=errors_of_ends(chosen.start, chosen),
                standing_noise_m=noise_beside(ends, chosen.start, chosen, horizon),
            )
        )
    return tuple(told)


def distances(ends: Array, chosen: Windows) -> Array:
    """Returns the distances (W,) of predicted ends (W, 3) from the measured ones [m]."""
    return np.asarray(np.hypot(*(ends - chosen.end)[:, :2].T))


def noise_beside(
    ends: Array, other: Array | None, chosen: Windows, horizon: float
) -> float | None:
    """Returns the noise [m] of a comparison of two predictions (W, 3) of the same ends."""
    if other is None:
        return None
    difference = distances(ends, chosen) - distances(other, chosen)
    # one of them diverges, so the ranking is clear
    if not np.isfinite(difference).all():
        return 0.0
    return comparison_noise(difference, chosen.start_t, horizon)


def errors_of_ends(ends: Array, chosen: Windows) -> EndErrors:
    """Returns the mean errors of predicted ends (W, 3)."""
    apart = ends - chosen.end
    heading = np.abs(geometry.wrap_angle(apart[:, 2])).mean()
    return EndErrors(float(np.hypot(*apart[:, :2].T).mean()), float(heading))


def bands_of_fixed(
    model: TaylorModel, calibration: Calibration, training: Drive
) -> dict[float, float]:
    """Returns the bands [m] by horizon of a model that is not adjusted to any part of a drive."""
    bands = dict[float, float]()
    for horizon in BANDED_S:
        chosen = windows(
            training, calibration, 0.0, training.duration_s, horizon, SPACING_S
        )
        if len(chosen.start_t) >= FEWEST:
            far = distances(predict(model, calibration, training, chosen), chosen)
            bands[horizon] = float(np.percentile(far, WITHIN))
    return bands


def bands_of(
    model: TaylorModel,
    calibration: Calibration,
    training: Drive,
    derived: tuple[Samples, hypotheses.Base] | None,
) -> dict[float, float]:
    """Returns the distances [m] within which 95 % of predictions are expected to end, by horizon.

    Each fold of the training part is predicted by the model adjusted to the others. `derived` are
    the samples of a motion derived from the poses, and the base that the model departed from.
    """
    pose = training.recording.pose
    errors: dict[float, list[Array]] = {h: [] for h in BANDED_S}
    for block in np.array_split(np.arange(len(pose.t)), FOLDS):
        others = np.ones(len(pose.t), dtype=np.bool_)
        others[block] = False
        if derived is None:
            rest = training.part(replace(training.recording, pose=pose.rows(others)))
            found = readjust(model, calibration, rest)
        else:
            at = pose.t[block[[0, -1]]] + calibration.clock_offset_s
            kept = (derived[0].t < at[0]) | (derived[0].t > at[1])
            found = _with_motion(model, calibration, training, *derived, kept)
        if found is None:
            return {}
        part = training.part(replace(training.recording, pose=pose.rows(block)))
        for horizon, told in errors.items():
            chosen = windows(part, found[1], 0.0, part.duration_s, horizon, SPACING_S)
            if len(chosen.start_t):
                told.append(
                    np.hypot(*(predict(*found, part, chosen) - chosen.end)[:, :2].T)
                )
    every = {h: np.concatenate(told) for h, told in errors.items() if told}
    return {
        h: float(np.percentile(e, WITHIN)) for h, e in every.items() if len(e) >= FEWEST
    }


def _with_motion(
    model: TaylorModel,
    calibration: Calibration,
    training: Drive,
    samples: Samples,
    base: hypotheses.Base,
    kept: NDArray[np.bool_],
) -> tuple[TaylorModel, Calibration]:
    """Adjusts a model with a motion as state, and its inputs, to the rows that are kept (T,)."""
    draft = base.draft
    problem = problem_of(training, calibration, samples, draft.form, draft.inputs)
    problem = replace(problem, spacing_s=hypotheses.SPACING_S)
    free = (model.coefficients != 0.0) & ~select_defined_dofs(training.spec)[:, None]
    pull = hypotheses.PULLS[-1]
    found = shooting.fitted(problem, model, free, draft.inputs, kept, EVALUATIONS, pull)
    calibration = replace(
        calibration,
        command_latency_s=draft.form.latency_at(draft.inputs, found.values),
        inputs=draft.form.curves_at(draft.inputs, found.values),
    )
    model = replace(found.model, inputs=calibration.inputs)
    if problem.mounted:
        calibration = hypotheses.remounted(calibration, found)
    return model, calibration
