"""Identification of a model from a recording: the stages `STAGES`, run over a prepared drive."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import (
    acceptance,
    followers,
    hypotheses,
    open_loop,
    shooting,
    verdict,
)
from nics_drl_bridge.identify import clocks as timings
from nics_drl_bridge.identify import fit as fitting
from nics_drl_bridge.identify import motion as motions
from nics_drl_bridge.identify.acceptance import shortfall
from nics_drl_bridge.identify.assume import assume_textbook
from nics_drl_bridge.identify.by_recording import about_recordings
from nics_drl_bridge.identify.calibration import Calibration, Response, align
from nics_drl_bridge.identify.command_doubts import doubts_of_commands
from nics_drl_bridge.identify.drive import Drive, Settings
from nics_drl_bridge.identify.forms import (
    CLEAR,
    curve_of,
    likely_delay,
    list_driving_commands,
    reached,
)
from nics_drl_bridge.identify.gyro import turned_by_gyro
from nics_drl_bridge.identify.judgement import (
    bands_of,
    bands_of_fixed,
    judged,
    textbook_of,
)
from nics_drl_bridge.identify.mounting import Mounting, mounted, mounting_of
from nics_drl_bridge.identify.noise import motion_noise, sensor_noise
from nics_drl_bridge.identify.refine import TOO_SHORT, refined
from nics_drl_bridge.identify.repair import (
    check_axes,
    check_commands,
    check_encoders,
    check_pose_moves,
    check_units,
    repaired,
)
from nics_drl_bridge.identify.signals import speed_index
from nics_drl_bridge.identify.terms import linear_fit, shared, through_state
from nics_drl_bridge.identify.textbook_model import (
    actuated_spec,
    needs_actuators,
    textbook_calibration,
    textbook_model,
    with_actuators,
)
from nics_drl_bridge.identify.yardstick import Yardstick, fit_yardstick
from nics_drl_bridge.recording.joining import LEARNT_SHARE
from nics_drl_bridge.recording.recording import Recording, Samples, Stream, check
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import HorizonErrors, TaylorModel
from nics_drl_bridge.threads import one_blas_thread

T = TypeVar("T")

# orders that `auto` chooses from if the state follows commands
ORDERS_OF_INFERRED = (2, 3, 4)


@dataclass(frozen=True)
class Findings:
    """Findings of the stages in order; None or empty before they have run, or if not learnable."""

    training: Drive  # the training part of the drive, repaired by `repair`
    whole: Drive  # the whole drive, repaired by `repair`
    timing: timings.TimingEstimate  # of `clocks`; nominal before
    repairs: tuple[str, ...] = ()  # sentences from `repair`
    # (n,) expected over the training part's twists, from `mounting`
    speed: Array | None = None
    mounting: Mounting | None = None  # from `mounting`
    # From `clocks`, `mounting`, `responses` and `noise`; then from `refine`.
    calibration: Calibration = field(default_factory=Calibration)
    # the pose sensor's from `noise`; the rest from `judge`
    noise: Noise = field(default_factory=Noise)
    # from `motion`: half-width [s] of the parabolas that gave the state; None if it was not derived
    width: float | None = None
    samples: Samples | None = None  # of the training part on one time axis, from `fit`
    clear: tuple[InputCurve, ...] = ()  # input curves beyond doubt, from `inputs`
    base: hypotheses.Base | None = None  # of the textbook's terms, from `fit`
    # of orders, on parts of the training part, from `fit`
    trials: tuple[hypotheses.Trial, ...] = ()
    regression: fitting.Regression | None = None  # on all features (Eq. 1), from `fit`
    linear: fitting.Fit | None = None  # the pruned fit (Eq. 2), from `prune`
    model: TaylorModel | None = None  # from `prune`; then from `refine` and `complete`
    refinement: tuple[str, ...] = ()  # sentences from `refine`
    assumptions: tuple[str, ...] = ()  # sentences from `complete`
    unseen: Samples | None = None  # of the part that the fit did not see, from `judge`
    # open-loop errors on that part, from `judge`
    held_out: open_loop.OpenLoop | None = None
    # on that part, compared with yardsticks, from `judge`
    judgement: tuple[HorizonErrors, ...] = ()
    # the textbook fitted to the training part, from `judge`
    yardstick: Yardstick | None = None
    # sentence on the model that the textbook replaced, from `settle`
    replaced: str = ""
    notes: tuple[str, ...] = ()  # all sentences, from `judge`
    # on all data, from `refit`; None if the trial's model is kept
    refit: "Findings | None" = None


Stage = Callable[[Drive, Findings], Findings]


class StageOrderError(RuntimeError):
    """A stage needs what a stage after it, or a missing one, finds: a fault of the program."""


def known(found: T | None, name: str, stage: str) -> T:
    """Returns a finding that a later stage needs. Raises StageOrderError if it is missing."""
    if found is None:
        raise StageOrderError(
            f"{name} is missing; put the stage {stage!r} before those that need it."
        )
    return found


def _fitted(findings: Findings) -> tuple[fitting.Fit, TaylorModel]:
    name = "the pruned fit"
    return known(findings.linear, name, "prune"), known(findings.model, name, "prune")


def repair(drive: Drive, findings: Findings) -> Findings:
    """Refuses other units, axes and orders; drops repeated rows and jumps, clips commands."""
    check_pose_moves(findings.training)
    training, _ = repaired(findings.training)
    whole, repairs = repaired(findings.whole)
    repairs += check_commands(training, findings.training.recording.command)
    check_units(drive)
    check_axes(training)
    repairs += check_encoders(training)
    check(training.recording, drive.spec)
    return replace(findings, training=training, whole=whole, repairs=repairs)


def clocks(drive: Drive, findings: Findings) -> Findings:
    """Finds the period of bursts, the clock offset, the latency of commands, and lags."""
    training = findings.training
    spec = drive.spec
    timings.check_state_is_known(drive.recording, spec)
    derived = motions.by_motion(spec, drive.recording)
    followed = replace(training, spec=motions.surrogate(spec)) if derived else training
    found = timings.timing_of(followed)
    if not derived:
        found = followers.apart(training, found)
    responses: tuple[Response, ...] = ()
    if derived:
        responses, found = _select_followers(spec, found)
    calibration = replace(
        findings.calibration,
        responses=responses,
        uncertainty=found.sigma,
        inputs=followers.late_inputs(spec, found),
        limits=followers.limits_of(spec, found),
        clock_offset_s=found.offset,
        command_latency_s=found.latency,
        burst_period_s=training.bursts.period_s if training.bursts else 0.0,
    )
    return replace(findings, timing=found, calibration=calibration)


def _select_followers(
    spec: RobotSpec, timing: timings.TimingEstimate
) -> tuple[tuple[Response, ...], timings.TimingEstimate]:
    """Returns the states that follow a command, with their lags, from the lag of each command.

    The timing that is returned has the lags of these states alone, in their order.
    """
    names = [c.name for c in spec.command]
    states = [v for v in spec.state if v.follows and v.twist is None]
    rows = [names.index(str(v.follows)) for v in states]
    own = replace(timing, lags=timing.lags[rows], lag_sigma=timing.lag_sigma[rows])
    responses = (
        Response(v.name, str(v.follows), float(lag))
        for v, lag in zip(states, own.lags, strict=True)
    )
    return tuple(responses), own


def mounting(drive: Drive, findings: Findings) -> Findings:
    """Finds where and how the tracked body is mounted on the robot."""
    training = findings.training
    states = None
    place = speed_index(drive.spec)
    if drive.spec.state and not motions.by_motion(drive.spec, drive.recording):
        states = timings.expected_states(training, training.twists, findings.timing)
    found = mounting_of(training, findings.timing, states)
    speed = None if states is None or place is None else states[:, place]
    calibration = mounted(findings.calibration, found)
    return replace(findings, speed=speed, mounting=found, calibration=calibration)


def responses(drive: Drive, findings: Findings) -> Findings:
    """Finds how unmeasured states follow the commands, and the scale of the wheels."""
    training = findings.training
    calibration = findings.calibration
    found = calibration.responses
    if not motions.by_motion(drive.spec, drive.recording):
        found = timings.responses_of(
            training, calibration, findings.timing, findings.speed
        )
    calibration = timings.with_wheels(training, replace(calibration, responses=found))
    return replace(findings, calibration=calibration)


def noise(drive: Drive, findings: Findings) -> Findings:
    """Measures the noise of the pose; a drive without noise and corrections is treated as exact."""
    position, heading = findings.training.pose_noise or (0.0, 0.0)
    noisy = replace(
        findings.calibration, position_noise_m=position, heading_noise_rad=heading
    )
    return replace(findings, calibration=noisy, noise=sensor_noise(findings.whole))


def motion(drive: Drive, findings: Findings) -> Findings:
    """Derives the state from the poses, if it is an unmeasured part of the twist."""
    if not motions.by_motion(drive.spec, drive.recording):
        return findings
    calibration = findings.calibration
    width = motions.half_width(findings.training)
    parts = []
    for part in (findings.training, findings.whole):
        grid = motions.grid_of(part, calibration, drive.settings.control_period_s)
        parts.append(motions.with_motion(part, calibration, grid, width))
    return replace(findings, training=parts[0], whole=parts[1], width=width)


def aligned(drive: Drive, findings: Findings) -> Samples:
    """Resamples a drive on one time axis, using the findings."""
    if findings.width is None:
        return align(drive, findings.calibration)
    return motions.samples_of(drive, findings.calibration, findings.width)


def inputs(drive: Drive, findings: Findings) -> Findings:
    """Finds the latency, and the dead zones and saturation of commands, that explain a motion."""
    if findings.width is None:
        return findings
    training = findings.training
    samples = aligned(findings.training, findings)
    findings = _with_delay(findings, samples)
    samples = aligned(training, findings)
    places = range(len(drive.spec.command))
    curves = [
        c for place in places if (c := curve_of(samples, drive.spec, place)) is not None
    ]
    calibration = replace(findings.calibration, inputs=tuple(c.curve for c in curves))
    clear = tuple(c.curve for c in curves if c.gain >= CLEAR)
    findings = replace(findings, calibration=calibration, clear=clear)
    return _with_delay(findings, aligned(training, findings))


def _with_delay(findings: Findings, samples: Samples) -> Findings:
    delay = likely_delay(findings.training, findings.calibration, samples)
    return replace(
        findings, calibration=replace(findings.calibration, command_latency_s=delay)
    )


def _fit_of_motion(drive: Drive, findings: Findings) -> Findings:
    """Fits the order that best predicts parts of the training data that its fits did not see."""
    training = findings.training
    spec = drive.spec
    order = drive.settings.order
    samples = aligned(training, findings)
    try:
        base = hypotheses.base_of(
            training, findings.calibration, samples, findings.clear, findings.base
        )
        trials = findings.trials  # a refit reuses the choice
        trials = trials or base.draft.tried(hypotheses.hypotheses(order))
    except FitError as error:
        raise FitError(f"{drive.recording.source}: {error}") from None
    best = hypotheses.chosen(trials, order).order
    curves = base.draft.form.curves_at(base.draft.inputs, base.found.values)
    findings = replace(
        findings, calibration=replace(findings.calibration, inputs=curves)
    )
    samples = aligned(training, findings)
    linear = linear_fit(samples, spec, best or hypotheses.BASE_ORDER)
    if drive.settings.strict:
        verdict.refuse_unexcited(linear.regression.excitation, spec)
    return replace(
        findings,
        samples=samples,
        regression=linear.regression,
        linear=linear,
        model=replace(linear.model, inputs=curves),
        trials=trials,
        base=base,
    )


def fit(drive: Drive, findings: Findings) -> Findings:
    """Resamples the streams on one time axis, and fits all terms by least squares (Eq. 1)."""
    if findings.width is not None:
        return _fit_of_motion(drive, findings)
    calibration = findings.calibration
    spec = drive.spec
    settings = drive.settings
    if spec.state and drive.recording.state is None:
        known(calibration.responses or None, "the response of each state", "responses")
    samples = align(findings.training, calibration)
    trials = findings.trials
    samples = followers.unlimited(samples, calibration, spec)
    inferred = drive.recording.state is None and not calibration.is_exact
    # a refit reuses the trials
    if settings.order == "auto" and inferred and not trials:
        trials = _trials_of_orders(drive, findings)
    order = fitting.ORDER if settings.order == "auto" else settings.order
    order = hypotheses.chosen(list(trials)).order if trials else order
    centred = "lever_arm_y_m" in calibration.uncertainty
    library = partial(through_state, centred=centred) if inferred else None
    try:
        regression = fitting.regress(
            samples, spec, order, not calibration.is_exact, library
        )
    except FitError as error:
        raise FitError(f"{drive.recording.source}: {error}") from None
    if settings.strict:
        verdict.refuse_unexcited(regression.excitation, spec)
    return replace(findings, samples=samples, regression=regression, trials=trials)


def _trials_of_orders(drive: Drive, findings: Findings) -> tuple[hypotheses.Trial, ...]:
    """Tries each order on parts of the training data that its fits did not see."""
    training = findings.training
    trials = []
    span = 0.0, training.duration_s, hypotheses.HORIZON_S, open_loop.SPACING_S
    path = open_loop.windows(training, findings.calibration, *span).path
    for order in ORDERS_OF_INFERRED:
        errors = _left_out(drive, findings, order)
        if hypotheses.HORIZON_S not in errors:
            break
        share = float(
            errors[hypotheses.HORIZON_S].mean() / max(float(path.mean()), 1e-9)
        )
        trials.append(hypotheses.Trial(order, 0.0, share, errors))
    return tuple(trials)


def prune(drive: Drive, findings: Findings) -> Findings:
    """Keeps the terms of Eq. 2, and refits them."""
    regression = known(findings.regression, "the fit of all terms", "fit")
    # keeps what mirror symmetry allows, because predictions weight these terms
    if findings.width is not None:
        return findings
    linear = fitting.pruned(regression, drive.spec, drive.settings.alpha)
    limits = followers.scaled_limits(findings.calibration, drive.spec)
    model = replace(linear.model, inputs=findings.calibration.inputs, limits=limits)
    return replace(findings, linear=replace(linear, model=model), model=model)


def refine(drive: Drive, findings: Findings) -> Findings:
    """Adjusts model and calibration to predictions over seconds, unless the drive is exact."""
    _, model = _fitted(findings)
    if findings.width is not None:
        return _refined_motion(drive, findings)
    if findings.calibration.is_exact:
        return findings
    tried = verdict.tried(model, findings.calibration, findings.training, 0.0)
    if (
        drive.settings.order == "auto"
        and not findings.trials
        and verdict.ran_away(tried)
    ):
        linear = replace(drive, settings=replace(drive.settings, order=1))
        found = run((fit, prune, refine), linear, findings)
        return replace(found, refinement=(*found.refinement, verdict.LINEAR))
    model, calibration, note = refined(model, findings.calibration, findings.training)
    sentences = (note, *hypotheses.about_orders(findings.trials))
    return replace(findings, model=model, calibration=calibration, refinement=sentences)


def _refined_motion(drive: Drive, findings: Findings) -> Findings:
    linear, _ = _fitted(findings)
    calibration = findings.calibration
    spec = drive.spec
    base = known(findings.base, "the base", "fit")
    best = hypotheses.chosen(findings.trials, drive.settings.order)
    draft = base.draft
    book = base.found.model

    def refined_by(draft: hypotheses.Draft) -> tuple[shooting.Predictive, bool]:
        if best.order:
            found = draft.refined(book, linear.model, pull=best.pull)
        else:
            found = None
        if found is None or verdict.is_worse(
            draft.error_of(found), draft.error_of(base.found)
        ):
            return draft.base(other=book), best.order == 0  # the search may diverge
        return found, True

    found, kept_order = refined_by(draft)
    if draft.problem.mounted:
        certain = hypotheses.with_certain_mounting(draft, calibration, found)
        if certain is not None:
            sigmas = hypotheses.remounted(calibration, found).uncertainty
            calibration = replace(calibration, uncertainty=sigmas)
            draft = certain
            found, kept_order = refined_by(certain)
    calibration = replace(
        calibration,
        command_latency_s=draft.form.latency_at(draft.inputs, found.values),
        inputs=draft.form.curves_at(draft.inputs, found.values),
        uncertainty=calibration.uncertainty | found.named_errors(draft.inputs.names),
    )
    values = found.values.copy()
    if draft.problem.mounted:
        calibration = hypotheses.remounted(calibration, found)
        values[-3:] = 0.0
    base = replace(
        base, draft=replace(draft, inputs=replace(draft.inputs, start=values))
    )
    curves = draft.form.curves_at(draft.inputs, base.found.values)
    lags = hypotheses.lags_of(replace(base.found.model, inputs=curves), spec)
    sums: tuple[str, ...] = ()
    if lags:
        beside = draft.form.latency_at(draft.inputs, base.found.values)
        sums = (hypotheses.about_lags(calibration.command_latency_s, lags, beside),)
        told = {
            n: e for n, e in calibration.uncertainty.items() if n != "command_latency_s"
        }
        calibration = replace(calibration, uncertainty=told)
    errors = hypotheses.standard_errors(found)
    model = replace(found.model, std_errors=errors, inputs=calibration.inputs)
    model = shared(model, spec, known(findings.samples, "the training part", "fit"))
    return replace(
        findings,
        calibration=calibration,
        model=model,
        base=base,
        refinement=(
            _about_refinement(draft.problem.longest_horizon_s),
            *sums,
            *hypotheses.about_forms(base, findings.trials, drive.settings.order),
            *about_options(drive, best.order, kept_order),
        ),
    )


def _about_refinement(horizon_s: float) -> str:
    """States the longest horizon of a motion's refinement [s]; 0 if none fitted into the drive."""
    if horizon_s == 0.0:
        return TOO_SHORT
    by = f"the open-loop errors over up to {horizon_s:g} s"
    return f"Coefficients and latency were refined by {by}."


