"""Acceptance of a model: one of three words by stated thresholds, and the reasons for it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum, StrEnum

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors

JUDGED_S = 5.0  # horizon of the predictions by which a model is accepted


class Verdict(StrEnum):
    """What a model is fit for."""

    GOOD = "good"
    WITH_CARE = "usable with care"
    DO_NOT_TRAIN = "do not train"


@dataclass(frozen=True)
class Thresholds:
    """Limits of a verdict; errors are those of predictions over 5 s on data held out."""

    # A policy corrects its course ten times a second. It hardly notices a simulator that strays by
    # a tenth of the path in 5 s; the usual randomisation of gains and lags covers as much.
    good_error: float = 0.10  # share of the path
    # A robot that strays by a quarter of its path in 5 s is another robot: what a policy learns
    # there does not hold on the real one.
    worst_error: float = 0.25  # share of the path
    # 30 s hold six independent predictions of 5 s, so that a sound band of 95 % holds 80 % and
    # more on single drives.
    good_coverage: float = 0.80  # share of the ends within the 95 % band
    # A band that misses half of the ends says nothing about the model's errors: the part that was
    # held out is another motion than the part that was learnt.
    worst_coverage: float = 0.50  # share of the ends within the 95 % band
    # The noise of a comparison is the standard error of the mean difference between both errors on
    # the same windows: two models that are nearer to each other can't be ranked by this drive. A
    # wider margin would write models that are likely worse than a textbook of fewer values.
    standard_errors: float = 1.0
    # No policy learns otherwise from two simulators that differ by less.
    alike: float = 0.005  # share of the path
    # Of what the robot did while its pose was unknown nothing was learnt, and nothing was tested.
    most_unseen: float = 0.10  # share of the drive
    # In a shorter gap a robot goes on as before; predictions over 5 s bridge it.
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
    reasons: tuple[
        str, ...
    ]  # a sentence for each threshold that a good model keeps and this not


def usual(judgement: tuple[HorizonErrors, ...]) -> list[HorizonErrors]:
    """Returns the errors after 5 s, or the most that was held out; none if nothing was."""
    return [each for each in judgement if each.horizon_s <= JUDGED_S][-1:]


def comparison_noise(difference: Array, start_t: Array, horizon: float) -> float:
    """Returns the noise [m] of a mean difference (W,) between two errors on the same windows.

    That is its standard error, where all windows that start within one `horizon` [s] count as one
    observation, as they overlap; within one horizon alone, the standard deviation.
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
    """Ranks a model beside a yardstick, by the noise of the comparison [m]."""
    tie = max(THRESHOLDS.standard_errors * (noise_m or 0.0), THRESHOLDS.alike * path_m)
    difference = ours.position_m - theirs.position_m
    if not np.isfinite(ours.position_m) or difference > tie:
        return Outcome.WORSE
    return Outcome.BETTER if difference < -tie else Outcome.ALIKE


def loses_to_textbook(judgement: tuple[HorizonErrors, ...]) -> bool:
    """True if a model's predictions are worse than its fitted textbook's, beyond the noise."""
    return any(
        at.textbook is not None
        and compare(at.model, at.textbook, at.textbook_noise_m, at.path_m)
        is Outcome.WORSE
        for at in usual(judgement)
    )


def shortfall(judgement: tuple[HorizonErrors, ...]) -> Iterator[str]:
    """Says which yardsticks a model does not beat after 5 s, or the most that was held out."""
    for at in usual(judgement):
        yield from shortfall_of_textbook(at)
        yield from shortfall_of_twist(at)


def shortfall_of_textbook(at: HorizonErrors) -> Iterator[str]:
    """Says that predictions are worse than the fitted textbook's; one as good is no shortfall."""
    if at.textbook is None:
        return
    if compare(at.model, at.textbook, at.textbook_noise_m, at.path_m) is Outcome.WORSE:
        yield f"{_beside('the fitted textbook', at, at.textbook)}."


