"""Identification: a recording becomes a model, by the stages that `list_stages` lists in order.

A stage is a function `(drive, findings) -> findings`. It may take its data from three drives:

- `findings.training` is the part to learn from, without faulty rows. All that a model or a
  calibration is fitted to comes from here.
- `findings.whole` is the whole drive, without faulty rows. It serves to judge a model on the part
  held out from the fit, to measure the sensors' noise, and to fit the final model.
- `drive` is the drive as recorded. A stage takes from it the robot, the settings, the names of
  sources, and whether a state was measured: `derive_motion` adds one to the other two.

Every drive that is not exact is fitted by what its model predicts, whether its state is the motion,
follows the commands, or was measured (`terms.Kind`): see `fit_by_predictions` and
`refine_by_predictions`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify import clocks as timings
from nics_drl_bridge.identify import fit as fitting
from nics_drl_bridge.identify import hypotheses, open_loop, shooting
from nics_drl_bridge.identify import judgement as judging
from nics_drl_bridge.identify.alignment import (
    add_motion,
    align,
    choose_half_width,
    has_motion_as_state,
    make_motion_grid,
    make_surrogate,
)
from nics_drl_bridge.identify.calibration import (
    Alpha,
    Calibration,
    Order,
    Response,
    Settings,
)
from nics_drl_bridge.identify.clocks import SEPARABLE_S
from nics_drl_bridge.identify.drive import Doubt, Drive, Gap, Mistake
from nics_drl_bridge.identify.findings import (
    MIN_ROWS,
    WORSE,
    Findings,
    add_quality,
    collect_notes,
    describe_refit,
    describe_replacement,
    is_worse,
    list_missed,
    list_plain_calibration_notes,
    measure_time_without_pose,
    name_sum,
    refuse_unexcited,
    require,
    require_fit,
    require_model,
    require_samples,
    resample_drive,
    try_model,
)
from nics_drl_bridge.identify.fit import ORDER
from nics_drl_bridge.identify.forms import (
    CLEAR,
    Evidence,
    drop_unreached_ends,
    find_input_curve,
    find_likely_delay,
)
from nics_drl_bridge.identify.judgement import (
    estimate_bands,
    fit_textbook,
    judge_predictions,
)
from nics_drl_bridge.identify.mounting import apply_mounting, estimate_mounting
from nics_drl_bridge.identify.noise import add_motion_noise, measure_sensor_noise
from nics_drl_bridge.identify.repair import (
    check_axes,
    check_commands,
    check_encoders,
    check_pose_moves,
    check_units,
    correct_heading_by_gyro,
    repair_rows,
)
from nics_drl_bridge.identify.terms import (
    Kind,
    Library,
    drop_unused_terms,
    share_effects,
)
from nics_drl_bridge.identify.textbook import (
    Yardstick,
    add_actuator_state,
    assume_textbook,
    fit_yardstick,
    make_actuated_spec,
    make_textbook_calibration,
    make_textbook_model,
    needs_actuators,
)
from nics_drl_bridge.recording.joining import LEARNT_SHARE, join
from nics_drl_bridge.recording.recording import Recording, Samples, Stream, check
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import HorizonErrors, TaylorModel
from nics_drl_bridge.threads import one_blas_thread

Stage = Callable[[Drive, Findings], Findings]

SHORT_S = 5.0  # a shorter drive can't tell the third and fourth order of a textbook
TOO_SHORT = (
    "The training part is too short to refine the model by its errors over seconds; record a "
    "longer drive."
)


@one_blas_thread
@np.errstate(over="ignore", invalid="ignore")  # a diverging model shows in its figures
def identify(
    recording: Recording,
    spec: RobotSpec,
    order: Order = Settings.order,
    alpha: Alpha = Settings.alpha,
    train_until: float | None = None,
    assume: bool = Settings.assume,
    strict: bool = Settings.strict,
) -> "Identified":
    """Learns a model from the first part of a recording, tests it on the rest, and refits it.

    Args:
        recording: a drive of the robot.
        spec: the robot.
        order: of the Taylor expansion (Eq. 1), or `auto`.
        alpha: threshold of the pruning (Eq. 2), or `auto`.
        train_until: end of the first part, from the first pose [s]; by default two thirds.
        assume: completes the model by the textbook for inputs that never moved.
        strict: refuses a drive that did not move every input independently.

    Raises:
        RecordingError: the recording is unusable for this robot.
        FitError: it does not show enough to fit a model.
    """
    drive = Drive(correct_heading_by_gyro(check(recording, spec)), spec)
    until = train_until if train_until is not None else recording.learn_until_s
    until = LEARNT_SHARE * drive.duration_s if until is None else until
    settings = Settings(
        order=order, alpha=alpha, train_until_s=until, assume=assume, strict=strict
    )
    trial = run(list_stages(), replace(drive, settings=settings))
    return _make_result(trial, trial.final or trial)


def list_stages() -> tuple[Stage, ...]:
    """Returns the stages in order; each uses the findings of those before it.

    | stage | exact drive | noisy drive |
    |---|---|---|
    | `fit_terms` | least squares (Eq. 1) | predictions choose effects and terms |
    | `prune_terms` | Eq. 2, and a refit | nothing |
    | `refine_model` | nothing | predictions adjust all parameters, then Eq. 2 |
    | `prefer_textbook` | if it predicts better | if it predicts better |

    The other stages do the same for both.
    """
    return (
        repair_drive,
        estimate_timing,
        find_mounting,
        find_responses,
        measure_noise,
        derive_motion,
        find_input_curves,
        fit_terms,
        prune_terms,
        refine_model,
        complete_model,
        judge_model,
        prefer_textbook,
        refit_model,
    )


def run(
    stages: Sequence[Stage], drive: Drive, findings: Findings | None = None
) -> Findings:
    """Runs stages over a drive as recorded, from given findings or the start; returns theirs."""
    findings = findings or start_findings(drive)
    for stage in stages:
        findings = stage(drive, findings)
    return findings


def start_findings(drive: Drive) -> Findings:
    """Returns the findings on a drive as recorded, before the first stage."""
    training = drive.part(cut(drive.recording, drive.settings.train_until_s))
    return Findings(training, drive, timings.make_nominal_timing(training))


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
        return _make_result(self.findings, self.findings)

    @property
    def recording(self) -> Recording:
        """The whole recording, repaired."""
        return self.drive.recording

    @property
    def gaps(self) -> tuple[str, ...]:
        """The notes on what the drive could not teach."""
        return tuple(str(note) for note in self.notes if isinstance(note, Gap))

    @property
    def train_until_s(self) -> float:
        """End of the training part, from the drive's first pose [s]."""
        return self.drive.settings.train_until_s

    @property
    def judgement(self) -> tuple[HorizonErrors, ...]:
        """Errors on held-out data, compared with those of yardsticks, by horizon."""
        return self.findings.judgement

    @property
    def assessment(self) -> judging.Assessment:
        """What the model is suitable for, and the reasons."""
        spec = self.drive.spec
        findings = self.findings
        mistaken = any(isinstance(note, Mistake) for note in self.notes)
        unfit = mistaken or bool(list_missed(self.fit, spec))
        textbook = bool(findings.replacement)
        ratings = [
            judging.rate(self.judgement, spec.footprint_radius, textbook),
            judging.rate_unseen(
                measure_time_without_pose(self.drive), self.drive.duration_s
            ),
        ]
        if unfit:
            ratings.append(judging.Assessment(judging.Verdict.DO_NOT_TRAIN, ()))
        doubtful = any(isinstance(note, Doubt) for note in self.notes)
        doubtful |= any(
            judging.list_doubts_of_commands(self.judgement, self.calibration)
        )
        if self.model.assumed or doubtful:
            ratings.append(judging.Assessment(judging.Verdict.WITH_CARE, ()))
        return judging.combine_ratings(ratings)

    @property
    def verdict(self) -> judging.Verdict:
        """What the model is suitable for, as one of three verdicts."""
        return self.assessment.verdict

    @property
    def alpha(self) -> Alpha:
        """Threshold of the pruning; `auto` for the knee of the accuracy curve."""
        return self.drive.settings.alpha