def about_options(drive: Drive, order: int, kept_order: bool) -> Iterator[str]:
    """Yields the options that had no effect on a model whose state is the motion."""
    settings = drive.settings
    if settings.alpha != "auto":
        why = "where the state is the motion, predictions of parts of the drive weight the terms"
        yield f"alpha = {settings.alpha:g} was not used: {why}."
    if settings.order != "auto" and not kept_order:
        off = f"more than {verdict.WORSE:g} times as far off as the textbook's, or diverge"
        why = f"predictions with its terms are {off}, so only the textbook's were kept"
        yield f"order = {order} was not used: {why}."


def complete(drive: Drive, findings: Findings) -> Findings:
    """Completes the model by the textbook for inputs that never moved, if requested."""
    if not drive.settings.assume:
        return findings
    linear, model = _fitted(findings)
    model, assumptions = assume_textbook(model, drive.spec, linear.unmoved)
    return replace(findings, model=model, assumptions=assumptions)


def judge(drive: Drive, findings: Findings) -> Findings:
    """Tests the model on unseen data, measures what it leaves unexplained, and lists doubts."""
    linear, model = _fitted(findings)
    spec = drive.spec
    whole = findings.whole
    calibration = findings.calibration
    samples = aligned(whole, findings)
    begin = (
        whole.recording.pose.t[0]
        + calibration.clock_offset_s
        + drive.settings.train_until_s
    )
    rest = samples.rows(samples.t > begin)
    unseen = rest if len(rest.t) >= verdict.MIN_ROWS else None
    held_out = verdict.tried(model, calibration, whole, drive.settings.train_until_s)
    bands: dict[float, float] = {}
    yardstick = findings.yardstick or textbook_of(whole, calibration)
    if findings.replaced:
        bands = bands_of_fixed(model, calibration, findings.training)
    elif not calibration.is_exact and drive.duration_s > drive.settings.train_until_s:
        derived = None
        if findings.base is not None:
            derived = aligned(findings.training, findings), findings.base
        bands = bands_of(model, calibration, findings.training, derived)
    judgement = judged(model, calibration, whole, bands, yardstick)
    rated = verdict.with_quality(model, linear, unseen, held_out, judgement, spec)
    findings = replace(
        findings,
        model=rated,
        unseen=unseen,
        held_out=held_out,
        judgement=judgement,
        yardstick=yardstick,
        calibration=replace(calibration, notes=_plain(findings)),
        noise=motion_noise(findings.noise, whole, calibration, model, samples),
        linear=replace(linear, model=rated) if model is linear.model else linear,
    )
    return replace(findings, notes=_notes(drive, findings))


