"""Fit of a robot whose state is its motion, derived from the poses: a textbook, and more terms.

1. `fit_motion` fits the textbook's terms with the best-predicting form (dead zones, drag, ...),
   cross-validates orders of terms beyond them, and fits the best order by least squares (Eq. 1).
2. `refine_motion` adjusts these terms, delays and mounting to predictions over seconds.
"""

from collections.abc import Iterator
from dataclasses import replace

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify import hypotheses, shooting, verdict
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import (
    Findings,
    require,
    require_fit,
    require_samples,
    resample_drive,
)
from nics_drl_bridge.identify.refine import TOO_SHORT
from nics_drl_bridge.identify.terms import fit_motion_terms, share_effects
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel


def fit_motion(drive: Drive, findings: Findings) -> Findings:
    """Fits the order that best predicts parts of the training part that its fits did not see."""
    training = findings.training
    spec = drive.spec
    order = drive.settings.order
    samples = resample_drive(training, findings)
    try:
        base = hypotheses.fit_base(
            training,
            findings.calibration,
            samples,
            findings.clear_curves,
            findings.base,
        )
        trials = findings.trials  # a refit reuses the choice
        trials = trials or base.draft.tried(hypotheses.list_hypotheses(order))
    except FitError as error:
        raise FitError(f"{drive.recording.source}: {error}") from None
    best = hypotheses.choose_trial(trials, order).order
    curves = base.draft.form.curves_at(base.draft.inputs, base.found.values)
    calibration = replace(findings.calibration, inputs=curves)
    findings = replace(findings, calibration=calibration)
    samples = resample_drive(training, findings)
    fit = fit_motion_terms(samples, spec, best or hypotheses.BASE_ORDER)
    if drive.settings.strict:
        verdict.refuse_unexcited(fit.regression.excitation, spec)
    return replace(
        findings,
        samples=samples,
        regression=fit.regression,
        pruned_fit=fit,
        model=replace(fit.model, inputs=curves),
        trials=trials,
        base=base,
    )


def refine_motion(drive: Drive, findings: Findings) -> Findings:
    """Adjusts terms, delays and mounting to predictions over seconds."""
    order = drive.settings.order
    base = require(findings.base, "the base", "fit_terms")
    best = hypotheses.choose_trial(findings.trials, order)
    terms = require_fit(findings).model
    calibration = findings.calibration
    draft = base.draft
    found, has_order = _search_model(draft, base, terms, best)
    if draft.problem.mounted:
        certain = hypotheses.drop_doubtful_mounting(draft, calibration, found)
        if certain is not None:
            errors = hypotheses.add_predicted_mounting(calibration, found).uncertainty
            calibration = replace(calibration, uncertainty=errors)
            draft = certain
            found, has_order = _search_model(draft, base, terms, best)
    calibration = _calibrate(draft, found, calibration)
    values = found.values.copy()
    if draft.problem.mounted:  # the calibration has the mounting now
        values[-3:] = 0.0
    draft = replace(draft, inputs=replace(draft.inputs, start=values))
    base = replace(base, draft=draft)
    calibration, sums = _separate_lags(base, calibration, drive.spec)
    model = replace(
        found.model,
        std_errors=hypotheses.estimate_coefficient_errors(found),
        inputs=calibration.inputs,
    )
    return replace(
        findings,
        calibration=calibration,
        model=share_effects(model, drive.spec, require_samples(findings)),
        base=base,
        refinement=(
            _describe_refinement(draft.problem.longest_horizon_s),
            *sums,
            *hypotheses.describe_forms(base, findings.trials, order),
            *_list_unused_options(drive, best.order, has_order),
        ),
    )


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
    if best.order:
        refined = draft.refined(base.found.model, terms, pull=best.pull)
        if not verdict.is_worse(draft.error_of(refined), draft.error_of(base.found)):
            return refined, True
    textbook = draft.base(other=base.found.model)
    return textbook, best.order == 0


def _calibrate(
    draft: hypotheses.Draft, found: shooting.Predictive, calibration: Calibration
) -> Calibration:
    """Returns a calibration with latency, input curves and mounting of a search."""
    values = found.values
    errors = found.named_errors(draft.inputs.names)
    calibration = replace(
        calibration,
        command_latency_s=draft.form.latency_at(draft.inputs, values),
        inputs=draft.form.curves_at(draft.inputs, values),
        uncertainty=calibration.uncertainty | errors,
    )
    if draft.problem.mounted:
        return hypotheses.add_predicted_mounting(calibration, found)
    return calibration


def _separate_lags(
    base: hypotheses.Base, calibration: Calibration, spec: RobotSpec
) -> tuple[Calibration, tuple[str, ...]]:
    """Drops the latency's error where lags hide it; returns a sentence on their sums instead."""
    draft = base.draft
    curves = draft.form.curves_at(draft.inputs, base.found.values)
    lags = hypotheses.find_lags(replace(base.found.model, inputs=curves), spec)
    if not lags:
        return calibration, ()
    beside = draft.form.latency_at(draft.inputs, base.found.values)
    sums = hypotheses.describe_lag_sums(calibration.command_latency_s, lags, beside)
    errors = dict(calibration.uncertainty)
    errors.pop("command_latency_s", None)
    return replace(calibration, uncertainty=errors), (sums,)


def _describe_refinement(horizon_s: float) -> str:
    """States the longest horizon of the predictions [s]; 0 if none fitted into the drive."""
    if horizon_s == 0.0:
        return TOO_SHORT
    by = f"the open-loop errors over up to {horizon_s:g} s"
    return f"Coefficients and latency were refined by {by}."


def _list_unused_options(drive: Drive, order: int, has_order: bool) -> Iterator[str]:
    """Yields a sentence per option that had no effect on the model."""
    settings = drive.settings
    if settings.alpha != "auto":
        why = "where the state is the motion, predictions of parts of the drive weight the terms"
        yield f"alpha = {settings.alpha:g} was not used: {why}."
    if settings.order != "auto" and not has_order:
        off = f"more than {verdict.WORSE:g} times as far off as the textbook's, or diverge"
        why = f"predictions with its terms are {off}, so only the textbook's were kept"
        yield f"order = {order} was not used: {why}."