def shortfall_of_twist(at: HorizonErrors) -> Iterator[str]:
    """Says that predictions are no better than those of a robot that keeps its twist."""
    outcome = compare(at.model, at.kept_twist, at.kept_twist_noise_m, at.path_m)
    finding = _beside("a constant twist", at, at.kept_twist)
    if outcome is Outcome.WORSE:
        yield f"{finding}."
    if outcome is Outcome.ALIKE:
        yield f"{finding}, too near to be told apart: the commands explain little of this drive."


def _beside(name: str, at: HorizonErrors, errors: EndErrors) -> str:
    off = f"end {at.model.position_m:.3g} m off after {at.horizon_s:g} s"
    finding = f"The model does not beat {name}: on unseen data its predictions {off}"
    return f"{finding}, those of {name} {errors.position_m:.3g} m"


def relative_error(at: HorizonErrors, radius: float) -> float:
    """Returns an error as a share of the path, or of a robot's radius [m] if that is longer."""
    # A robot that turns on the spot has no path.
    return at.model.position_m / max(at.path_m, radius, 1e-9)


def rate(
    judgement: tuple[HorizonErrors, ...], radius: float, textbook: bool
) -> Assessment:
    """Rates predictions of a robot of a radius [m]; `textbook` if they are those of its textbook.

    Of a model that was never tried on unseen data nothing is known.
    """
    judged = usual(judgement)
    if not judged:
        return Assessment(Verdict.DO_NOT_TRAIN, ())
    (at,) = judged
    ratings = [_rate_error(at, radius), _rate_band(at), _rate_beside_twist(at)]
    ratings.append(_rate_beside_standing(at, radius))
    if not textbook and loses_to_textbook(judgement):
        ratings.append(
            Assessment(Verdict.DO_NOT_TRAIN, tuple(shortfall_of_textbook(at)))
        )
    return combined(ratings)


def combined(ratings: Iterable[Assessment]) -> Assessment:
    """Returns the least favourable verdict, with the reasons of all."""
    rated = tuple(ratings)
    verdict = max((each.verdict for each in rated), key=list(Verdict).index)
    return Assessment(
        verdict, tuple(reason for each in rated for reason in each.reasons)
    )


def rate_unseen(gap_s: float, duration_s: float) -> Assessment:
    """Rates the time without a pose [s] beside the duration of a drive [s]."""
    share = gap_s / max(duration_s, 1e-9)
    if share <= THRESHOLDS.most_unseen:
        return Assessment(Verdict.GOOD, ())
    finding = f"The pose is missing for {gap_s:.1f} s, {share:.0%} of the drive"
    limit = f"beyond {THRESHOLDS.most_unseen:.0%} too much of the motion was not seen"
    return Assessment(Verdict.WITH_CARE, (f"{finding}: {limit}.",))


def _rate_error(at: HorizonErrors, radius: float) -> Assessment:
    limits = THRESHOLDS
    share = relative_error(at, radius)
    if share <= limits.good_error:
        return Assessment(Verdict.GOOD, ())
    if not np.isfinite(share):
        return Assessment(Verdict.DO_NOT_TRAIN, ("Its predictions run away.",))
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
        verdicts.get(outcome, Verdict.DO_NOT_TRAIN), tuple(shortfall_of_twist(at))
    )


def _rate_beside_standing(at: HorizonErrors, radius: float) -> Assessment:
    """Rates predictions beside a robot that never moves, which noise alone makes a path of."""
    if at.standing is None or at.path_m <= radius:
        return Assessment(Verdict.GOOD, ())
    outcome = compare(at.model, at.standing, at.standing_noise_m, 0.0)
    if outcome is Outcome.BETTER:
        return Assessment(Verdict.GOOD, ())
    finding = _beside("a robot that never moves", at, at.standing)
    reason = f"{finding}: the pose does not follow these commands."
    return Assessment(Verdict.DO_NOT_TRAIN, (reason,))