def _with_actuators(
    drive: Drive, findings: Findings, yardstick: Yardstick
) -> tuple[Drive, Findings]:
    """Returns a drive of a steered robot, and its findings, with speed and angle as state."""
    calibration = findings.calibration
    spec = actuated_spec(yardstick, findings.whole)
    parts = [
        with_actuators(part, spec, yardstick, calibration)
        for part in (findings.training, findings.whole)
    ]
    actuated = replace(findings, training=parts[0], whole=parts[1], width=None)
    return replace(drive, spec=spec), actuated


def settle(drive: Drive, findings: Findings) -> Findings:
    """Replaces a model by the fitted textbook if that predicts unseen data better."""
    if findings.yardstick is None or not acceptance.loses_to_textbook(
        findings.judgement
    ):
        return findings
    _, model = _fitted(findings)
    spec = drive.spec
    until = drive.settings.train_until_s
    start_spec = spec
    try:
        yardstick = fit_yardstick(
            findings.whole, until, findings.calibration.clock_offset_s, one_limit=True
        )
        calibration = textbook_calibration(yardstick, findings.calibration, spec)
        start = motion(drive, replace(findings, calibration=calibration))
        if needs_actuators(yardstick, spec):
            drive, start = _with_actuators(drive, start, yardstick)
            spec = drive.spec
        samples = aligned(start.training, start)
        if spec is not start_spec:  # these figures are of another state's rates
            linear = fitting.fit(samples, spec, noisy=True)
            start = replace(start, regression=linear.regression, linear=linear)
        book = textbook_model(yardstick, model, samples, spec)
        if book is None:
            return findings
        (lost,) = acceptance.usual(findings.judgement)
        tried = replace(
            start,
            model=book,
            samples=samples,
            refinement=(),
            trials=(),
            assumptions=(),
            replaced=verdict.replaced_by_textbook(lost),
        )
        tried = judge(drive, tried)
    except (FitError, RecordingError):
        return findings
    won = acceptance.usual(tried.judgement)
    if won and won[0].model.position_m < lost.model.position_m:
        return tried
    return findings


