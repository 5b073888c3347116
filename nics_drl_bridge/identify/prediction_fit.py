"""Fit of a model by what it predicts: from a textbook, to more effects and more terms.

It serves every drive that is not exact, whether its state is the motion, follows the commands, or
was measured (`terms.Kind`).

1. `fit_by_predictions` fits a base, the textbook, with the best-predicting form (delays, limits,
   drag, ...), cross-validates orders of terms beyond it, and fits the best by Eq. 1.
2. `refine_by_predictions` adjusts terms, delays, lags and mounting to predictions over seconds, and
   prunes the terms (Eq. 2) unless the state is the motion.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify import hypotheses, shooting, verdict
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import SEPARABLE_S
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import (
    Findings,
    require,
    require_fit,
    require_samples,
    resample_drive,
)
from nics_drl_bridge.identify.fit import ORDER
from nics_drl_bridge.identify.forms import Evidence
from nics_drl_bridge.identify.settings import Order
from nics_drl_bridge.identify.terms import (
    Kind,
    Library,
    drop_unused_terms,
    share_effects,
)
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

SHORT_S = 5.0  # a shorter drive can't tell the third and fourth order of a textbook
TOO_SHORT = (
    "The training part is too short to refine the model by its errors over seconds; record a "
    "longer drive."
)


def fit_by_predictions(drive: Drive, findings: Findings) -> Findings:
    """Fits the order that best predicts parts of the training part that its fits did not see."""
    training = findings.training
    order = drive.settings.order
    library = make_library(drive, findings)
    samples = resample_drive(training, findings)
    evidence = Evidence(training, findings.calibration, samples, library)
    try:
        base, trials = _fit_base(findings, evidence, order)
    except FitError as error:
        raise FitError(f"{drive.recording.source}: {error}") from None
    best = hypotheses.choose_trial(trials, order)
    curves = base.draft.form.make_curves(base.found.named)
    if library.kind is Kind.MOTION:
        calibration = replace(findings.calibration, inputs=curves)
        findings = replace(findings, calibration=calibration)
        samples = resample_drive(training, findings)
    else:
        samples = base.draft.select(None)
    fit = library.fit(samples, best.order or library.order)
    if drive.settings.strict:
        verdict.refuse_unexcited(fit.regression.excitation, drive.spec)
    return replace(
        findings,
        samples=samples,
        regression=fit.regression,
        pruned_fit=fit,
        model=replace(fit.model, inputs=curves),
        trials=trials,
        base=base,
    )


def _fit_base(
    findings: Findings, evidence: Evidence, order: Order
) -> tuple[hypotheses.Base, tuple[hypotheses.Trial, ...]]:
    """Fits the base, and tries orders of terms beyond it; a refit reuses both choices."""
    if findings.base is None:
        base = hypotheses.fit_base(evidence)
    else:
        base = hypotheses.refit_base(evidence, findings.base)
    asked = hypotheses.list_hypotheses(order, evidence.library)
    return base, findings.trials or base.draft.cross_validate(asked)


def make_library(drive: Drive, findings: Findings) -> Library:
    """Returns the terms that the model of a drive may have."""
    order = drive.settings.order
    if not drive.spec.state or findings.motion_width_s is not None:
        return Library(drive.spec, Kind.MOTION, True, 1.0, hypotheses.BASE_ORDER)
    kind = Kind.FOLLOWER if drive.recording.state is None else Kind.MEASURED
    centred = "lever_arm_y_m" in findings.calibration.uncertainty
    if order == "auto":
        is_short = findings.training.duration_s < SHORT_S
        order = ORDER if kind is Kind.MEASURED or is_short else MAX_ORDER
    return Library(drive.spec, kind, centred, drive.settings.alpha, order)


def refine_by_predictions(drive: Drive, findings: Findings) -> Findings:
    """Adjusts terms, delays and mounting to predictions over seconds."""
    order = drive.settings.order
    base = require(findings.base, "the base", "fit_terms")
    best = hypotheses.choose_trial(findings.trials, order)
    terms = require_fit(findings).model
    calibration = findings.calibration
    draft = base.draft
    found, has_order = _search_model(draft, base, terms, best)
    if draft.problem.is_mounted:
        certain = hypotheses.drop_doubtful_mounting(draft, calibration, found)
        if certain is not None:
            errors = hypotheses.add_predicted_mounting(calibration, found).uncertainty
            calibration = replace(calibration, uncertainty=errors)
            draft = certain
            found, has_order = _search_model(draft, base, terms, best)
    if draft.library.kind is not Kind.MOTION:
        found = draft.prune(found, drive.settings.alpha)
    before_s = draft.form.find_latency(found.named)
    calibration = draft.calibrate(found, calibration)
    draft = _start_calibrated(draft, found, before_s - calibration.command_latency_s)
    base = replace(base, draft=draft)
    if draft.library.kind is Kind.MOTION:
        calibration, sums = _separate_lags(base, calibration, drive.spec)
    else:
        calibration = _add_sums(calibration, found, draft)
        sums = ()
    model = draft.add_errors(found, terms)
    model = replace(model, inputs=calibration.inputs)
    model = share_effects(model, drive.spec, require_samples(findings))
    return replace(
        findings,
        calibration=calibration,
        model=drop_unused_terms(model),
        base=base,
        refinement=(
            _describe_refinement(draft.problem.longest_horizon_s),
            *sums,
            *hypotheses.describe_forms(base, findings.trials, order),
            *_list_unused_options(drive, draft.library, best.order, has_order),
        ),
    )


def _start_calibrated(
    draft: hypotheses.Draft, found: shooting.Predictive, latency_s: float
) -> hypotheses.Draft:
    """Returns a draft that starts from the values found, less what the calibration has of them.

    That is the mounting, and a part of the latency [s].
    """
    is_mounting = np.isin(found.names, hypotheses.MOUNTING)
    parameters = draft.problem.parameters
    parameters = replace(parameters, start=np.where(is_mounting, 0.0, found.values))
    parameters = parameters.shift_stamps(latency_s)
    return replace(draft, problem=replace(draft.problem, parameters=parameters))


def _add_sums(
    calibration: Calibration, found: shooting.Predictive, draft: hypotheses.Draft
) -> Calibration:
    """Adds the errors of sums of latency and lag, which are told where noise hides the parts."""
    errors = dict(calibration.uncertainty)
    if not errors.get("command_latency_s", 0.0) > SEPARABLE_S:
        return calibration
    names = list(found.names)
    for state, command in draft.form.followed:
        delay = f"{command}.delay"
        pair = [names.index(delay if delay in names else "latency")]
        pair.append(names.index(f"{state}.lag"))
        variance = float(found.value_covariance[np.ix_(pair, pair)].sum())
        errors[verdict.name_sum(state)] = float(np.sqrt(max(variance, 0.0)))
    return replace(calibration, uncertainty=errors)


def _search_model(
    draft: hypotheses.Draft,
    base: hypotheses.Base,
    terms: TaylorModel,
    best: hypotheses.Trial,
) -> tuple[shooting.Predictive, bool]:
    """Searches for the best-predicting model of the best order.

    The textbook's terms alone are kept if the search for more diverges. Also returns whether the
    model has the terms of the chosen order.

    Args:
        draft: the form of the model and its prediction problem.
        base: the fitted textbook, where the search starts.
        terms: the terms beyond the textbook's, as fitted by least squares.
        best: the chosen order.
    """
    if best.pull:
        refined = draft.refine(base.found.model, terms, pull=best.pull)
        errors = (
            draft.problem.measure_mean_error(fitted.model, fitted.values)
            for fitted in (refined, base.found)
        )
        if not verdict.is_worse(*errors):
            return refined, True
    textbook = draft.fit_base(other=base.found.model)
    return textbook, best.pull == 0.0


def _separate_lags(
    base: hypotheses.Base, calibration: Calibration, spec: RobotSpec
) -> tuple[Calibration, tuple[str, ...]]:
    """Drops the latency's error where lags hide it; returns a sentence on their sums instead."""
    form = base.draft.form
    curves = form.make_curves(base.found.named)
    lags = hypotheses.find_lags(replace(base.found.model, inputs=curves), spec)
    if not lags:
        return calibration, ()
    beside = form.find_latency(base.found.named)
    sums = hypotheses.describe_lag_sums(calibration.command_latency_s, lags, beside)
    errors = dict(calibration.uncertainty)
    errors.pop("command_latency_s", None)
    return replace(calibration, uncertainty=errors), (sums,)


def _describe_refinement(horizon_s: float) -> str:
    """States the longest horizon of the predictions [s]; 0 if none fitted into the drive."""
    if horizon_s == 0.0:
        return TOO_SHORT
    by = f"the open-loop errors over up to {horizon_s:g} s"
    return f"Coefficients and calibration were refined by {by}."


def _list_unused_options(
    drive: Drive, library: Library, order: int, has_order: bool
) -> Iterator[str]:
    """Yields a sentence per option that had no effect on the model."""
    settings = drive.settings
    if settings.alpha != "auto" and library.kind is Kind.MOTION:
        why = "where the state is the motion, or there is none, predictions weight the terms"
        yield f"alpha = {settings.alpha:g} was not used: {why}."
    if settings.order != "auto" and not has_order:
        off = f"more than {verdict.WORSE:g} times as far off as the textbook's, or diverge"
        why = f"predictions with its terms are {off}, so only the textbook's were kept"
        yield f"order = {order} was not used: {why}."
