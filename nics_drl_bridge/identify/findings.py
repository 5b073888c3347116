"""Findings: what the stages know so far, and sentences on it: quality, gaps, or a refusal."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import clocks, hypotheses
from nics_drl_bridge.identify.alignment import (
    align,
    resample_motion,
    select_moved_commands,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import TimingEstimate
from nics_drl_bridge.identify.drive import MAX_GAP_S, Alone, Doubt, Drive, Gap, Mistake
from nics_drl_bridge.identify.fit import (
    Excitation,
    Fit,
    Regression,
    select_plausible_rows,
)
from nics_drl_bridge.identify.judgement import THRESHOLDS, describe_shortfall
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.identify.open_loop import (
    HORIZON_S,
    OpenLoop,
    measure_open_loop_error,
    predict,
    select_windows,
)
from nics_drl_bridge.identify.statistics import CERTAIN, measure_rate_errors
from nics_drl_bridge.identify.terms import Kind
from nics_drl_bridge.identify.textbook import Yardstick
from nics_drl_bridge.recording.recording import Recording, Samples, Stream
from nics_drl_bridge.robot.curve import InputCurve, delays
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import HorizonErrors, Quality, TaylorModel

T = TypeVar("T")
MIN_ROWS = 20
FEW_LEVELS = 2
ILL_CONDITIONED = 1e6
# predictions whose mean error exceeds this fraction of the path can't be trusted
FAR_OFF = 0.25
UNEXPLAINED = 0.5
# ratio to the trial's error on the training part, above which a refit is rejected
WORSE = 1.25
MANY_OUTLIERS = 0.001
BACKWARDS = 0.3  # angle [rad] from half a turn, below which a body faces backwards
# a pause of the pose longer than this many usual steps, and MAX_GAP_S, is a gap
GAP_STEPS = 3.0
# maximum number of gaps to report individually: the longest, in order of time
MOST_GAPS_LISTED = 12
# fraction of a state's range between two rows that is sampled too coarsely
COARSE = 2.0 / 3.0
ENDS = (1.0, 99.0)  # percentiles that bound the range of a state
# correlation of yaw rate and steering below which the robot turns the wrong way
MIRRORED = -0.5
# horizons for which errors are compared recording by recording, and of their windows
HORIZONS_OF_RECORDING_S = (5.0, 2.0, 1.0, 0.5)
FEWEST_OF_RECORDING = 5  # minimum number of windows per recording
SPACING_OF_RECORDING_S = 0.5
# ratio to the errors of the other recordings from which one is reported as off
ALONE = 2.5
LEAST_SHARE = 0.02  # fraction of the path below which errors are ignored


@dataclass(frozen=True)
class Findings:
    """What is known of a drive; each field names the stage of `identify` that sets it.

    A field is None or empty before its stage has run, and if the drive does not show it.
    """

    # The part of the drive to learn from, and the whole drive. `repair_drive` removes faulty
    # rows from both; `derive_motion` adds a state that the poses imply.
    training: Drive
    whole: Drive
    # nominal until `estimate_timing`
    timing: clocks.TimingEstimate
    # sentences from `repair_drive`
    repairs: tuple[str, ...] = ()
    # from `find_mounting`
    mounting: Mounting | None = None
    # from `estimate_timing`, `find_mounting`, `find_responses` and `measure_noise`; then from
    # `find_input_curves` and `refine_model`
    calibration: Calibration = field(default_factory=Calibration)
    # the pose sensor's from `measure_noise`; the rest from `judge_model`
    noise: Noise = field(default_factory=Noise)
    # half-width [s] of the parabolas by which `derive_motion` derived the state; None if the
    # state is not derived from the poses
    motion_width_s: float | None = None
    # input curves beyond doubt, from `find_input_curves`
    clear_curves: tuple[InputCurve, ...] = ()
    # of the training part on one time axis, from `fit_terms`
    samples: Samples | None = None
    # all terms (Eq. 1), from `fit_terms`
    regression: Regression | None = None
    # the textbook of a noisy drive and its effects, from which models depart, from `fit_terms`
    base: hypotheses.Base | None = None
    # of orders, cross-validated within the training part, from `fit_terms`
    trials: tuple[hypotheses.Trial, ...] = ()
    # the pruned fit (Eq. 2), from `prune_terms`; of a noisy drive from `fit_terms`
    pruned_fit: Fit | None = None
    # from `prune_terms`; then from `refine_model` and `complete_model`
    model: TaylorModel | None = None
    # sentences from `refine_model`
    refinement: tuple[str, ...] = ()
    # sentences from `complete_model`
    assumptions: tuple[str, ...] = ()
    # of the held-out part, from `judge_model`
    unseen: Samples | None = None
    # open-loop errors on the held-out part, from `judge_model`
    held_out: OpenLoop | None = None
    # errors on the held-out part beside those of yardsticks, from `judge_model`
    judgement: tuple[HorizonErrors, ...] = ()
    # the textbook fitted to the training part, from `judge_model`
    yardstick: Yardstick | None = None
    # all sentences, from `judge_model`
    notes: tuple[str, ...] = ()
    # why `prefer_textbook` replaced the learnt model by the fitted textbook; empty if it did not
    replacement: str = ""
    # findings on the whole drive, from `refit_model`; None if the trial's model is kept
    final: "Findings | None" = None

    @property
    def is_linear_fit(self) -> bool:
        """True if the model is the pruned linear fit (Eq. 1 and 2), as that of an exact drive."""
        return self.base is None and not self.replacement

    @property
    def is_pruned_prediction(self) -> bool:
        """True if predictions found the model's terms, and Eq. 2 pruned them."""
        if self.base is None or self.replacement:
            return False
        return self.base.draft.library.kind is not Kind.MOTION