def _make_result(trial: Findings, final: Findings) -> Identified:
    """Returns the result of a trial and of the final fit, which may be the same."""
    samples = require_samples(final)
    model = require_model(final)
    if final.base is not None and not final.replacement:
        model = drop_unreached_ends(
            model, final.whole, samples, final.calibration.uncertainty
        )
    return Identified(
        drive=final.whole,
        model=model,
        calibration=final.calibration,
        fit=require_fit(final),
        samples=samples,
        unseen=trial.unseen,
        held_out=trial.held_out,
        noise=trial.noise,
        findings=trial,
        notes=final.notes,
    )


def repair_drive(drive: Drive, findings: Findings) -> Findings:
    """Refuses other units, axes and orders; drops repeated rows and jumps, clips commands."""
    check_pose_moves(findings.training)
    training, _ = repair_rows(findings.training)
    whole, repairs = repair_rows(findings.whole)
    repairs += check_commands(training, findings.training.recording.command)
    check_units(drive)
    check_axes(training)
    repairs += check_encoders(training)
    check(training.recording, drive.spec)
    return replace(findings, training=training, whole=whole, repairs=repairs)


def estimate_timing(drive: Drive, findings: Findings) -> Findings:
    """Finds the period of bursts, the clock offset, the latency of commands, and lags."""
    training = findings.training
    spec = drive.spec
    timings.check_state_is_known(drive.recording, spec)
    responses: tuple[Response, ...] = ()
    if has_motion_as_state(spec, drive.recording):
        by_command = replace(training, spec=make_surrogate(spec))
        timing = timings.measure_timing(by_command)
        responses, timing = _select_followers(spec, timing)
    else:
        timing = timings.measure_timing(training)
    calibration = replace(
        findings.calibration,
        responses=responses,
        uncertainty=timing.sigma,
        clock_offset_s=timing.offset,
        command_latency_s=timing.latency,
        burst_period_s=training.bursts.period_s if training.bursts else 0.0,
    )
    return replace(findings, timing=timing, calibration=calibration)


