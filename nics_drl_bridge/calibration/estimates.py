"""The list of all that a calibration can estimate: value and uncertainty, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass

from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.report import Findings
from nics_drl_bridge.kinematics.recording import Recording


@dataclass(frozen=True)
class Estimate:
    """One estimate.

    Attributes:
        name: in words.
        value: None if it was not possible.
        sigma: standard uncertainty; None where there is none.
        unit: of both.
        remark: why it was not possible, or what it means.
    """

    name: str
    value: float | None
    sigma: float | None
    unit: str
    remark: str = ""

    @property
    def text(self) -> str:
        """`command latency 0.0825 +- 0.0072 s`."""
        if not self.unit and self.value is not None:
            return f"{self.name}: {self.remark}"
        if self.value is None:
            return f"{self.name}: not estimated, {self.remark}"
        spread = "" if self.sigma is None else f" +- {self.sigma:.2g}"
        remark = f" ({self.remark})" if self.remark else ""
        return f"{self.name} {self.value:.4g}{spread} {self.unit}{remark}"


def estimates(
    recording: Recording, calibration: Calibration, findings: Findings
) -> dict[str, Estimate]:
    """All estimates by the name in `Calibration`."""
    return {
        **_timing(recording, calibration, findings),
        **_mounting(calibration, findings),
        **_wheels(recording, calibration),
    }


def _timing(
    recording: Recording, calibration: Calibration, findings: Findings
) -> dict[str, Estimate]:
    sigma = calibration.uncertainty
    offset = Estimate("clock offset", None, None, "s", "pose and commands are on one clock")
    if "clock_offset_s" in sigma:
        value = calibration.clock_offset_s
        offset = Estimate("clock offset", value, sigma["clock_offset_s"], "s")
    elif findings.clocks_differ:
        offset = Estimate("clock offset", None, None, "s", "no command changed")
    why = "no command changed"
    if "clock_offset_s" in sigma:
        why = "only its sum with the clock offset is known"
    latency = Estimate("command latency", None, None, "s", why)
    if "command_latency_s" in sigma:
        value = calibration.command_latency_s
        latency = Estimate("command latency", value, sigma["command_latency_s"], "s")
    bursts = Estimate("period of bursts", None, None, "s", "the poses are stamped one by one")
    if calibration.burst_period_s > 0.0:
        bursts = Estimate("period of bursts", calibration.burst_period_s, None, "s")
    return {"clock_offset_s": offset, "command_latency_s": latency, "burst_period_s": bursts}


def _mounting(calibration: Calibration, findings: Findings) -> dict[str, Estimate]:
    names = {
        "rotation_rad": ("rotation of base_link", calibration.rotation_rad, "rad"),
        "lever_arm_x_m": ("lever arm x", calibration.lever_arm_m[0], "m"),
        "lever_arm_y_m": ("lever arm y", calibration.lever_arm_m[1], "m"),
    }
    why = "the drive shows too few directions of motion"
    if findings.mounting is not None and not findings.mounting.turns:
        why = "the robot never turned"
    found = {}
    for key, (name, value, unit) in names.items():
        sigma = calibration.uncertainty.get(key)
        if sigma is None:
            found[key] = Estimate(name, None, None, unit, why)
        else:
            remark = "below its uncertainty: taken as zero" if value == 0.0 else ""
            found[key] = Estimate(name, value, sigma, unit, remark)
    return found


def _wheels(recording: Recording, calibration: Calibration) -> dict[str, Estimate]:
    why = "no wheel speeds were recorded"
    if recording.wheels is not None:
        why = "the wheels do not show it"
    rows = {
        "wheel_scale": ("wheel scale", calibration.wheel_scale, "m/s per unit"),
        "turn_scale": ("turn scale", calibration.turn_scale, "rad/s per unit"),
    }
    found = {}
    for key, (name, value, unit) in rows.items():
        sigma = calibration.uncertainty.get(key)
        found[key] = Estimate(name, value, sigma, unit, why if value is None else "")
    swapped = calibration.wheels_swapped
    known = None if swapped is None else float(swapped)
    meaning = {None: why, True: "left and right are interchanged", False: "as named"}[swapped]
    found["wheels_swapped"] = Estimate("swapped wheels", known, None, "", meaning)
    return found