class StageOrderError(RuntimeError):
    """A stage lacks what an earlier stage should have found: a fault of the program."""


def require(finding: T | None, name: str, stage: str) -> T:
    """Returns a finding that `stage` makes. Raises StageOrderError if it is None."""
    if finding is None:
        raise StageOrderError(
            f"{name} is missing; put the stage {stage!r} before those that need it."
        )
    return finding


def require_samples(findings: Findings) -> Samples:
    """Returns the samples of the training part. Raises StageOrderError if they are missing."""
    return require(findings.samples, "the training part", "fit_terms")


def require_fit(findings: Findings) -> Fit:
    """Returns the pruned fit. Raises StageOrderError if it is missing."""
    return require(findings.pruned_fit, "the pruned fit", "prune_terms")


def require_model(findings: Findings) -> TaylorModel:
    """Returns the latest model. Raises StageOrderError if there is none yet."""
    return require(findings.model, "the pruned fit", "prune_terms")


def resample_drive(drive: Drive, findings: Findings) -> Samples:
    """Resamples a part of the drive on one time axis, by the calibration found so far."""
    if findings.motion_width_s is None:
        return align(drive, findings.calibration)
    return resample_motion(drive, findings.calibration, findings.motion_width_s)


def describe_stamps(drive: Drive) -> Iterator[str]:
    """Yields sentences on the stamps and the noise of the poses."""
    bursts = drive.bursts
    if bursts is not None:
        finding = f"Poses arrive in bursts of about {bursts.size:.0f} every {bursts.period_s:.3f} s"
        spread = "the samples of a burst were spread over the time since the one before"
        yield f"{finding}: their stamps are arrival times; {spread}."
    if drive.pose_noise is None:
        fix = "let the robot stand still for 2 s at first"
        yield Gap(f"The noise of the pose was not measured; {fix}.")


def measure_time_without_pose(drive: Drive) -> float:
    """Returns the time in long gaps of the pose [s]."""
    t = drive.dated.t
    spans = [float(t[row + 1] - t[row]) for row in _find_gap_rows(drive)]
    return sum(span for span in spans if span > THRESHOLDS.shortest_unseen_s)


