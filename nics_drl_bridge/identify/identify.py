"""Identification of a model from a recording: calibrate, align, fit, prune, refine and test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify.align import align
from nics_drl_bridge.identify.assume import assume_textbook
from nics_drl_bridge.identify.calibrate import examine
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drift import measure_noise
from nics_drl_bridge.identify.findings import Findings, sentences
from nics_drl_bridge.identify.fit import ALPHA, ORDER, Alpha, Fit, fit
from nics_drl_bridge.identify.open_loop import HORIZON_S, OpenLoop, open_loop_error, windows
from nics_drl_bridge.identify.plausibility import check_axes, check_units, mirror_note
from nics_drl_bridge.identify.refine import refine, simplify
from nics_drl_bridge.identify.repair import repair
from nics_drl_bridge.identify.timing import SEARCH_S
from nics_drl_bridge.identify.verdict import (
    doubts,
    merged,
    refuse_unexcited,
    unlearnt,
    unseen_samples,
    with_quality,
)
from nics_drl_bridge.identify.windows import problem_of
from nics_drl_bridge.recording.recording import Recording, Samples, Stream, check
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import one_blas_thread

TRAIN_SHARE = 2.0 / 3.0


@dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        model: the model, refined and, on request, completed by assumption, with standard
            errors and quality.
        calibration: of the recording.
        fit: the linear fit, before refinement.
        samples: the samples that the fit used.
        unseen: samples of the part that the fit did not see; None if there are too few.
        recording: the whole drive, repaired.
        train_until_s: end of the training part, from the drive's first pose [s].
        held_out: open-loop errors on the rest; None if it was too short.
        alpha: of the pruning; `auto` for the knee of the accuracy curve.
        noise: of sensors and motion, each level measured or assumed.
        findings: of the calibration, for plots.
        notes: sentences on findings, on what could not be learnt and on assumptions.
    """

    model: TaylorModel
    calibration: Calibration
    fit: Fit
    samples: Samples
    unseen: Samples | None
    recording: Recording
    train_until_s: float
    held_out: OpenLoop | None
    alpha: Alpha
    noise: Noise
    findings: Findings
    notes: tuple[str, ...]


@one_blas_thread
@np.errstate(over="ignore", invalid="ignore")  # a diverging model shows in its figures
def identify(
    recording: Recording,
    spec: RobotSpec,
    order: int = ORDER,
    alpha: Alpha = ALPHA,
    train_until: float | None = None,
    assume: bool = False,
    strict: bool = False,
) -> Identified:
    """Learns a robot's motion from the first part of a recording and tests it on the rest.

    Args:
        recording: of a drive in which every command varied. Single samples that jump and
            repeated rows are dropped first.
        spec: the robot.
        order: of the Taylor expansion.
        alpha: of the pruning (Eq. 2), or `auto`.
        train_until: end of the training part, from the first pose [s]; after two thirds of the
            drive when None.
        assume: completes the model by the textbook for inputs that never moved.
        strict: refuses a drive that did not move every input independently, instead of
            returning a model without those inputs.

    Returns:
        Model, calibration, errors and sentences.

    Raises:
        RecordingError: the recording can't be used for this robot.
        FitError: the drive does not contain enough information to fit a model.
    """
    check_units(check(recording, spec), spec)
    duration = float(recording.pose.t[-1] - recording.pose.t[0])
    until = TRAIN_SHARE * duration if train_until is None else train_until
    training, whole = repair(cut(recording, until), spec), repair(recording, spec).recording
    check_axes(training.recording, spec)
    calibration, findings = examine(training.recording, spec)
    samples = align(training.recording, calibration, spec)
    try:
        linear = fit(samples, spec, order, alpha, noisy=not calibration.is_exact)
    except FitError as error:
        raise FitError(f"{recording.source}: {error}") from None
    if strict:
        refuse_unexcited(linear, spec)
    exact = calibration.is_exact
    model, calibration, notes = _refined(linear.model, calibration, training.recording, spec, until)
    assumed: tuple[str, ...] = ()
    if assume:
        model, assumed = assume_textbook(model, spec, linear.unmoved)
    held_out, trial = _held_out(model, calibration, whole, spec, until, duration)
    calibration = replace(calibration, notes=sentences(calibration, findings, spec))
    notes = (
        *training.notes,
        *calibration.notes,
        *notes,
        *mirror_note(samples, spec),
        *unlearnt(linear, calibration, spec),
        *doubts(linear, held_out, exact),
        *trial,
        *assumed,
    )
    unseen = unseen_samples(whole, calibration, spec, until)
    noise = measure_noise(whole, calibration, model, align(whole, calibration, spec), spec)
    as_fitted = model is linear.model
    model = with_quality(model, linear, unseen, held_out, spec)
    linear = replace(linear, model=model) if as_fitted else linear
    return Identified(
        model, calibration, linear, samples, unseen, whole, until, held_out, alpha, noise, findings,
        notes,
    )  # fmt: skip


