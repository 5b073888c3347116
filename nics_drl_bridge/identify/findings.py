"""Findings: all that the stages of an identification have found so far, its result, sentences."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.clocks import TimingEstimate
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.fit import Alpha, Fit, Regression
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.identify.open_loop import OpenLoop
from nics_drl_bridge.identify.signals import moved_commands
from nics_drl_bridge.recording.recording import Recording, Samples
from nics_drl_bridge.robot.noise import Noise
from nics_drl_bridge.robot.taylor import TaylorModel

T = TypeVar("T")


@dataclass(frozen=True)
class Findings:
    """Findings of the stages, in their order; None, empty or the default until they have run.

    Attributes:
        training: the part of the drive to learn from; repaired by `repair`.
        whole: the whole drive; repaired by `repair`.
        timing: clock offset, latency [s] and lags (S,) [s], of `clocks`; nominal before.
        repairs: sentences of `repair`.
        speed: (n,) expected along the direction of travel over the intervals of the training
            part's twists [m/s], of `mounting`; None too if no state is such a speed.
        mounting: of `mounting` [m, rad]; None too if it could not be learnt.
        calibration: of `clocks`, `mounting`, `responses` and `noise`; then of `refine`.
        noise: of sensors and motion; the pose sensor's of `noise`, the rest of `judge`.
        samples: of the training part on one time axis, of `fit`.
        regression: on all features (Eq. 1), of `fit`.
        linear: the pruned fit (Eq. 2), of `prune`.
        model: of `prune`; then of `refine` and `complete`.
        refinement: sentences of `refine`.
        assumptions: sentences of `complete`.
        unseen: samples of the part that the fit did not see, of `judge`; None too if too few.
        held_out: open-loop errors on that part, of `judge`; None too if it is too short.
        notes: all sentences, of `judge`.
    """

    training: Drive
    whole: Drive
    timing: TimingEstimate
    repairs: tuple[str, ...] = ()
    speed: NDArray[np.float64] | None = None
    mounting: Mounting | None = None
    calibration: Calibration = field(default_factory=Calibration)
    noise: Noise = field(default_factory=Noise)
    samples: Samples | None = None
    regression: Regression | None = None
    linear: Fit | None = None
    model: TaylorModel | None = None
    refinement: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    unseen: Samples | None = None
    held_out: OpenLoop | None = None
    notes: tuple[str, ...] = ()


def known(found: T | None, name: str, stage: str) -> T:
    """Returns a finding that a later stage can't do without.

    Raises:
        FitError: it is missing; names the stage that finds it.
    """
    if found is None:
        raise FitError(f"{name} is missing; put the stage {stage!r} before those that need it.")
    return found


@dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        drive: the whole drive, repaired.
        model: the model, refined and, on request, completed by assumption, with standard
            errors and quality.
        calibration: of the drive.
        fit: the linear fit, before refinement.
        samples: the samples that the fit used.
        unseen: samples of the part that the fit did not see; None if there are too few.
        held_out: open-loop errors on that part; None if it was too short.
        noise: of sensors and motion, each level measured or assumed.
        findings: of all stages.
        notes: sentences on findings, on what could not be learnt and on assumptions.
    """

    drive: Drive
    model: TaylorModel
    calibration: Calibration
    fit: Fit
    samples: Samples
    unseen: Samples | None
    held_out: OpenLoop | None
    noise: Noise
    findings: Findings
    notes: tuple[str, ...]

    @property
    def recording(self) -> Recording:
        """The whole recording, repaired."""
        return self.drive.recording

    @property
    def train_until_s(self) -> float:
        """End of the training part, from the drive's first pose [s]."""
        return self.drive.settings.train_until_s

    @property
    def alpha(self) -> Alpha:
        """Threshold of the pruning; `auto` for the knee of the accuracy curve."""
        return self.drive.settings.alpha


def sentences(findings: Findings) -> tuple[str, ...]:
    """Returns the notes on a calibration."""
    return (
        *_about_stamps(findings.training),
        *_about_clocks(findings),
        *_about_mounting(findings),
        *_about_responses(findings),
        *_about_wheels(findings.calibration),
    )