def _find_gap_rows(drive: Drive) -> list[int]:
    """Returns the poses that precede a gap, starting with the longest gap."""
    t = drive.dated.t
    span = np.diff(t)
    usual = float(np.median(span[span > 0.0])) if (span > 0.0).any() else 0.0
    wide = span > max(MAX_GAP_S, GAP_STEPS * usual)
    if drive.recording.episodes:  # there is no motion between two episodes
        wide &= np.diff(drive.recording.episode_at(t)) == 0
    rows = np.flatnonzero(wide)
    return [int(row) for row in rows[np.argsort(-span[rows], kind="stable")]]


def describe_gaps(drive: Drive) -> Iterator[str]:
    """Yields a sentence per gap in the pose: when, how long, how far the pose moved across it."""
    t = drive.dated.t
    pose = drive.dated.values
    rows = _find_gap_rows(drive)
    for row in sorted(rows[:MOST_GAPS_LISTED]):
        moved = geometry.between(pose[row], pose[row + 1])
        span = t[row + 1] - t[row]
        begin = t[row] - t[0]
        finding = f"The pose has a gap of {span:.1f} s, from {begin:.1f} s to {begin + span:.1f} s"
        across = f"{np.hypot(*moved[:2]):.2f} m and turns {abs(moved[2]):.2f} rad"
        yield Gap(
            f"{finding}, across which it moves {across}: what happened there is not known."
        )
    if len(rows) > MOST_GAPS_LISTED:
        rest = [t[row + 1] - t[row] for row in rows[MOST_GAPS_LISTED:]]
        yield Gap(
            f"The pose has {len(rest)} more gaps, of up to {max(rest):.2f} s "
            f"and of {sum(rest):.1f} s in all."
        )


def describe_coarsest_state(
    recording: Recording, spec: RobotSpec, unmoved: Sequence[str]
) -> str:
    """Names the measured state that changes by most of its range between rows; "" if none."""
    if recording.state is None:
        return ""
    values = recording.state.values
    spread = np.ptp(np.percentile(values, ENDS, axis=0), axis=0)
    steps = np.percentile(np.abs(np.diff(values, axis=0)), ENDS[1], axis=0)
    greatest = COARSE
    name = ""
    for variable, step, size in zip(spec.state, steps, spread, strict=True):
        if size > 0.0 and variable.name not in unmoved and step / size > greatest:
            greatest = float(step / size)
            name = variable.name
    if not name:
        return ""
    apart = float(np.median(np.diff(recording.state.t)))
    finding = f"{name} changes by {greatest:.0%} of its range between rows that are {apart:.2g} s"
    return f"{finding} apart, so record at a higher rate"


def describe_clocks(
    drive: Drive, calibration: Calibration, timing: TimingEstimate
) -> Iterator[str]:
    """Yields sentences on clock offset and latency."""
    sigma = calibration.uncertainty
    recording = drive.recording
    clocks_differ = recording.pose.clock != recording.command.clock
    if clocks_differ and "clock_offset_s" in sigma:
        offset = (
            f"{calibration.clock_offset_s:.4f} s (+- {sigma['clock_offset_s']:.4f} s)"
        )
        finding = "Pose and commands are stamped by different clocks"
        yield f"{finding}: add {offset} to the pose's stamps to get the commands' clock."
    if timing.early > 0.0 and calibration.command_latency_s < timing.early:
        finding = f"The robot moves {timing.early:.2f} s before its commands"
        cause = "the pose is stamped by another clock; give it a `clock:` of its own in the mapping"
        if recording.state is not None:
            cause = "its state is stamped by another clock; stamp both by one, and record again"
        yield Mistake(f"{finding}: {cause}.")
    if timing.drift != 0.0:
        rate = f"{abs(timing.drift) * 1e3:.1f} ms in every second"
        finding = f"The clocks of pose and commands drift apart by {rate}"
        yield Mistake(
            f"{finding}: stamp both by one clock, or correct the rate of the slower one."
        )
    if not select_moved_commands(recording.command).any():
        yield Gap(
            "No command ever changed, so clock offset and latency could not be learnt."
        )
    elif not timing.separated and clocks_differ:
        why = "because no measurement on the commands' clock follows them"
        fix = "the latency is taken as zero. Record the wheels or the state to separate them"
        yield Gap(
            f"Only the sum of clock offset and command latency can be known, {why}; {fix}."
        )
    latency = calibration.command_latency_s
    spread = sigma.get("command_latency_s", np.inf)
    if timing.separated and latency > CERTAIN * spread:
        yield f"Commands take effect {latency:.4f} s (+- {spread:.4f} s) after their stamps."


