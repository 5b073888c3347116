"""Judgement of a model: predictions of unseen data beside those of yardsticks, and a verdict."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import hypotheses, shooting
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.forms import Evidence, make_prediction_problem
from nics_drl_bridge.identify.open_loop import (
    SPACING_S,
    Windows,
    predict,
    select_windows,
)
from nics_drl_bridge.identify.textbook import (
    Yardstick,
    estimate_twists_at,
    fit_yardstick,
    predict_kept_twist,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors, TaylorModel

JUDGED_S = 5.0  # horizon of the predictions that decide on a model
# ratio to the errors of a constant twist above which commands hardly help
HARDLY = 0.8
LONGEST_S = 1.0  # a longer latency is implausible
EARLIEST_S = -0.2  # a shorter one, too


class Verdict(str, Enum):
    """What a model is suitable for."""

    __str__ = str.__str__

    GOOD = "good"
    WITH_CARE = "usable with care"
    DO_NOT_TRAIN = "do not train"


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of a verdict; errors are those of predictions over 5 s on held-out data."""

    # A policy corrects its course ten times a second, so it hardly notices a simulator that strays
    # by a tenth of the path in 5 s; the usual randomisation of gains and lags covers as much.
    good_error: float = 0.10  # fraction of the path
    # A robot that strays by a quarter of its path in 5 s is a different robot: what a policy
    # learns there does not transfer to the real one.
    worst_error: float = 0.25  # fraction of the path
    # 30 s contain six independent predictions of 5 s, so a sound 95 % band covers at least 80 % on
    # a single drive.
    good_coverage: float = 0.80  # fraction of the end points within the 95 % band
    # A band that misses half of the ends says nothing about the model's errors: the held-out part
    # is a different kind of motion from the training part.
    worst_coverage: float = 0.50  # fraction of the end points within the 95 % band
    # The noise of a comparison is the standard error of the mean difference between both errors on
    # the same windows: this drive can't rank two models that are closer than that. A wider margin
    # would accept models that are probably worse than a textbook with fewer parameters.
    standard_errors: float = 1.0
    # A model that is farther off than its fitted textbook by this ratio has terms that do not pay,
    # even where the drive is too short to prove it.
    simpler: float = 1.02
    simpler_from: float = (
        0.0035  # by this fraction of the path at least; less changes no policy
    )
    # Two simulators that differ by less train the same policy.
    alike: float = 0.005  # fraction of the path
    # Motion while the pose was missing was neither learnt nor tested.
    most_unseen: float = 0.10  # fraction of the drive
    # Across a shorter gap the motion hardly changes; predictions over 5 s bridge it.
    shortest_unseen_s: float = 1.0


THRESHOLDS = Thresholds()


class Outcome(Enum):
    """Outcome of a comparison with a yardstick."""

    BETTER = 1
    ALIKE = 2
    WORSE = 3


@dataclass(frozen=True)
class Assessment:
    """A verdict and its reasons."""

    verdict: Verdict
    # a sentence for each threshold of a good model that this one misses
    reasons: tuple[str, ...]


def select_usual_horizon(judgement: tuple[HorizonErrors, ...]) -> list[HorizonErrors]:
    """Returns the errors after 5 s, or at the longest held-out horizon; empty if there is none."""
    return [at for at in judgement if at.horizon_s <= JUDGED_S][-1:]


def estimate_comparison_noise(
    difference: Array, start_t: Array, horizon: float
) -> float:
    """Returns the noise [m] of a mean difference (W,) between two errors on the same windows.

    This is its standard error, counting all windows that start within one `horizon` [s] as one
    observation, because they overlap; within a single horizon, it is the standard deviation.
    """
    cluster = np.floor((start_t - start_t.min()) / horizon).astype(np.intp)
    count = len(np.unique(cluster))
    rest = difference - difference.mean()
    if count < 2:
        return float(rest.std())
    sums = np.bincount(cluster, rest)
    return float(np.sqrt(count / (count - 1.0) * float(sums @ sums)) / len(difference))


def compare(
    ours: EndErrors, theirs: EndErrors, noise_m: float | None, path_m: float
) -> Outcome:
    """Ranks a model against a yardstick, given the noise of the comparison [m]."""
    tie = max(THRESHOLDS.standard_errors * (noise_m or 0.0), THRESHOLDS.alike * path_m)
    difference = ours.position_m - theirs.position_m
    if not np.isfinite(ours.position_m) or difference > tie:
        return Outcome.WORSE
    return Outcome.BETTER if difference < -tie else Outcome.ALIKE


