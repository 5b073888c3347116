"""Judgement of a model: its predictions of unseen data, their band, and those of yardsticks."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import hypotheses, shooting
from nics_drl_bridge.identify.acceptance import estimate_comparison_noise
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.forms import make_prediction_problem
from nics_drl_bridge.identify.open_loop import (
    SPACING_S,
    Windows,
    predict,
    select_windows,
)
from nics_drl_bridge.identify.yardstick import (
    Yardstick,
    estimate_twists_at,
    fit_yardstick,
    predict_kept_twist,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors, TaylorModel

HORIZONS_S = (*hypotheses.BANDS_S, 10.0)
FOLDS = 5
# limit for the fits to all parts but one, which start from the fit to all parts
EVALUATIONS = 8
# percentage of ends within a band, and the minimum number of ends for it
WITHIN = 95.0
FEWEST = 20


def fit_textbook(drive: Drive, calibration: Calibration) -> Yardstick | None:
    """Fits the textbook to the training part; None for an exact drive, or one that is too short."""
    if calibration.is_exact:
        return None
    with suppress(RecordingError):  # the training part is too short
        return fit_yardstick(
            drive, drive.settings.train_until_s, calibration.clock_offset_s
        )
    return None


def judge_predictions(
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
    judgement = []
    for horizon in HORIZONS_S:
        chosen = select_windows(
            drive, calibration, begin, drive.duration_s, horizon, SPACING_S
        )
        if not len(chosen.start_t):
            break
        ends = predict(model, calibration, drive, chosen)
        twist = estimate_twists_at(drive, chosen.start_t)
        yardsticks = {
            "kept_twist": predict_kept_twist(drive, chosen, twist),
            "standing": chosen.start,
        }
        if textbook is not None:
            yardsticks["textbook"] = textbook.predict(drive, chosen, twist)
        figures: dict[str, Any] = {}
        for name, theirs in yardsticks.items():
            figures[name] = average_end_errors(theirs, chosen)
            figures[f"{name}_noise_m"] = estimate_noise_beside(
                ends, theirs, chosen, horizon
            )
        band = bands.get(horizon)
        if band is not None:
            coverage = float((measure_end_distances(ends, chosen) <= band).mean())
            figures |= {"band_m": band, "coverage": coverage}
        judgement.append(
            HorizonErrors(
                horizon_s=horizon,
                windows=len(chosen.start_t),
                path_m=float(chosen.path.mean()),
                model=average_end_errors(ends, chosen),
                **figures,
            )
        )
    return tuple(judgement)


def measure_end_distances(ends: Array, chosen: Windows) -> Array:
    """Returns the distances (W,) of predicted ends (W, 3) from the measured ones [m]."""
    return np.asarray(np.hypot(*(ends - chosen.end)[:, :2].T))


def estimate_noise_beside(
    ends: Array, yardstick: Array, chosen: Windows, horizon: float
) -> float:
    """Returns the noise [m] of a comparison of two predictions (W, 3) of the same ends."""
    difference = measure_end_distances(ends, chosen) - measure_end_distances(
        yardstick, chosen
    )
    # one of them diverges, so the ranking is clear
    if not np.isfinite(difference).all():
        return 0.0
    return estimate_comparison_noise(difference, chosen.start_t, horizon)


def average_end_errors(ends: Array, chosen: Windows) -> EndErrors:
    """Returns the mean errors of predicted ends (W, 3)."""
    apart = ends - chosen.end
    heading = np.abs(geometry.wrap_angle(apart[:, 2])).mean()
    return EndErrors(float(np.hypot(*apart[:, :2].T).mean()), float(heading))


def estimate_bands(
    model: TaylorModel,
    calibration: Calibration,
    training: Drive,
    derived: tuple[Samples, hypotheses.Base] | None = None,
    fixed: bool = False,
) -> dict[float, float]:
    """Returns the distances [m] within which 95 % of predictions are expected to end, by horizon.

    Each fold of the training part is predicted by the model adjusted to the others. `derived` are
    the samples of the training part, and the base that the model departed from. A
    `fixed` model is not adjusted, and predicts the whole part.
    """
    errors: dict[float, list[Array]] = {h: [] for h in hypotheses.BANDS_S}
    folds = [(training, training)] if fixed else training.folds(FOLDS)
    for _, part in folds:
        adjusted = model, calibration
        if derived is not None:
            begin, end = part.recording.pose.t[[0, -1]] + calibration.clock_offset_s
            kept = (derived[0].t < begin) | (derived[0].t > end)
            adjusted = _adjust_to_rows(model, calibration, training, *derived, kept)
        for horizon, parts in errors.items():
            parts.append(measure_distances(*adjusted, part, horizon))
    bands = {}
    for horizon, parts in errors.items():
        far = np.concatenate(parts)
        if len(far) >= FEWEST:
            bands[horizon] = float(np.percentile(far, WITHIN))
    return bands


def measure_distances(
    model: TaylorModel, calibration: Calibration, part: Drive, horizon: float
) -> Array:
    """Returns the distances (W,) [m] of all predictions over a horizon [s] in a part of a drive."""
    chosen = select_windows(part, calibration, 0.0, part.duration_s, horizon, SPACING_S)
    if not len(chosen.start_t):
        return np.zeros(0)
    return measure_end_distances(predict(model, calibration, part, chosen), chosen)


def _adjust_to_rows(
    model: TaylorModel,
    calibration: Calibration,
    training: Drive,
    samples: Samples,
    base: hypotheses.Base,
    kept: NDArray[np.bool_],
) -> tuple[TaylorModel, Calibration]:
    """Adjusts a model, and its inputs, to the rows that are kept (T,)."""
    draft = base.draft
    problem = make_prediction_problem(
        training, calibration, samples, draft.form, draft.parameters
    )
    problem = replace(problem, spacing_s=hypotheses.SPACING_S)
    free = draft.library.select_free(model)
    pull = hypotheses.PULLS[-1]
    fitted = shooting.fit_to_predictions(
        problem, model, free, draft.parameters, kept, EVALUATIONS, pull
    )
    calibration = replace(draft, problem=problem).calibrate(fitted, calibration)
    return replace(fitted.model, inputs=calibration.inputs), calibration