def describe_mounting(
    drive: Drive, calibration: Calibration, mounting: Mounting | None
) -> Iterator[str]:
    """Yields sentences on the position and rotation of the tracked body on the robot."""
    if mounting is None:
        taken = "is taken to be exactly at base_link; drive in every direction and turn"
        yield Gap(
            f"How the tracked body sits on the robot could not be learnt, and {taken}."
        )
        return
    x, y = calibration.lever_arm_m
    x_hidden, y_hidden = mounting.hidden
    # predictions may have found one later
    if "lever_arm_x_m" in calibration.uncertainty:
        x_hidden = ""
    if "lever_arm_y_m" in calibration.uncertainty:
        y_hidden = ""
    if calibration.rotation_rad != 0.0:
        sigma = calibration.uncertainty.get("rotation_rad", mounting.rotation_sigma)
        turned = f"{calibration.rotation_rad:.4f} rad (+- {sigma:.4f} rad)"
        finding = (
            f"The direction of travel lies {turned} from the tracked body's heading"
        )
        if faces_backwards(calibration) and not drive.spec.steers:
            yield Doubt(
                f"{finding}: the body faces backwards, or the speed that is commanded has the "
                "wrong sign (the drive does not show which)."
            )
        else:
            yield f"{finding}."
    if x_hidden:
        finding = f"Where the tracked point lies on the robot could not be learnt, since {x_hidden}"
        advice = "it is taken as base_link, and the rotation holds for this curvature"
        drive_so = "drive left, right and straight, forwards and backwards, to learn it"
        yield Gap(f"{finding}: {advice}; {drive_so}.")
    elif (x, y) != (0.0, 0.0):
        yield f"The tracked point lies at x {x:.4f} m, y {y:.4f} m of base_link."
    if y_hidden and not x_hidden and not drive.spec.moves_sideways:
        why = f"since {y_hidden}; it is taken as zero"
        yield f"The tracked point's place along y could not be learnt, {why}."


def faces_backwards(calibration: Calibration) -> bool:
    """True if the robot travels in the direction that the back of the tracked body faces."""
    return bool(abs(geometry.wrap_angle(calibration.rotation_rad - np.pi)) < BACKWARDS)


def describe_responses(
    drive: Drive, calibration: Calibration, timing: TimingEstimate
) -> Iterator[str]:
    """Yields sentences on unmeasured states and the wheels."""
    moved = select_moved_commands(drive.recording.command)
    names = [c.name for c, m in zip(drive.spec.command, moved, strict=True) if m]
    for response, sigma in zip(calibration.responses, timing.lag_sigma, strict=True):
        state = response.state
        command = response.command
        if command not in names:
            finding = f"{command} never changed, so how {state} follows it could not be learnt"
            yield Gap(f"{finding}; drive with {command} changing over its whole range.")
        else:
            error = calibration.uncertainty.get(f"{state}.lag", sigma)
            lag = f"{response.lag_s:.4f} s"
            if not np.isnan(error):
                lag += f" (+- {error:.4f} s)"
            taken = f"with a lag of {lag} and a gain of {response.gain:.4f}"
            yield f"{state} was not measured: it is taken to follow {command} {taken}."
    yield from _describe_wheels(calibration)