def _notes(drive: Drive, findings: Findings) -> tuple[str, ...]:
    """Collects all sentences on a model, the most serious first."""
    linear, _ = _fitted(findings)
    spec = drive.spec
    calibration = findings.calibration
    beaten = [findings.replaced]
    if not findings.replaced:
        beaten = list(shortfall(findings.judgement))
    return (
        *about_recordings(_fitted(findings)[1], calibration, findings.whole),
        *beaten,
        *_why_replaced(drive, findings),
        *drive.recording.repairs,
        *findings.repairs,
        *verdict.about_gaps(findings.whole),
        *_sentences(findings),
        *findings.refinement,
        *verdict.mirror_note(
            known(findings.samples, "the training part", "fit"), spec, calibration
        ),
        *verdict.unlearnt(
            linear,
            calibration,
            spec,
            verdict.levels_of(findings.training.recording.command, spec),
        ),
        *(
            verdict.doubts_of_fit(linear, calibration.is_exact)
            if findings.width is None
            else ()
        ),
        *verdict.untried(drive, findings.held_out, findings.judgement),
        *findings.assumptions,
    )


def _why_replaced(drive: Drive, findings: Findings) -> Iterator[str]:
    """Yields a sentence if a coarse sampling rate explains why a model lost to its textbook."""
    if not findings.replaced or drive.recording.state is None:
        return
    linear, _ = _fitted(findings)
    whole = findings.whole
    if coarse := verdict.coarsest_state(whole.recording, whole.spec, linear.unmoved):
        yield verdict.Gap(f"{coarse}.")


