"""Fit report: the model's equations, the quality of its fit, and what could not be learnt.

Every estimate of a calibration is listed: value and uncertainty, or why there is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from textwrap import fill

import numpy as np

from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.fit import Alpha
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.mounting import Mounting
from nics_drl_bridge.identify.open_loop import OpenLoop
from nics_drl_bridge.identify.statistics import Curve
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

WIDTH = 96
CURVE_POINTS = 8


def fit_report(source: str, spec: RobotSpec, identified: Identified) -> str:
    """Returns the report as human-readable text.

    Args:
        source: where the recording came from.
        spec: the robot.
        identified: the result of the identification.
    """
    model = identified.model
    lines = [
        f"Fit report: robot {spec.name!r} from {source}",
        "",
        f"Kept {model.terms_kept} of {identified.fit.terms_total} terms, step {model.dt:g} s "
        f"(X = {', '.join(model.variables)}), with standard errors:",
        *(f"  {equation}" for equation in equations_with_errors(model)),
        "",
        *_pruning(identified.alpha),
        "",
        "Cross-validated error against the number of terms, largest first, * for those kept:",
        *(f"  {line}" for curve in identified.fit.curves for line in _curve(curve)),
        "",
        "Error of the linear fit per degree of freedom, on the part it was fitted to:",
        *_errors(identified),
        "",
        f"Open loop, on data held out from the fit (after {identified.train_until_s:.1f} s):",
        *_open_loop(identified.held_out),
        *_held_out_rates(model),
        "",
        "Valid where the drive was:",
        *_box(model, spec),
        "",
        "Calibration (standard uncertainties):",
        *_calibration(identified),
        "",
        "Noise that the simulator and the estimator use (standard deviations):",
        *(f"  {line}" for line in identified.noise.sentences()),
        "",
        *_latency(identified),
        "Found, and not learnt:",
        *(_item(note) for note in identified.notes or ("Nothing had to be corrected.",)),
    ]
    return "\n".join(lines) + "\n"


def _latency(identified: Identified) -> list[str]:
    lines = identified.recording.latency.sentences()
    head = "Latency of the device, which simulator_node has too:"
    return [head, *(f"  {line}" for line in lines), ""] if lines else []


def equations_with_errors(model: TaylorModel) -> list[str]:
    """Returns one line per degree of freedom: `wz = (4.63 +- 0.02)*speed*steering  [rad/s]`."""
    errors, names, lines = model.named_errors, model.term_names, []
    for d, dof in enumerate(model.dofs):
        text = ""
        for k in np.flatnonzero(model.coefficients[d]):
            value, name = float(model.coefficients[d, k]), names[k]
            sign = ("-" if value < 0 else "") if not text else (" - " if value < 0 else " + ")
            mark = " (assumed)" if (dof, name) in model.assumed else ""
            number = with_error(abs(value), errors.get(dof, {}).get(name))
            text += f"{sign}{number}" + ("" if name == "1" else f"*{name}") + mark
        lines.append(f"{dof} = {text or '0'}  [{model.dof_units[d]}]")
    return lines


def with_error(value: float, error: float | None) -> str:
    """Formats a number to the digits that its standard error leaves: `(4.63 +- 0.02)`.

    An error that begins with a 1 has two digits. A mere rounding error is not shown.
    """
    if error is None or error <= 1e-6 * value:
        return f"{value:.5g}"
    exponent = int(np.floor(np.log10(error)))
    leading = error / 10.0**exponent
    digits = max(0, -exponent + (leading < 1.95 or leading >= 9.5))
    return f"({value:.{digits}f} +- {error:.{digits}f})"


def _pruning(alpha: Alpha) -> list[str]:
    if alpha == "auto":
        text = (
            "Pruned (Eq. 2) per degree of freedom at the knee of its accuracy curve: the fewest "
            "terms, largest standardised coefficient first, whose cross-validated error can't be "
            "told from the least."
        )
    else:
        text = (
            f"Pruned by Eq. 2 at alpha = {alpha:g}, for each degree of freedom on its own; the "
            "term that crosses the threshold is kept too."
        )
    return [fill(text, WIDTH)]


def _curve(curve: Curve) -> list[str]:
    """Formats the error with 0, 1, 2... terms, in per cent of the size of the rates."""
    shown = min(max(CURVE_POINTS, curve.kept + 1), len(curve.error))
    points = [
        f"{n}{'*' if n == curve.kept else ''}: {100.0 * curve.share[n]:.3g} %" for n in range(shown)
    ]
    more = f" ({len(curve.error) - 1} in all)" if shown < len(curve.error) else ""
    text = f"{curve.dof:<14} " + ", ".join(points) + more
    return fill(text, WIDTH, subsequent_indent=" " * 15).splitlines()


def _calibration(identified: Identified) -> list[str]:
    return [f"  {estimate.text}" for estimate in estimates(identified).values()]


def _item(note: str) -> str:
    return fill(note, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _errors(identified: Identified) -> list[str]:
    fit, model = identified.fit, identified.model
    return [
        f"  {dof:<24} RMSE {rmse:.3g} {unit}, R2 {r2:.6f}, condition number {number:.3g}"
        for dof, unit, rmse, r2, number in zip(
            model.dofs, model.dof_units, fit.rmse, fit.r2, fit.condition, strict=True
        )
    ]


def _held_out_rates(model: TaylorModel) -> list[str]:
    quality = model.quality
    if quality is None or not quality.held_out_rmse:
        return []
    units = dict(zip(model.dofs, model.dof_units, strict=True))
    return [
        "  the rates there:",
        *(
            f"  {dof:<24} RMSE {rmse:.3g} {units[dof]}, R2 {quality.held_out_r2[dof]:.6f}"
            for dof, rmse in quality.held_out_rmse.items()
        ),
    ]


def _box(model: TaylorModel, spec: RobotSpec) -> list[str]:
    units: Mapping[str, str] = dict(zip(spec.variable_names, spec.variable_units, strict=True))
    return [
        f"  {name:<24} {low:.4g} to {high:.4g} {units[name]}"
        for name, low, high in zip(model.variables, model.low, model.high, strict=True)
    ]


def _open_loop(held_out: OpenLoop | None) -> list[str]:
    if held_out is None:
        return ["  the drive is too short to hold data out"]
    return [
        f"  after {held_out.horizon_s:g} s: position error {held_out.mean_position_error_m:.3g} m "
        f"on average, {held_out.max_position_error_m:.3g} m at most,",
        f"  heading error {held_out.mean_heading_error_rad:.3g} rad on average, over a mean path "
        f"of {held_out.mean_path_m:.2f} m ({held_out.windows} windows)",
    ]


@dataclass(frozen=True)
class CalibratedValue:
    """One estimate.

    Attributes:
        name: in words.
        value: None if it could not be estimated.
        sigma: standard uncertainty; None if there is none.
        unit: of both.
        remark: why it could not be estimated, or its meaning.
    """

    name: str
    value: float | None
    sigma: float | None
    unit: str
    remark: str = ""

    @property
    def text(self) -> str:
        """One line of text: `command latency 0.0825 +- 0.0072 s`."""
        if not self.unit and self.value is not None:
            return f"{self.name}: {self.remark}"
        if self.value is None:
            return f"{self.name}: not estimated, {self.remark}"
        spread = "" if self.sigma is None else f" +- {self.sigma:.2g}"
        remark = f" ({self.remark})" if self.remark else ""
        return f"{self.name} {self.value:.4g}{spread} {self.unit}{remark}"


def estimates(identified: Identified) -> dict[str, CalibratedValue]:
    """Returns all estimates of the calibration by their names in `Calibration`."""
    recording, calibration = identified.recording, identified.calibration
    return {
        **_timing(recording, calibration),
        **_mounting(calibration, identified.findings.mounting),
        **_wheels(recording, calibration),
    }


def _timing(recording: Recording, calibration: Calibration) -> dict[str, CalibratedValue]:
    sigma = calibration.uncertainty
    offset = CalibratedValue("clock offset", None, None, "s", "pose and commands are on one clock")
    if "clock_offset_s" in sigma:
        value = calibration.clock_offset_s
        offset = CalibratedValue("clock offset", value, sigma["clock_offset_s"], "s")
    elif recording.pose.clock != recording.command.clock:
        offset = CalibratedValue("clock offset", None, None, "s", "no command changed")
    why = "no command changed"
    if "clock_offset_s" in sigma:
        why = "only its sum with the clock offset is known"
    latency = CalibratedValue("command latency", None, None, "s", why)
    if "command_latency_s" in sigma:
        value = calibration.command_latency_s
        latency = CalibratedValue("command latency", value, sigma["command_latency_s"], "s")
    bursts = CalibratedValue(
        "period of bursts", None, None, "s", "the poses are stamped one by one"
    )
    if calibration.burst_period_s > 0.0:
        bursts = CalibratedValue("period of bursts", calibration.burst_period_s, None, "s")
    return {"clock_offset_s": offset, "command_latency_s": latency, "burst_period_s": bursts}


def _mounting(calibration: Calibration, found: Mounting | None) -> dict[str, CalibratedValue]:
    names = {
        "rotation_rad": ("rotation of base_link", calibration.rotation_rad, "rad"),
        "lever_arm_x_m": ("lever arm x", calibration.lever_arm_m[0], "m"),
        "lever_arm_y_m": ("lever arm y", calibration.lever_arm_m[1], "m"),
    }
    why = "the drive shows too few directions of motion"
    if found is not None and not found.turns:
        why = "the robot never turned"
    values = {}
    for key, (name, value, unit) in names.items():
        sigma = calibration.uncertainty.get(key)
        if sigma is None:
            values[key] = CalibratedValue(name, None, None, unit, why)
        else:
            remark = "below its uncertainty: taken as zero" if value == 0.0 else ""
            values[key] = CalibratedValue(name, value, sigma, unit, remark)
    return values


def _wheels(recording: Recording, calibration: Calibration) -> dict[str, CalibratedValue]:
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
        found[key] = CalibratedValue(name, value, sigma, unit, why if value is None else "")
    swapped = calibration.wheels_swapped
    known = None if swapped is None else float(swapped)
    meaning = {None: why, True: "left and right are interchanged", False: "as named"}[swapped]
    found["wheels_swapped"] = CalibratedValue("swapped wheels", known, None, "", meaning)
    return found
