"""From a recording to a model: calibrate, align, fit, prune, refine, and try it out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nics_drl_bridge.calibration.align import align
from nics_drl_bridge.calibration.assume import assume_textbook
from nics_drl_bridge.calibration.calibrate import examine
from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.open_loop import HORIZON_S, OpenLoop, open_loop_error, windows
from nics_drl_bridge.calibration.refine import refine, simplify
from nics_drl_bridge.calibration.report import sentences
from nics_drl_bridge.calibration.timing import SEARCH_S
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.kinematics.fit import ALPHA, ORDER, Fit, fit
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Recording, Samples, Stream, check
from nics_drl_bridge.kinematics.spec import RobotSpec

TRAIN_SHARE = 2.0 / 3.0


@dataclass(frozen=True)
class Identified:
    """All that was learnt from a recording.

    Attributes:
        model: the model, refined and, on request, completed by assumption.
        calibration: of the recording.
        fit: the linear fit, before refinement.
        samples: that the fit used.
        train_until_s: where the training part ended, from the drive's first pose [s].
        held_out: open-loop errors on the rest; None if it was too short for them.
        notes: sentences on what was found, what could not be learnt, what was assumed.
    """

    model: TaylorModel
    calibration: Calibration
    fit: Fit
    samples: Samples
    train_until_s: float
    held_out: OpenLoop | None
    notes: tuple[str, ...]


def identify(
    recording: Recording,
    spec: RobotSpec,
    order: int = ORDER,
    alpha: float = ALPHA,
    train_until: float | None = None,
    assume: bool = False,
) -> Identified:
    """Learns a robot's motion from the first part of a recording and tries it on the rest.

    Args:
        recording: of a drive in which every command varied.
        spec: the robot.
        order: of the Taylor expansion.
        alpha: of the pruning (Eq. 2).
        train_until: end of the part to learn from, from the first pose [s]; the first two
            thirds when None.
        assume: completes the model by the textbook for inputs that never moved.

    Returns:
        Model, calibration, errors and sentences.

    Raises:
        RecordingError: the recording can't be used for this robot.
        FitError: the drive does not hold enough to fit a model.
    """
    check(recording, spec)
    duration = float(recording.pose.t[-1] - recording.pose.t[0])
    until = TRAIN_SHARE * duration if train_until is None else train_until
    training = cut(recording, until)
    calibration, findings = examine(training, spec)
    samples = align(training, calibration, spec)
    linear = fit(samples, spec, order, alpha, noisy=not calibration.is_exact)
    model, calibration, notes = _refined(linear.model, calibration, training, spec, until)
    held_out, trial = _held_out(model, calibration, recording, spec, until, duration)
    calibration = replace(calibration, notes=sentences(calibration, findings, spec))
    notes = (*calibration.notes, *notes, *_unlearnt(linear, calibration), *trial)
    if assume:
        model, assumed = assume_textbook(model, spec, linear.unmoved)
        notes = (*notes, *assumed)
    return Identified(model, calibration, linear, samples, until, held_out, notes)


def cut(recording: Recording, until: float) -> Recording:
    """The part of a recording up to `until` seconds after its first pose.

    The other streams end at about that time: how far the clocks are apart is not known yet.
    Commands last a little longer, since no pose can be learnt from them.
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
    return replace(
        recording,
        command=part(recording.command, SEARCH_S),
        pose=part(recording.pose),
        state=part(recording.state) if recording.state else None,
        wheels=part(recording.wheels) if recording.wheels else None,
    )


def _refined(
    model: TaylorModel, calibration: Calibration, training: Recording, spec: RobotSpec, until: float
) -> tuple[TaylorModel, Calibration, tuple[str, ...]]:
    """Refines a model of a real recording; that of an exact one is left alone."""
    if calibration.is_exact:
        return model, calibration, ()
    model, calibration = _by_definition(model, calibration, spec)
    refined = refine(model, calibration, training, spec, 0.0, until)
    if refined is None:
        return model, calibration, (
            "The training part is too short to refine the model by its errors over seconds; record "
            "a longer drive.",
        )  # fmt: skip
    refined = simplify(refined, training, spec, 0.0, until)
    note = (
        "Coefficients and calibration were refined by the open-loop errors over up to 5 s: "
        f"{refined.error:.4f} m (root mean square) is left on the training part."
    )
    return refined.model, refined.calibration, (note,)


def _by_definition(
    model: TaylorModel, calibration: Calibration, spec: RobotSpec
) -> tuple[TaylorModel, Calibration]:
    """Scales an inferred speed so that vx = 1 speed, and takes lateral motion as noise.

    `base_link` of a robot that has no command sideways is the point without lateral motion.
    """
    coefficients = model.coefficients.copy()
    if all(command.cmd_vel != "linear.y" for command in spec.command):
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


def _unlearnt(linear: Fit, calibration: Calibration) -> tuple[str, ...]:
    """A sentence on the inputs that the drive never moved."""
    already = {r.command for r in calibration.responses} | {r.state for r in calibration.responses}
    missing = [name for name in linear.unmoved if name not in already]
    notes = []
    if linear.unmoved:
        notes.append(
            f"The model has no terms of {', '.join(linear.unmoved)}, which never moved: it holds "
            "for this drive's constant value only."
        )
    if missing:
        notes.append(
            f"Drive with {', '.join(missing)} changing over the whole range to learn them."
        )
    return tuple(notes)


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
