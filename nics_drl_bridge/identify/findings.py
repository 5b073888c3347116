"""Findings: what the stages of an identification know so far, as one frozen record."""

from dataclasses import dataclass, field
from typing import TypeVar

from nics_drl_bridge.identify import clocks, hypotheses
from nics_drl_bridge.identify.alignment import align, resample_motion
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.fit import Fit, Regression
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.identify.open_loop import OpenLoop
from nics_drl_bridge.identify.terms import Kind
from nics_drl_bridge.identify.yardstick import Yardstick
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.taylor import HorizonErrors, TaylorModel

T = TypeVar("T")


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