def _describe_wheels(calibration: Calibration) -> Iterator[str]:
    """Yields sentences on the scale of the wheels, and on interchanged ones."""
    if calibration.wheel_scale is not None:
        scale = calibration.wheel_scale
        sigma = calibration.uncertainty["wheel_scale"]
        yield f"A unit of the wheels' speed is {scale:.4g} m/s (+- {sigma:.2g} m/s)."
    if calibration.wheels_swapped:
        why = "is the faster one when the robot turns left, and the slower one when it turns right"
        yield f"Left and right wheel look interchanged: the wheel recorded as the left one {why}."


def name_sum(state: str) -> str:
    """Returns the name of the uncertainty of a latency and a lag together."""
    return f"command_latency_and_{state}_lag_s"


def describe_sums(calibration: Calibration) -> Iterator[str]:
    """Yields a sentence on latencies and lags that could not be separated."""
    commands = [response.command for response in calibration.responses]
    further = delays(commands, calibration.inputs).tolist()
    for response, delay in zip(calibration.responses, further, strict=True):
        sigma = calibration.uncertainty.get(name_sum(response.state))
        if sigma is not None and not np.isnan(sigma):
            both = calibration.command_latency_s + delay + response.lag_s
            finding = f"Latency and the lag of {response.state} can hardly be separated"
            yield f"{finding}: trust their sum, {both:.4f} s (+- {sigma:.4f} s)."


def refuse_unexcited(excitation: Excitation, spec: RobotSpec) -> None:
    """Refuses a drive, with a FitError, that did not move every input independently."""
    sensed = [
        v.name for v in spec.state if v.twist is None and v.name in excitation.unmoved
    ]
    still = _list_commands(excitation.unmoved, spec) or sensed
    for names, fault, way in (
        (still, "never moved", "changing over the whole range"),
        (excitation.together, "always moved together", "each changing on its own"),
    ):
        listed = _join_names(names)
        if listed:
            raise FitError(
                f"{listed} {fault}; drive with {listed} {way}, or allow a model without."
            )