def cut(recording: Recording, until: float) -> Recording:
    """Returns the part of a recording up to `until` seconds after its first pose.

    The other streams end at about that time, since the clock offset is not known yet. Commands
    last a little longer, since they reveal no pose.
    """
    pose = recording.pose.t

    def part(stream: Stream, margin: float = 0.0) -> Stream:
        overlap = stream.t[0] < pose[-1] and stream.t[-1] > pose[0]
        origin = max(stream.t[0], pose[0]) if overlap else stream.t[0]
        keep = stream.t <= origin + until + margin
        return replace(stream, t=stream.t[keep], values=stream.values[keep])

    if not until > 0.0:
        raise RecordingError(
            f"{recording.source}: the training part ends at {until:g} s; use more than 0."
        )
    parts: dict[str, Any] = {name: part(stream) for name, stream in recording.streams.items()}
    parts["command"] = part(recording.command, SEARCH_S)
    return replace(recording, **parts)


def _refined(
    model: TaylorModel, calibration: Calibration, training: Recording, spec: RobotSpec, until: float
) -> tuple[TaylorModel, Calibration, tuple[str, ...]]:
    """Refines a model of a real recording; the model of an exact recording is unchanged."""
    if calibration.is_exact:
        return model, calibration, ()
    linear = model
    model, calibration = _by_definition(model.with_errors({}), calibration, spec)
    problem = problem_of(model, calibration, training, spec, 0.0, until)
    if problem is None:
        return merged(model, linear, {}), calibration, (
            "The training part is too short to refine the model by its errors over seconds; record "
            "a longer drive.",
        )  # fmt: skip
    try:
        refined = simplify(problem, refine(problem, model, calibration))
    except np.linalg.LinAlgError:  # the model is unstable: its slopes overflow
        return merged(model, linear, {}), calibration, (
            "The predictions of the fitted model run away on the training part, so that it could "
            "not be refined.",
        )  # fmt: skip
    note = (
        "Coefficients and calibration were refined by the open-loop errors over up to 5 s: "
        f"{refined.error:.4f} m (root mean square) is left on the training part."
    )
    errors = replace(refined.model, std_errors=refined.std_errors).named_errors
    return merged(refined.model, linear, errors), refined.calibration, (note,)


def _by_definition(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> tuple[TaylorModel, Calibration]:
    """Scales an inferred speed so that vx = 1 speed, and treats lateral motion as noise.

    `base_link` of a robot without a lateral command is the point without lateral motion.
    """
    coefficients = model.coefficients.copy()
    if not spec.moves_sideways:
        coefficients[1] = 0.0
    responses = list(calibration.responses)
    speeds = [i for i, v in enumerate(spec.state) if v.unit == "m/s"]
    if responses and len(speeds) == 1:
        i = speeds[0]
        alone = np.array([v == spec.state[i].name for v in spec.variable_names], dtype=np.int64)
        scale = float(coefficients[0] @ (model.powers == alone).all(axis=1))
        if scale > 0.0:
            coefficients = coefficients / scale ** model.powers[:, i]
            coefficients[3 + i] *= scale
            responses[i] = replace(responses[i], gain=responses[i].gain * scale)
            coefficients[0, (model.powers == alone).all(axis=1)] = 1.0
    model = replace(model, coefficients=coefficients)
    return model, replace(calibration, responses=tuple(responses))


def _held_out(
    model: TaylorModel,
    calibration: Calibration,
    recording: Recording,
    spec: RobotSpec,
    until: float,
    duration: float,
) -> tuple[OpenLoop | None, tuple[str, ...]]:
    chosen = windows(recording, calibration, until, duration, HORIZON_S, 0.1)
    if len(chosen.start_t) == 0:
        return None, (
            f"The last {max(duration - until, 0.0):.1f} s, held out of the fit, are too short for "
            f"a prediction over {HORIZON_S:g} s: the model was not tried on unseen data; record "
            "20 s or more.",
        )  # fmt: skip
    return open_loop_error(model, calibration, recording, spec, until, duration), ()