def _left_out(drive: Drive, findings: Findings, order: int) -> dict[float, Array]:
    """Returns errors (W,) of an order by horizon [s], on parts that its fits did not see."""
    training = findings.training
    pose = training.recording.pose
    settings = replace(drive.settings, order=order, train_until_s=np.inf)
    errors: dict[float, list[Array]] = {h: [] for h in hypotheses.BANDS_S}
    for block in np.array_split(np.arange(len(pose.t)), hypotheses.FOLDS):
        others = np.ones(len(pose.t), dtype=np.bool_)
        others[block] = False
        rest = training.part(replace(training.recording, pose=pose.rows(others))).under(
            settings
        )
        try:
            found = run((fit, prune, refine), rest, replace(findings, training=rest))
        except (FitError, RecordingError):
            return {}
        part = training.part(replace(training.recording, pose=pose.rows(block)))
        for horizon, errors_at in errors.items():
            chosen = open_loop.windows(
                part,
                found.calibration,
                0.0,
                part.duration_s,
                horizon,
                open_loop.SPACING_S,
            )
            if len(chosen.start_t):
                ends = open_loop.predict(
                    _fitted(found)[1], found.calibration, part, chosen
                )
                far = np.hypot(*(ends - chosen.end)[:, :2].T)
                errors_at.append(np.where(np.isnan(far), np.inf, far))
    return {h: np.concatenate(each) for h, each in errors.items() if each}