def loses_to_textbook(judgement: tuple[HorizonErrors, ...]) -> bool:
    """True if a model's predictions are worse than its fitted textbook's, beyond the noise."""
    return any(
        next(describe_shortfall_of_textbook(at), "")
        for at in select_usual_horizon(judgement)
    )


def is_beaten_by_textbook(judgement: tuple[HorizonErrors, ...]) -> bool:
    """True if the fitted textbook, which is simpler, predicts better than a model."""
    for at in select_usual_horizon(judgement):
        if at.textbook is not None:
            textbook_m = at.textbook.position_m
            limit_m = max(
                THRESHOLDS.simpler * textbook_m,
                textbook_m + THRESHOLDS.simpler_from * at.path_m,
            )
            return not at.model.position_m <= limit_m
    return False


def describe_shortfall(judgement: tuple[HorizonErrors, ...]) -> Iterator[str]:
    """Yields the yardsticks that a model does not beat after 5 s, or at the longest horizon."""
    for at in select_usual_horizon(judgement):
        yield from describe_shortfall_of_textbook(at)
        yield from describe_shortfall_of_twist(at)


def describe_shortfall_of_textbook(at: HorizonErrors) -> Iterator[str]:
    """Yields a sentence if predictions are worse than the fitted textbook's; a tie is fine."""
    if at.textbook is None:
        return
    outcome = compare(at.model, at.textbook, at.textbook_noise_m, at.path_m)
    if outcome is Outcome.WORSE:
        yield f"{_describe_errors('the fitted textbook', at, at.textbook)}."


def describe_shortfall_of_twist(at: HorizonErrors) -> Iterator[str]:
    """Yields a sentence if predictions are no better than those of a constant twist."""
    outcome = compare(at.model, at.kept_twist, at.kept_twist_noise_m, at.path_m)
    finding = _describe_errors("a constant twist", at, at.kept_twist)
    if outcome is Outcome.WORSE:
        yield f"{finding}."
    if outcome is Outcome.ALIKE:
        yield f"{finding}, too close to distinguish: the commands explain little of this drive."


def _describe_errors(name: str, at: HorizonErrors, errors: EndErrors) -> str:
    off = f"end {at.model.position_m:.3g} m off after {at.horizon_s:g} s"
    finding = f"The model does not beat {name}: on unseen data its predictions {off}"
    return f"{finding}, those of {name} {errors.position_m:.3g} m"


def compute_relative_error(at: HorizonErrors, radius: float) -> float:
    """Returns an error as a fraction of the path, or of the robot's radius [m] if longer."""
    # A robot that turns in place has no path.
    return at.model.position_m / max(at.path_m, radius, 1e-9)


def rate(
    judgement: tuple[HorizonErrors, ...], radius: float, textbook: bool
) -> Assessment:
    """Rates predictions of a robot of a radius [m]; `textbook` if they are those of its textbook.

    A model that was never tried on unseen data gets no verdict on its errors.
    """
    judged = select_usual_horizon(judgement)
    if not judged:
        return Assessment(Verdict.DO_NOT_TRAIN, ())
    (at,) = judged
    ratings = [
        _rate_error(at, radius),
        _rate_band(at),
        _rate_beside_twist(at),
        _rate_beside_standing(at, radius),
    ]
    if not textbook and loses_to_textbook(judgement):
        reasons = tuple(describe_shortfall_of_textbook(at))
        ratings.append(Assessment(Verdict.DO_NOT_TRAIN, reasons))
    return combine_ratings(ratings)


def combine_ratings(ratings: Iterable[Assessment]) -> Assessment:
    """Returns the least favourable verdict, with the reasons of all."""
    verdicts = []
    reasons: list[str] = []
    for rating in ratings:
        verdicts.append(rating.verdict)
        reasons += rating.reasons
    return Assessment(max(verdicts, key=list(Verdict).index), tuple(reasons))


def rate_unseen(gap_s: float, duration_s: float) -> Assessment:
    """Rates the time without a pose [s] relative to the duration of a drive [s]."""
    share = gap_s / max(duration_s, 1e-9)
    if share <= THRESHOLDS.most_unseen:
        return Assessment(Verdict.GOOD, ())
    finding = f"The pose is missing for {gap_s:.1f} s, {share:.0%} of the drive"
    limit = f"beyond {THRESHOLDS.most_unseen:.0%} too much of the motion is missing"
    return Assessment(Verdict.WITH_CARE, (f"{finding}: {limit}.",))