def _select_followers(
    spec: RobotSpec, timing: timings.TimingEstimate
) -> tuple[tuple[Response, ...], timings.TimingEstimate]:
    """Returns the states that follow a command, with their lags, from the lag of each command.

    The timing that is returned has the lags of these states alone, in their order.
    """
    names = [c.name for c in spec.command]
    states = [v for v in spec.state if v.follows and v.twist is None]
    rows = [names.index(str(v.follows)) for v in states]
    selected = replace(timing, lags=timing.lags[rows], lag_sigma=timing.lag_sigma[rows])
    responses = (
        Response(v.name, str(v.follows), float(lag))
        for v, lag in zip(states, selected.lags, strict=True)
    )
    return tuple(responses), selected


def find_mounting(drive: Drive, findings: Findings) -> Findings:
    """Finds where and how the tracked body is mounted on the robot."""
    mounting = estimate_mounting(findings.training, findings.timing)
    calibration = apply_mounting(findings.calibration, mounting)
    return replace(findings, mounting=mounting, calibration=calibration)


def find_responses(drive: Drive, findings: Findings) -> Findings:
    """Finds how unmeasured states follow the commands, and the scale of the wheels."""
    training = findings.training
    calibration = findings.calibration
    if not has_motion_as_state(drive.spec, drive.recording):
        responses = timings.list_responses(training, calibration, findings.timing)
        calibration = replace(calibration, responses=responses)
    return replace(
        findings, calibration=timings.add_wheel_scales(training, calibration)
    )


def measure_noise(drive: Drive, findings: Findings) -> Findings:
    """Measures the noise of the pose; a drive without noise and corrections is treated as exact."""
    position, heading = findings.training.pose_noise or (0.0, 0.0)
    calibration = replace(
        findings.calibration, position_noise_m=position, heading_noise_rad=heading
    )
    noise = measure_sensor_noise(findings.whole)
    return replace(findings, calibration=calibration, noise=noise)


def derive_motion(drive: Drive, findings: Findings) -> Findings:
    """Derives the state from the poses, if it is an unmeasured part of the twist."""
    if not has_motion_as_state(drive.spec, drive.recording):
        return findings
    calibration = findings.calibration
    width = choose_half_width(findings.training)
    parts = []
    for part in (findings.training, findings.whole):
        grid = make_motion_grid(part, calibration, drive.settings.control_period_s)
        parts.append(add_motion(part, calibration, grid, width))
    training, whole = parts
    return replace(findings, training=training, whole=whole, motion_width_s=width)