def list_missed(linear: Fit, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the variables that never moved, except sideways slip if it can't be commanded."""
    slips = [v.name for v in spec.state if v.twist == "vy" and not spec.moves_sideways]
    return tuple(
        name for name in linear.regression.excitation.unmoved if name not in slips
    )


def _list_commands(names: Sequence[str], spec: RobotSpec) -> list[str]:
    """Returns the names that are commands, which a driver can move."""
    return [c.name for c in spec.command if c.name in names]


def count_levels(command: Stream, spec: RobotSpec) -> dict[str, int]:
    """Returns the number of different values of each command as recorded."""
    columns = zip(spec.command, command.values.T, strict=True)
    return {c.name: len(np.unique(np.round(values, 9))) for c, values in columns}


def describe_unlearnt(
    linear: Fit, calibration: Calibration, spec: RobotSpec, levels: dict[str, int]
) -> Iterator[str]:
    """Yields sentences on inputs not moved, alone or at many levels, and dependent states.

    `levels` are the numbers of different values of the commands as recorded, because a motor that
    saturates reduces many values to two.
    """
    excitation = linear.regression.excitation
    yield from _describe_unmoved(linear, calibration, spec)
    yield from _describe_together(excitation, spec)
    dependent = linear.regression.dependent
    copies = _join_names([v.name for v in spec.state if v.name in dependent])
    if copies:
        why = "always depended on the other variables, so their effects can't be separated"
        yield Gap(
            f"{copies} {why}: the model omits them, and is valid only while that is so."
        )
    coarse = _join_names(
        [
            name
            for name, count in levels.items()
            if count == FEW_LEVELS and name not in excitation.unmoved
        ]
    )
    if coarse:
        finding = "between them the model is a straight line, whatever the robot does"
        yield Gap(
            f"{coarse} took only two values: {finding}; drive with values in between."
        )


def _describe_together(excitation: Excitation, spec: RobotSpec) -> Iterator[str]:
    """Yields a sentence on commands that always moved together."""
    together = _join_names(excitation.together)
    if together:
        units = {c.unit for c in spec.command if c.name in excitation.together}
        shares = "all have a share of it" if len(units) == 1 else "one has all of it"
        why = "always moved together, so their effects can't be separated"
        valid = "the model holds where they move together"
        yield Gap(
            f"{together} {why}: {shares}, and {valid}; drive each on its own to learn."
        )


def _describe_unmoved(
    linear: Fit, calibration: Calibration, spec: RobotSpec
) -> Iterator[str]:
    """Yields sentences on variables that never moved."""
    unmoved = ", ".join(list_missed(linear, spec))
    if unmoved:
        finding = f"The model has no terms of {unmoved}, which never moved"
        yield Gap(f"{finding}: it is only valid for this drive's constant value.")
    followed = {response.command for response in calibration.responses}
    still = _list_commands(linear.regression.excitation.unmoved, spec)
    missing = ", ".join(name for name in still if name not in followed)
    if missing:
        yield Gap(f"Drive with {missing} changing over the whole range to learn them.")


def list_doubts_of_fit(linear: Fit, exact: bool) -> Iterator[str]:
    """Yields each reason to doubt a linear fit."""
    dofs = linear.model.dofs
    for dof, outliers, condition in zip(
        dofs, linear.outliers, linear.condition, strict=True
    ):
        if outliers > MANY_OUTLIERS:
            yield f"{outliers:.1%} of the rows of {dof} were outliers and left out of the fit."
        if condition > ILL_CONDITIONED:
            alike = f"nearly copies of each other on this drive (condition number {condition:.1g})"
            advice = "lower the order or drive with more variety"
            useless = "their individual coefficients mean little"
            yield f"The terms of {dof} are {alike}: {useless}; {advice}."
    fitted = {dofs[d] for d in linear.regression.moving} - {"vy"} if exact else set()
    explained = zip(dofs, linear.r2, strict=True)
    lost = _join_names(
        [dof for dof, share in explained if share < UNEXPLAINED and dof in fitted]
    )
    if lost:
        why = "the robot did not follow its commands in a way that a polynomial can describe"
        yield f"The model explains less than half of {lost}: {why}; do not trust its predictions."


def _join_names(names: Sequence[str]) -> str:
    """Joins names: `a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def describe_mirror_image(
    samples: Samples, spec: RobotSpec, calibration: Calibration
) -> Iterator[str]:
    """Yields a sentence if the robot turns against its command, and which sign explains it."""
    for i, command in enumerate(spec.command, start=len(spec.state)):
        if not command.turns:
            continue
        turn = samples.dq[:, 2]
        wanted = samples.x[:, i]
        if command.steers:
            wanted = wanted * np.sign(samples.dq[:, 0])
        if (
            min(turn.std(), wanted.std()) < 1e-3
            or np.corrcoef(turn, wanted)[0, 1] > MIRRORED
        ):
            continue
        if command.steers and faces_backwards(calibration):
            speed = next((c.name for c in spec.command if not c.turns), "the speed")
            finding = f"The robot drives backwards where {speed} is positive"
            yield Mistake(
                f"{finding}: the sign of {speed} is reversed; write `scale: -1` for it."
            )
            return
        finding = f"The robot turns right where {command.name} is positive"
        cause = (
            "the recording is a mirror image (y and heading reversed), or the sign of"
        )
        yield Mistake(
            f"{finding}: {cause} the command is; the model moves as recorded."
        )
        return


def try_model(
    model: TaylorModel, calibration: Calibration, drive: Drive, t: float
) -> OpenLoop | None:
    """Tries a model on a drive from t [s] on; None if the rest is too short."""
    try:
        return measure_open_loop_error(model, calibration, drive, t, drive.duration_s)
    except RecordingError:
        return None


def is_worse(error_m: float, reference_m: float) -> bool:
    """True if an error [m] clearly exceeds a reference [m], or is not a number."""
    return bool(np.isnan(error_m)) or error_m > WORSE * reference_m


def describe_untried(
    drive: Drive, held_out: OpenLoop | None, judgement: tuple[HorizonErrors, ...]
) -> Iterator[str]:
    """Yields a sentence if a drive is too short to try a model on unseen data, or on 5 s."""
    if held_out is None:
        shown = "the model was not tried on unseen data"
        if judgement:
            shown = f"the model was only tried over {judgement[-1].horizon_s:g} s"
        left = max(drive.duration_s - drive.settings.train_until_s, 0.0)
        yield Gap(
            f"The last {left:.1f} s, held out of the fit, are too short for a prediction over "
            f"{HORIZON_S:g} s: {shown}; record 20 s or more."
        )


def add_quality(
    model: TaylorModel,
    linear: Fit,
    unseen: Samples | None,
    held_out: OpenLoop | None,
    judgement: tuple[HorizonErrors, ...],
    spec: RobotSpec,
) -> TaylorModel:
    """Returns the model with its quality figures."""

    def by_dof(values: Array) -> dict[str, float]:
        return {
            dof: float(value) for dof, value in zip(model.dofs, values, strict=True)
        }

    figures: dict[str, Any] = {
        "held_out_rmse": {},
        "held_out_r2": {},
        "judgement": judgement,
    }
    if unseen is not None:
        errors = map(
            by_dof,
            measure_rate_errors(
                model, unseen.rows(select_plausible_rows(unseen.x, spec))
            ),
        )
        figures |= zip(("held_out_rmse", "held_out_r2"), errors, strict=True)
    if held_out is not None:
        figures |= {
            "open_loop_horizon_s": held_out.horizon_s,
            "open_loop_position_error_m": held_out.mean_position_error_m,
            "open_loop_heading_error_rad": held_out.mean_heading_error_rad,
            "open_loop_path_m": held_out.mean_path_m,
        }
    measures = ("outliers", "condition", "rmse", "r2")
    figures |= {name: by_dof(getattr(linear, name)) for name in measures}
    return replace(
        model, quality=Quality(samples=len(linear.regression.samples.t), **figures)
    )


def describe_replacement(lost: HorizonErrors) -> str:
    """Formats a sentence on a model that lost to its textbook and was replaced by it."""
    if lost.textbook is None:
        return ""
    off = f"{lost.model.position_m:.3g} m off after {lost.horizon_s:g} s"
    finding = f"The learnt model ends {off}, the fitted textbook "
    finding += f"{lost.textbook.position_m:.3g} m, on the same unseen data"
    written = "the model written is the textbook, fitted to the training part"
    bias = "since these data chose it, its errors on them are slightly optimistic"
    return f"{finding}: {written}; {bias}."


def describe_refit(until: float, duration: float, worse: bool) -> str:
    """States how much of a drive a model covers, and what its errors refer to."""
    if worse:
        why = (
            f"fitted to all {duration:.1f} s, it was not shown to predict them as well"
        )
        return f"The model covers only the first {until:.1f} s: {why}."
    shown = f"errors on unseen data are those of a trial that had learnt the first {until:.1f} s"
    return f"The model was fitted to all {duration:.1f} s once it had been judged; {shown}."


class ErrorOfRecording(NamedTuple):
    """Mean errors of predictions within one recording."""

    source: str
    horizon_s: float
    position_m: float
    path_m: float  # mean length of the measured path

    @property
    def share(self) -> float:
        """Error as a fraction of the path."""
        return self.position_m / max(self.path_m, 1e-9)


def measure_errors_by_recording(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> list[ErrorOfRecording]:
    """Predicts each recording of a drive over the longest horizon that fits into all of them."""
    sources = [episode.source for episode in drive.recording.episodes]
    for horizon in HORIZONS_OF_RECORDING_S:
        chosen = select_windows(
            drive, calibration, 0.0, drive.duration_s, horizon, SPACING_OF_RECORDING_S
        )
        if not len(chosen.start_t):
            continue
        sources_of_windows = np.array(sources)[
            drive.recording.episode_at(chosen.start_t)
        ]
        if any(
            (sources_of_windows == source).sum() < FEWEST_OF_RECORDING
            for source in sources
        ):
            continue
        ends = predict(model, calibration, drive, chosen)
        error = np.hypot(*(ends - chosen.end)[:, :2].T)
        return [
            ErrorOfRecording(
                source,
                horizon,
                float(error[sources_of_windows == source].mean()),
                float(chosen.path[sources_of_windows == source].mean()),
            )
            for source in dict.fromkeys(sources)
        ]
    return []


def describe_recordings(
    model: TaylorModel, calibration: Calibration, drive: Drive
) -> Iterator[str]:
    """Yields a sentence on the errors by recording, and one per recording that alone is off."""
    if not drive.recording.episodes:
        return
    errors = measure_errors_by_recording(model, calibration, drive)
    if len(errors) < 2:
        return
    for error in errors:
        others = [another for another in errors if another is not error]
        usual = float(np.median([another.share for another in others]))
        if error.share > max(ALONE * usual, LEAST_SHARE) and np.isfinite(usual):
            ends = f"end {error.position_m:.3g} m off after {error.horizon_s:g} s"
            shares = f"{error.share:.1%} of the path, those of the others {usual:.1%}"
            finding = f"{error.source} alone is off: its predictions {ends} ({shares})"
            causes = "its clocks, its mounting and the floor it was driven on"
            yield Alone(f"{finding}; check {causes}, or leave it out.")
    listed = ", ".join(f"{error.source} {error.share:.1%}" for error in errors)
    yield f"By recording, errors after {errors[0].horizon_s:g} s as shares of the path: {listed}."


def collect_notes(drive: Drive, findings: Findings) -> tuple[str, ...]:
    """Collects all sentences on a drive and its model, the most serious first."""
    fit = require_fit(findings)
    model = require_model(findings)
    spec = drive.spec
    calibration = findings.calibration
    beaten = [findings.replacement]
    if not findings.replacement:
        beaten = list(describe_shortfall(findings.judgement))
    doubts: Iterator[str] = iter(())
    if findings.motion_width_s is None:
        doubts = list_doubts_of_fit(fit, calibration.is_exact)
    levels = count_levels(findings.training.recording.command, spec)
    return (
        *describe_recordings(model, calibration, findings.whole),
        *beaten,
        *_explain_replacement(drive, findings),
        *drive.recording.repairs,
        *findings.repairs,
        *describe_gaps(findings.whole),
        *collect_calibration_notes(findings),
        *findings.refinement,
        *describe_mirror_image(require_samples(findings), spec, calibration),
        *describe_unlearnt(fit, calibration, spec, levels),
        *doubts,
        *describe_untried(drive, findings.held_out, findings.judgement),
        *findings.assumptions,
    )


def collect_calibration_notes(findings: Findings) -> tuple[str, ...]:
    """Collects the sentences on stamps, clocks, mounting and responses."""
    training = findings.training
    calibration = findings.calibration
    if findings.replacement:
        # The latency is that of the fitted textbook, as are mounting and lags, which it explains.
        calibration = replace(calibration, command_latency_s=findings.timing.latency)
        return (
            *describe_stamps(training),
            *describe_clocks(training, calibration, findings.timing),
        )
    return (
        *describe_stamps(training),
        *describe_clocks(training, calibration, findings.timing),
        *describe_sums(calibration),
        *describe_mounting(training, calibration, findings.mounting),
        *describe_responses(training, calibration, findings.timing),
    )


def list_plain_calibration_notes(findings: Findings) -> tuple[str, ...]:
    """Returns these sentences as plain strings for a file, which has no kinds of sentences."""
    return tuple(map(str, collect_calibration_notes(findings)))


def _explain_replacement(drive: Drive, findings: Findings) -> Iterator[str]:
    """Yields a sentence if a coarse sampling rate explains why a model lost to its textbook."""
    if not findings.replacement or drive.recording.state is None:
        return
    whole = findings.whole
    unmoved = require_fit(findings).unmoved
    coarse = describe_coarsest_state(whole.recording, whole.spec, unmoved)
    if coarse:
        yield Gap(f"{coarse}.")