def _rate_error(at: HorizonErrors, radius: float) -> Assessment:
    limits = THRESHOLDS
    share = compute_relative_error(at, radius)
    if share <= limits.good_error:
        return Assessment(Verdict.GOOD, ())
    if not np.isfinite(share):
        return Assessment(Verdict.DO_NOT_TRAIN, ("Its predictions diverge.",))
    far = f"After {at.horizon_s:g} s its predictions of unseen data end {share:.1%} of their path"
    if share <= limits.worst_error:
        reason = f"{far} away, those of a good model within {limits.good_error:.0%}."
        return Assessment(Verdict.WITH_CARE, (reason,))
    reason = f"{far} away, more than the {limits.worst_error:.0%} beyond which nothing is trained."
    return Assessment(Verdict.DO_NOT_TRAIN, (reason,))


def _rate_band(at: HorizonErrors) -> Assessment:
    limits = THRESHOLDS
    coverage = at.coverage
    if coverage is None or coverage >= limits.good_coverage:
        return Assessment(Verdict.GOOD, ())
    low = coverage < limits.worst_coverage
    limit = limits.worst_coverage if low else limits.good_coverage
    finding = f"The band that should hold 95 % of the ends holds {coverage:.0%} of the unseen ones"
    reason = f"{finding}, less than {limit:.0%}: errors are larger than the first part shows."
    return Assessment(Verdict.DO_NOT_TRAIN if low else Verdict.WITH_CARE, (reason,))


def _rate_beside_twist(at: HorizonErrors) -> Assessment:
    outcome = compare(at.model, at.kept_twist, at.kept_twist_noise_m, at.path_m)
    verdicts = {Outcome.BETTER: Verdict.GOOD, Outcome.ALIKE: Verdict.WITH_CARE}
    return Assessment(
        verdicts.get(outcome, Verdict.DO_NOT_TRAIN),
        tuple(describe_shortfall_of_twist(at)),
    )


def _rate_beside_standing(at: HorizonErrors, radius: float) -> Assessment:
    """Rates predictions against a robot that never moves, for which noise alone makes up a path."""
    if at.standing is None or at.path_m <= radius:
        return Assessment(Verdict.GOOD, ())
    outcome = compare(at.model, at.standing, at.standing_noise_m, 0.0)
    if outcome is Outcome.BETTER:
        return Assessment(Verdict.GOOD, ())
    finding = _describe_errors("a robot that never moves", at, at.standing)
    reason = f"{finding}: the pose does not follow these commands."
    return Assessment(Verdict.DO_NOT_TRAIN, (reason,))


def list_doubts_of_commands(
    judgement: Sequence[HorizonErrors], calibration: Calibration
) -> Iterator[str]:
    """Yields a sentence if the commands hardly help to predict, or take effect implausibly late."""
    for at in select_usual_horizon(tuple(judgement)):
        error = at.model.position_m
        without = at.kept_twist.position_m
        if HARDLY * without < error < without:
            ends = f"end {error:.3g} m off after {at.horizon_s:g} s, without them {without:.3g} m"
            yield (
                f"The commands hardly help: predictions by them {ends} (by a constant twist); "
                "check that `command:` names what was sent to the robot."
            )
    latency = calibration.command_latency_s
    if not EARLIEST_S <= latency <= LONGEST_S:
        yield (
            f"A latency of {latency:.2f} s between command and motion is implausible; check that "
            "`command:` names what was sent to the robot, and its `time:`."
        )


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
            kept = _select_rows_outside(derived[0], part, calibration)
            adjusted = _adjust_to_rows(model, calibration, training, *derived, kept)
        for horizon, parts in errors.items():
            parts.append(measure_distances(*adjusted, part, horizon))
    bands = {}
    for horizon, parts in errors.items():
        far = np.concatenate(parts)
        if len(far) >= FEWEST:
            bands[horizon] = float(np.percentile(far, WITHIN))
    return bands


def _select_rows_outside(
    samples: Samples, part: Drive, calibration: Calibration
) -> NDArray[np.bool_]:
    """Selects the samples (T,) outside a part of the drive."""
    begin, end = part.recording.pose.t[[0, -1]] + calibration.clock_offset_s
    return np.asarray((samples.t < begin) | (samples.t > end))


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
    evidence = Evidence(training, calibration, samples, draft.library)
    problem = make_prediction_problem(evidence, draft.form, draft.problem.parameters)
    problem = replace(problem, spacing_s=hypotheses.SPACING_S)
    free = draft.library.select_free(model)
    pull = hypotheses.PULLS[-1]
    fitted = shooting.fit_to_predictions(problem, model, free, kept, EVALUATIONS, pull)
    calibration = replace(draft, problem=problem).calibrate(fitted, calibration)
    return replace(fitted.model, inputs=calibration.inputs), calibration