def find_input_curves(drive: Drive, findings: Findings) -> Findings:
    """Finds the latency, and the dead zones and saturation of commands, that explain a motion."""
    if findings.motion_width_s is None:
        return findings
    training = findings.training
    findings = _with_likely_latency(findings)
    samples = resample_drive(training, findings)
    curves = []
    clear = []
    for place in range(len(drive.spec.command)):
        candidate = find_input_curve(samples, drive.spec, place)
        if candidate is None:
            continue
        curves.append(candidate.curve)
        if candidate.gain >= CLEAR:
            clear.append(candidate.curve)
    if not curves:
        return findings
    calibration = replace(findings.calibration, inputs=tuple(curves))
    findings = replace(findings, calibration=calibration, clear_curves=tuple(clear))
    return _with_likely_latency(findings)  # the curves may hide a part of it


def _with_likely_latency(findings: Findings) -> Findings:
    """Returns findings with the latency of commands that best explains a motion."""
    calibration = findings.calibration
    samples = resample_drive(findings.training, findings)
    latency = find_likely_delay(findings.training, calibration, samples)
    calibration = replace(calibration, command_latency_s=latency)
    return replace(findings, calibration=calibration)


def fit_terms(drive: Drive, findings: Findings) -> Findings:
    """Resamples the streams on one time axis, and fits all terms by least squares (Eq. 1).

    Unless the drive is exact, predictions choose these terms and effects of motors beside them.
    """
    calibration = findings.calibration
    if not calibration.is_exact:
        return fit_by_predictions(drive, findings)
    settings = drive.settings
    samples = align(findings.training, calibration)
    order = fitting.ORDER if settings.order == "auto" else settings.order
    try:
        regression = fitting.regress(samples, drive.spec, order)
    except FitError as error:
        raise FitError(f"{drive.recording.source}: {error}") from None
    if settings.strict:
        refuse_unexcited(regression.excitation, drive.spec)
    return replace(findings, samples=samples, regression=regression)


def prune_terms(drive: Drive, findings: Findings) -> Findings:
    """Keeps the terms of Eq. 2, and refits them, unless predictions choose the terms."""
    regression = require(findings.regression, "the fit of all terms", "fit_terms")
    if not findings.calibration.is_exact:
        return findings
    linear = fitting.prune_and_refit(regression, drive.spec, drive.settings.alpha)
    return replace(findings, pruned_fit=linear, model=linear.model)


def refine_model(drive: Drive, findings: Findings) -> Findings:
    """Adjusts model and calibration to predictions over seconds, unless the drive is exact."""
    if findings.calibration.is_exact:
        return findings
    return refine_by_predictions(drive, findings)


def complete_model(drive: Drive, findings: Findings) -> Findings:
    """Completes the model by the textbook for inputs that never moved, if requested."""
    if not drive.settings.assume:
        return findings
    unmoved = require_fit(findings).unmoved
    model, assumptions = assume_textbook(require_model(findings), drive.spec, unmoved)
    return replace(findings, model=model, assumptions=assumptions)


def judge_model(drive: Drive, findings: Findings) -> Findings:
    """Tests the model on the held-out part, measures the motion's noise, and lists doubts."""
    fit = require_fit(findings)
    model = require_model(findings)
    whole = findings.whole
    calibration = findings.calibration
    until = drive.settings.train_until_s
    samples = resample_drive(whole, findings)
    if calibration.responses and findings.motion_width_s is None:
        samples = open_loop.infer_samples(model, calibration, whole, samples)
    held_out_from = whole.recording.pose.t[0] + calibration.clock_offset_s + until
    unseen: Samples | None = samples.rows(samples.t > held_out_from)
    if unseen is not None and len(unseen.t) < MIN_ROWS:
        unseen = None
    held_out = try_model(model, calibration, whole, until)
    yardstick = findings.yardstick or fit_textbook(whole, calibration)
    bands = _find_bands(drive, findings)
    judgement = judge_predictions(model, calibration, whole, bands, yardstick)
    rated = add_quality(model, fit, unseen, held_out, judgement, drive.spec)
    if model is fit.model:
        fit = replace(fit, model=rated)
    notes = list_plain_calibration_notes(findings)
    findings = replace(
        findings,
        pruned_fit=fit,
        model=rated,
        unseen=unseen,
        held_out=held_out,
        judgement=judgement,
        yardstick=yardstick,
        calibration=replace(calibration, notes=notes),
        noise=add_motion_noise(findings.noise, whole, calibration, model, samples),
    )
    return replace(findings, notes=collect_notes(drive, findings))


