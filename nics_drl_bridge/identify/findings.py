"""Sentences on the findings of a calibration and on what could not be learnt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.identify.repair import Bursts
from nics_drl_bridge.robot.spec import RobotSpec


@dataclass(frozen=True)
class Findings:
    """Findings for the sentences, in addition to the calibration's values.

    Attributes:
        bursts: of the pose's stamps.
        noise_known: True if the pose's noise could be measured.
        separated: True if clock offset and latency could be separated.
        clocks_differ: True if pose and commands are on different clocks.
        lag_sigma: (S,) uncertainty of the lags [s]; NaN for a nominal one.
        mounting: None if it could not be learnt.
        unmoved: commands that never changed.
    """

    bursts: Bursts | None
    noise_known: bool
    separated: bool
    clocks_differ: bool
    lag_sigma: NDArray[np.float64]
    mounting: Mounting | None
    unmoved: tuple[str, ...]


def sentences(calibration: Calibration, found: Findings, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the notes of a calibration."""
    return (
        *_about_stamps(calibration, found),
        *_about_clocks(calibration, found, len(spec.command)),
        *_about_mounting(calibration, found, spec),
        *_about_responses(calibration, found),
        *_about_wheels(calibration),
    )


def _about_stamps(calibration: Calibration, found: Findings) -> list[str]:
    notes = []
    if found.bursts is not None:
        notes.append(
            f"The poses arrive in bursts of about {found.bursts.size:.0f} every "
            f"{found.bursts.period_s:.3f} s: their stamps are arrival times; the samples of a "
            "burst were spread over the time since the one before."
        )
    if not found.noise_known:
        notes.append(
            "The noise of the pose could not be measured; let the robot stand still for 2 s at the "
            "start."
        )
    return notes


def _about_clocks(calibration: Calibration, found: Findings, commands: int) -> list[str]:
    c, sigma = calibration, calibration.uncertainty
    notes = []
    if found.clocks_differ and "clock_offset_s" in sigma:
        notes.append(
            f"Pose and commands are stamped by different clocks: {c.clock_offset_s:.4f} s (+- "
            f"{sigma['clock_offset_s']:.4f} s) added to the pose's stamps gives the commands' "
            "clock."
        )
    if found.unmoved and len(found.unmoved) == commands:
        notes.append("No command ever changed, so clock offset and latency could not be learnt.")
    elif not found.separated and found.clocks_differ:
        notes.append(
            "Only the sum of clock offset and command latency can be known, since nothing measured "
            "on the commands' clock follows them; the latency is taken as zero. Record the wheels "
            "or the state to tell them apart."
        )
    if found.separated and c.command_latency_s > 0.0:
        notes.append(
            f"Commands take effect {c.command_latency_s:.4f} s (+- "
            f"{sigma['command_latency_s']:.4f} s) after their stamps."
        )
    return notes


def _about_mounting(calibration: Calibration, found: Findings, spec: RobotSpec) -> list[str]:
    c, mounting, notes = calibration, found.mounting, []
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
    lateral = spec.moves_sideways
    if not np.isnan(mounting.lever_sigma[0]) and np.isnan(mounting.lever_sigma[1]) and not lateral:
        notes.append(
            "The tracked point's place along y could not be learnt, since no speed was known "
            "apart from the tracked one; it is taken as zero."
        )
    return notes


def _about_responses(calibration: Calibration, found: Findings) -> list[str]:
    notes = []
    for response, sigma in zip(calibration.responses, found.lag_sigma, strict=True):
        if response.command in found.unmoved:
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