def refit(drive: Drive, findings: Findings) -> Findings:
    """Refits the judged model to all data, unless it then predicts the training part worse."""
    until = drive.settings.train_until_s
    if findings.calibration.is_exact or until >= drive.duration_s or findings.replaced:
        return findings
    settings = replace(drive.settings, train_until_s=np.inf)
    try:
        start = replace(findings, training=findings.whole.under(settings))
        stages = (motion, fit, prune, refine, complete)
        final = run(stages, replace(drive, settings=settings), start)
        error, before = (
            open_loop.open_loop_error(
                _fitted(each)[1], each.calibration, each.whole, 0.0, until
            )
            for each in (final, findings)
        )
        worse = verdict.is_worse(
            error.mean_position_error_m, before.mean_position_error_m
        )
    except (FitError, RecordingError):
        worse = True
    driven = drive.recording.driven_s
    sentence = verdict.refitted(driven(until), driven(), worse)
    if worse:
        findings = replace(findings, refinement=(*findings.refinement, sentence))
        return replace(findings, notes=_notes(drive, findings))
    final = replace(
        final,
        refinement=(*final.refinement, sentence),
        calibration=replace(final.calibration, notes=_plain(final)),
        model=replace(_fitted(final)[1], quality=_fitted(findings)[1].quality),
    )
    return replace(findings, refit=replace(final, notes=_notes(drive, final)))