def _find_bands(drive: Drive, findings: Findings) -> dict[float, float]:
    """Returns the distances within which 95 % of predictions should end [m], by horizon [s]."""
    model = require_model(findings)
    calibration = findings.calibration
    training = findings.training
    if findings.replacement:
        return estimate_bands(model, calibration, training, fixed=True)
    if calibration.is_exact or drive.duration_s <= drive.settings.train_until_s:
        return {}
    derived = None
    if findings.base is not None:
        derived = resample_drive(training, findings), findings.base
    return estimate_bands(model, calibration, training, derived)


def prefer_textbook(drive: Drive, findings: Findings) -> Findings:
    """Replaces the model by the fitted textbook if that predicts the held-out part better.

    The textbook is tried with one limit of acceleration for both directions, and with a limit each.
    The held-out part chooses between them, so the errors there are slightly optimistic if a
    textbook is chosen: they are the lowest of three. The report says so.
    """
    fitted = findings.yardstick
    if fitted is None or not judging.is_beaten_by_textbook(findings.judgement):
        return findings
    until = drive.settings.train_until_s
    offset = findings.calibration.clock_offset_s
    best = findings
    for one_limit in (True, False):
        with suppress(FitError, RecordingError):
            yardstick = fitted
            if one_limit:
                yardstick = fit_yardstick(findings.whole, until, offset, one_limit)
            textbook = _try_textbook(drive, findings, yardstick)
            if textbook is not None and _measure_error(textbook) < _measure_error(best):
                best = textbook
    return best


def _measure_error(findings: Findings) -> float:
    """Returns the error of a judged model after 5 s, or at the longest horizon [m]."""
    errors = [
        at.model.position_m for at in judging.select_usual_horizon(findings.judgement)
    ]
    return min(errors, default=np.inf)


def _try_textbook(
    drive: Drive, findings: Findings, yardstick: Yardstick
) -> Findings | None:
    """Judges the fitted textbook in place of the model; None without terms for its state."""
    model = require_model(findings)
    spec = drive.spec
    calibration = make_textbook_calibration(yardstick, findings.calibration, spec)
    start = derive_motion(drive, replace(findings, calibration=calibration))
    is_actuated = needs_actuators(yardstick, spec)
    if is_actuated:
        drive, start = _add_actuators(drive, start, yardstick)
        spec = drive.spec
    samples = resample_drive(start.training, start)
    if is_actuated:  # the fit was of another state's rates
        fit = fitting.fit(samples, spec, noisy=True)
        start = replace(start, regression=fit.regression, pruned_fit=fit)
    textbook = make_textbook_model(yardstick, model, samples, spec)
    if textbook is None:
        return None
    (lost,) = judging.select_usual_horizon(findings.judgement)
    start = replace(
        start,
        model=textbook,
        samples=samples,
        refinement=(),
        trials=(),
        assumptions=(),
        replacement=describe_replacement(lost),
    )
    return judge_model(drive, start)


def _add_actuators(
    drive: Drive, findings: Findings, yardstick: Yardstick
) -> tuple[Drive, Findings]:
    """Returns a drive of a steered robot, and its findings, with speed and angle as state."""
    calibration = findings.calibration
    spec = make_actuated_spec(yardstick, findings.whole)
    training, whole = (
        add_actuator_state(part, spec, yardstick, calibration)
        for part in (findings.training, findings.whole)
    )
    findings = replace(findings, training=training, whole=whole, motion_width_s=None)
    return replace(drive, spec=spec), findings


def refit_model(drive: Drive, findings: Findings) -> Findings:
    """Refits the judged model to the whole drive, unless that predicts the training part worse."""
    until = drive.settings.train_until_s
    if findings.calibration.is_exact or until >= drive.duration_s:
        return findings
    if findings.replacement:
        return findings
    final = _fit_whole_drive(drive, findings)
    driven = drive.recording.driven_s
    sentence = describe_refit(driven(until), driven(), worse=final is None)
    if final is None:
        findings = replace(findings, refinement=(*findings.refinement, sentence))
        return replace(findings, notes=collect_notes(drive, findings))
    notes = list_plain_calibration_notes(final)
    final = replace(
        final,
        refinement=(*final.refinement, sentence),
        calibration=replace(final.calibration, notes=notes),
        model=replace(require_model(final), quality=require_model(findings).quality),
    )
    final = replace(final, notes=collect_notes(drive, final))
    return replace(findings, final=final)