def _about_stamps(drive: Drive) -> list[str]:
    notes = []
    if drive.bursts is not None:
        notes.append(
            f"The poses arrive in bursts of about {drive.bursts.size:.0f} every "
            f"{drive.bursts.period_s:.3f} s: their stamps are arrival times; the samples of a "
            "burst were spread over the time since the one before."
        )
    if drive.pose_noise is None:
        notes.append(
            "The noise of the pose could not be measured; let the robot stand still for 2 s at the "
            "start."
        )
    return notes


def _about_clocks(found: Findings) -> list[str]:
    c, sigma, recording = found.calibration, found.calibration.uncertainty, found.training.recording
    clocks_differ = recording.pose.clock != recording.command.clock
    notes = []
    if clocks_differ and "clock_offset_s" in sigma:
        notes.append(
            f"Pose and commands are stamped by different clocks: {c.clock_offset_s:.4f} s (+- "
            f"{sigma['clock_offset_s']:.4f} s) added to the pose's stamps gives the commands' "
            "clock."
        )
    if not moved_commands(recording.command).any():
        notes.append("No command ever changed, so clock offset and latency could not be learnt.")
    elif not found.timing.separated and clocks_differ:
        notes.append(
            "Only the sum of clock offset and command latency can be known, since nothing measured "
            "on the commands' clock follows them; the latency is taken as zero. Record the wheels "
            "or the state to tell them apart."
        )
    if found.timing.separated and c.command_latency_s > 0.0:
        notes.append(
            f"Commands take effect {c.command_latency_s:.4f} s (+- "
            f"{sigma['command_latency_s']:.4f} s) after their stamps."
        )
    return notes


def _about_mounting(found: Findings) -> list[str]:
    c, mounting, notes = found.calibration, found.mounting, []
    if mounting is None:
        return [
            "How the tracked body sits on the robot could not be learnt, and is taken to be "
            "exactly at base_link; drive in every direction and turn."
        ]
    if c.rotation_rad != 0.0:
        sigma = c.uncertainty.get("rotation_rad", mounting.rotation_sigma)
        notes.append(
            f"The direction of travel lies {c.rotation_rad:.4f} rad (+- "
            f"{sigma:.4f} rad) from the tracked body's heading."
        )
    if np.isnan(mounting.lever_sigma[0]):
        why = "all of the path had one curvature" if mounting.turns else "the robot never turned"
        notes.append(
            f"Where the tracked point lies on the robot could not be learnt, since {why}: it is "
            "taken as base_link, and the rotation holds for this curvature; drive left, right and "
            "straight on to learn it."
        )
    elif c.lever_arm_m != (0.0, 0.0):
        x, y = c.lever_arm_m
        notes.append(f"The tracked point lies at x {x:.4f} m, y {y:.4f} m of base_link.")
    known_x, known_y = ~np.isnan(mounting.lever_sigma)
    if known_x and not known_y and not found.training.spec.moves_sideways:
        notes.append(
            "The tracked point's place along y could not be learnt, since no speed was known "
            "apart from the tracked one; it is taken as zero."
        )
    return notes


def _about_responses(found: Findings) -> list[str]:
    notes = []
    moved = moved_commands(found.training.recording.command)
    names = [c.name for c, m in zip(found.training.spec.command, moved, strict=True) if m]
    for response, sigma in zip(found.calibration.responses, found.timing.lag_sigma, strict=False):
        if response.command not in names:
            notes.append(
                f"{response.command} never changed, so how {response.state} follows it could not "
                f"be learnt; drive with {response.command} changing over its whole range."
            )
        else:
            spread = "" if np.isnan(sigma) else f" (+- {sigma:.4f} s)"
            notes.append(
                f"{response.state} was not measured: it is taken to follow {response.command} with "
                f"a lag of {response.lag_s:.4f} s{spread} and a gain of {response.gain:.4f}."
            )
    return notes


def _about_wheels(calibration: Calibration) -> list[str]:
    notes = []
    if calibration.wheel_scale is not None:
        sigma = calibration.uncertainty["wheel_scale"]
        notes.append(
            f"A unit of the wheels' speed is {calibration.wheel_scale:.4g} m/s (+- {sigma:.2g} "
            "m/s)."
        )
    if calibration.wheels_swapped:
        notes += [
            "Left and right wheel look interchanged: the wheel recorded as the left one is the "
            "faster one when the robot turns left, and the slower one when it turns right."
        ]
    return notes