def _plain(found: Findings) -> tuple[str, ...]:
    # plain strings for a file, which has no kinds of sentences
    return tuple(map(str, _sentences(found)))


def _sentences(found: Findings) -> tuple[str, ...]:
    drive = found.training
    calibration = found.calibration
    if found.replaced:  # latency, lags and mounting are those of the fitted textbook
        timed = replace(calibration, command_latency_s=found.timing.latency)
        return (
            *verdict.about_stamps(drive),
            *verdict.about_clocks(drive, timed, found.timing),
        )
    return (
        *verdict.about_stamps(drive),
        *verdict.about_clocks(drive, calibration, found.timing),
        *followers.about_sums(calibration),
        *verdict.about_mounting(drive, calibration, found.mounting),
        *verdict.about_responses(drive, calibration, found.timing),
    )


STAGES: tuple[Stage, ...] = (
    repair,
    clocks,
    mounting,
    responses,
    noise,
    motion,
    inputs,
    fit,
    prune,
    refine,
    complete,
    judge,
    settle,
    refit,
)
"""In order; each uses the findings of those before it."""


def begun(drive: Drive) -> Findings:
    """Returns the findings on a drive before the first stage."""
    training = drive.part(cut(drive.recording, drive.settings.train_until_s))
    return Findings(training, drive, timings.nominal_timing(training))


def run(
    stages: Sequence[Stage], drive: Drive, findings: Findings | None = None
) -> Findings:
    """Runs stages over a drive, starting from given findings, and returns their findings."""
    findings = findings or begun(drive)
    for stage in stages:
        findings = stage(drive, findings)
    return findings


@dataclass(frozen=True)
class Identified:
    """Result of an identification: a model of all data, and the results of its trial.

    The trial learnt only the first part of the drive, and was judged on the rest.
    """

    drive: Drive  # the whole drive, repaired
    # refined and, if requested, completed; with standard errors and quality
    model: TaylorModel
    calibration: Calibration
    fit: fitting.Fit  # the linear fit, before refinement
    samples: Samples  # used by the fit
    # of the part that the trial did not see; None if there are too few
    unseen: Samples | None
    # its open-loop errors there; None if the part was too short
    held_out: open_loop.OpenLoop | None
    noise: Noise  # of sensors and motion, each level measured or assumed
    findings: Findings  # findings of all stages on the trial
    # sentences on findings, on what was not learnt, and on assumptions
    notes: tuple[str, ...]

    @property
    def trial(self) -> "Identified":
        """The result of the trial: the model that was judged on data it never saw."""
        return _result(self.findings, self.findings)

    @property
    def recording(self) -> Recording:
        """The whole recording, repaired."""
        return self.drive.recording

    @property
    def gaps(self) -> tuple[str, ...]:
        """The notes on what the drive could not teach."""
        return tuple(str(note) for note in self.notes if isinstance(note, verdict.Gap))

    @property
    def train_until_s(self) -> float:
        """End of the training part, from the drive's first pose [s]."""
        return self.drive.settings.train_until_s

    @property
    def coverage(self) -> dict[float, float]:
        """Fraction of held-out ends within the 95 % band of predictions, by horizon [s]."""
        return {
            e.horizon_s: e.coverage for e in self.judgement if e.coverage is not None
        }

    @property
    def judgement(self) -> tuple[HorizonErrors, ...]:
        """Errors on held-out data, compared with those of yardsticks, by horizon."""
        return self.findings.judgement

    @property
    def assessment(self) -> acceptance.Assessment:
        """What the model is suitable for, and the reasons."""
        spec = self.drive.spec
        findings = self.findings
        mistaken = any(isinstance(note, verdict.Mistake) for note in self.notes)
        unfit = mistaken or bool(verdict.missed(self.fit, spec))
        textbook = bool(findings.replaced)
        ratings = [
            acceptance.rate(self.judgement, spec.footprint_radius, textbook),
            acceptance.rate_unseen(
                verdict.time_without_pose(self.drive), self.drive.duration_s
            ),
        ]
        if unfit:
            ratings.append(acceptance.Assessment(acceptance.Verdict.DO_NOT_TRAIN, ()))
        doubtful = any(isinstance(note, verdict.Doubt) for note in self.notes)
        doubtful |= any(doubts_of_commands(self.judgement, self.calibration))
        if self.model.assumed or doubtful:
            ratings.append(acceptance.Assessment(acceptance.Verdict.WITH_CARE, ()))
        return acceptance.combined(ratings)

    @property
    def verdict(self) -> acceptance.Verdict:
        """What the model is suitable for, as one of three verdicts."""
        return self.assessment.verdict

    @property
    def dead_zone(self) -> float:
        """Maximum of the driving command at which the robot stays at rest; 0 if none."""
        spec = self.drive.spec
        driving = {spec.command[place].name for place in list_driving_commands(spec)}
        if not driving:  # no textbook says what each command moves
            driving = {c.name for c in spec.command if not c.turns and c.unit != "rad"}
        return _find_dead_zone(self.model, driving)

    @property
    def alpha(self) -> fitting.Alpha:
        """Threshold of the pruning; `auto` for the knee of the accuracy curve."""
        return self.drive.settings.alpha