def _fit_whole_drive(drive: Drive, findings: Findings) -> Findings | None:
    """Fits the whole drive; None if that fails, or predicts the training part worse."""
    until = drive.settings.train_until_s
    settings = replace(drive.settings, train_until_s=np.inf)
    start = replace(findings, training=findings.whole.under(settings))
    stages = (derive_motion, fit_terms, prune_terms, refine_model, complete_model)
    try:
        final = run(stages, replace(drive, settings=settings), start)
        error_m = _measure_mean_error(final, until)
        trial_error_m = _measure_mean_error(findings, until)
    except (FitError, RecordingError):
        return None
    return None if is_worse(error_m, trial_error_m) else final


def _measure_mean_error(findings: Findings, until: float) -> float:
    """Returns the mean error [m] of predictions over 5 s of the whole drive up to a time [s]."""
    errors = open_loop.measure_open_loop_error(
        require_model(findings), findings.calibration, findings.whole, 0.0, until
    )
    return errors.mean_position_error_m


def cut(recording: Recording, until: float) -> Recording:
    """Returns a recording up to `until` [s] after its first pose; commands last slightly longer.

    Raises RecordingError if no commands, or none of the measured states, are left.
    """
    if not until > 0.0:
        fault = f"{recording.source}: the training part ends at {until:g} s"
        raise RecordingError(f"{fault}; use more than 0.")
    parts: dict[str, Any] = {}
    for name, stream in recording.streams.items():
        last = _find_origin(stream, recording.pose) + until
        if name == "command":
            last += timings.SEARCH_S
        part = stream.rows(stream.t <= last)
        parts[name] = part if len(part.t) else None
        if name in ("command", "state") and parts[name] is None:
            fault = f"{recording.source}: {name}: starts after the first {until:g} s"
            advice = "the part of the drive to learn from; record it from the start"
            raise RecordingError(f"{fault}, {advice}.")
    return replace(recording, **parts)


def _find_origin(stream: Stream, pose: Stream) -> float:
    """Returns the time of the first pose on a stream's clock [s]; a guess if that is another."""
    if stream.clock == pose.clock:
        return float(pose.t[0])
    if stream.t[0] < pose.t[-1] and stream.t[-1] > pose.t[0]:  # a small offset
        return float(max(stream.t[0], pose.t[0]))
    return float(stream.t[0])


def join_recordings(recordings: Sequence[Recording], spec: RobotSpec) -> Recording:
    """Joins recordings of a robot; RecordingError for another robot, or clocks that can't align."""
    if not recordings:
        raise RecordingError("no recording was given; give one or more.")
    if len(recordings) == 1:
        return recordings[0]
    # a gyro's bias differs between drives
    turned = [correct_heading_by_gyro(item) for item in recordings]
    offsets = [_find_clock_offset(item, spec) for item in turned]
    joined = join(turned, offsets)
    gyros = [item.gyro for item in turned]
    return replace(
        joined, gyro=gyros[0] if all(item is not None for item in gyros) else None
    )


def _find_clock_offset(recording: Recording, spec: RobotSpec) -> float:
    """Returns the offset [s] from the pose's clock to the commands', found from this drive."""
    if recording.pose.clock == recording.command.clock:
        return 0.0
    drive = Drive(check(recording, spec), spec)
    try:
        return run((repair_drive, estimate_timing), drive).calibration.clock_offset_s
    except FitError as error:
        fault = f"{recording.source}: its two clocks can't be aligned by this drive alone ({error})"
        raise RecordingError(
            f"{fault}; record pose and commands by one clock."
        ) from None


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
        refuse_unexcited(fit.regression.excitation, drive.spec)
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
        base = hypotheses.fit_base(evidence, findings.clear_curves)
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
        errors[name_sum(state)] = float(np.sqrt(max(variance, 0.0)))
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
        if not is_worse(*errors):
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
        off = f"more than {WORSE:g} times as far off as the textbook's, or diverge"
        why = f"predictions with its terms are {off}, so only the textbook's were kept"
        yield f"order = {order} was not used: {why}."


STAGES = list_stages()
"""All stages, to run a part of them: `run(STAGES[:4], drive)`."""