def _find_dead_zone(model: TaylorModel, driving: set[str]) -> float:
    """Returns the largest command of those that drive at which no state starts to move.

    A state with dry friction starts when the effect of its command exceeds the friction.
    """
    dead = {c.command: c.dead for c in model.inputs if c.command in driving}
    zones = [0.0, *dead.values()]
    for i, place in enumerate(model.state_size + model.drivers):
        if model.variables[place] not in driving:
            continue
        alone = np.arange(len(model.variables)) == place
        gain = abs(model.coefficients[3 + i, (model.powers == alone).all(axis=1)].sum())
        if model.friction[i] * gain > 0.0:
            zone = dead.get(model.variables[place], 0.0)
            zones.append(zone + float(model.friction[i] / gain))
    return max(zones)


@one_blas_thread
@np.errstate(over="ignore", invalid="ignore")  # a diverging model shows in its figures
def identify(
    recording: Recording,
    spec: RobotSpec,
    order: fitting.Order = defaults.TAYLOR_ORDER,
    alpha: fitting.Alpha = fitting.ALPHA,
    train_until: float | None = None,
    assume: bool = Settings.assume,
    strict: bool = Settings.strict,
) -> Identified:
    """Learns a model up to `train_until` [s], and tests it on the rest; see `Settings`."""
    # Default: two thirds. RecordingError: unusable for this robot. FitError: too little excitation.
    drive = Drive(turned_by_gyro(check(recording, spec)), spec)
    until = train_until if train_until is not None else recording.learn_until_s
    until = LEARNT_SHARE * drive.duration_s if until is None else until
    found = run(
        STAGES, replace(drive, settings=Settings(order, alpha, until, assume, strict))
    )
    return _result(found, found.refit or found)


def _result(trial: Findings, final: Findings) -> Identified:
    linear, model = _fitted(final)
    samples = known(final.samples, "the training part", "fit")
    if final.width is not None:
        model = reached(model, final.whole, samples, final.calibration.uncertainty)
    return Identified(
        final.whole,
        model,
        final.calibration,
        linear,
        samples,
        trial.unseen,
        trial.held_out,
        trial.noise,
        trial,
        final.notes,
    )


def cut(recording: Recording, until: float) -> Recording:
    """Returns a recording up to `until` [s] after its first pose; commands last slightly longer."""
    pose = recording.pose.t

    def part(stream: Stream, margin: float = 0.0) -> Stream:
        overlap = stream.t[0] < pose[-1] and stream.t[-1] > pose[0]
        origin = max(stream.t[0], pose[0]) if overlap else stream.t[0]
        return stream.rows(stream.t <= origin + until + margin)

    if not until > 0.0:
        fault = f"{recording.source}: the training part ends at {until:g} s"
        raise RecordingError(f"{fault}; use more than 0.")
    parts: dict[str, Any] = {
        name: part(stream) for name, stream in recording.streams.items()
    }
    parts["command"] = part(recording.command, timings.SEARCH_S)
    return replace(recording, **parts)
