"""Fit report: the model's equations, the quality of its fit, and what could not be learnt."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import isfinite
from textwrap import fill
from typing import NamedTuple

import numpy as np

from nics_drl_bridge.identify.alignment import select_moved_commands
from nics_drl_bridge.identify.calibration import Alpha
from nics_drl_bridge.identify.drive import Alone, Doubt, Mistake
from nics_drl_bridge.identify.findings import (
    FAR_OFF,
    describe_coarsest_state,
    list_missed,
)
from nics_drl_bridge.identify.fit import describe_narrow_commands
from nics_drl_bridge.identify.hypotheses import PRUNING, list_candidates
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.judgement import (
    Verdict,
    list_doubts_of_commands,
    select_usual_horizon,
)
from nics_drl_bridge.identify.repair import describe_reference
from nics_drl_bridge.identify.statistics import Curve
from nics_drl_bridge.robot.kinds import describe_overdrive
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors, TaylorModel

WIDTH = 96
CURVE_POINTS = 8
MOUNTING_VALUES = ("rotation_rad", "lever_arm_x_m", "lever_arm_y_m")
TEXTBOOK_VALUES = ("command_latency_s", *MOUNTING_VALUES)
DEAD_ZONE = "dead zone on both sides of 0"
EAGER = "does more than in proportion, by minus"
CANDIDATES = (
    "Candidates, mean error after 5 s on parts that their fits did not see, as a fraction of the "
    "path, * for those kept:"
)
# minimum digits of a coefficient, with which the printed equations predict like the model
LEAST_DIGITS = 3
# fraction of the error of standing still above which a model hardly helps
MOST_LEFT = 0.5


def format_report(source: str, identified: Identified) -> str:
    """Returns the report on a recording from a source as text for people."""
    sections = _make_opening(source, identified)
    motor_effects = list(list_motor_effects(identified))
    if motor_effects:
        sections["Effect of the motors (standard uncertainties):"] = motor_effects
    candidates = list(_describe_candidates(identified))
    if candidates:
        sections[CANDIDATES] = candidates
    sections |= _describe_fit(identified)
    apart = f"after {identified.train_until_s:.1f} s"
    if identified.recording.episodes:
        apart = "the last third of each drive"
    held_out = f"Open loop, on data held out from the fit ({apart}):"
    sections[held_out] = _describe_held_out(identified)
    sections |= _format_comparison(identified.judgement)
    sections["Valid range, as covered by the drive:"] = _describe_range(identified)
    sections["Calibration (standard uncertainties):"] = (
        estimate.text for estimate in collect_estimates(identified).values()
    )
    noise = "Noise that the simulator and the estimator use (standard deviations):"
    sections[noise] = identified.noise.sentences()
    latency = identified.recording.latency.sentences()
    if latency:
        sections["Latency of the device, also used by simulator_node:"] = latency
    notes = identified.notes or ("Nothing had to be corrected.",)
    sections["Findings, and what was not learnt:"] = _list_items(notes)
    return _format_sections(sections) + "\n"


def format_opening(source: str, identified: Identified) -> str:
    """Returns the conclusion and the model, with which `format_report` opens."""
    return _format_sections(_make_opening(source, identified))


def _make_opening(source: str, identified: Identified) -> dict[str, Iterable[str]]:
    """Returns the lines of the first sections, by their heads."""
    title = f"Fit report: robot {identified.drive.spec.name!r} from {source}"
    return {
        title: _list_items(conclude(identified).lines),
        _describe_size(identified): format_equations(identified.model),
    }


def _format_sections(sections: Mapping[str, Iterable[str]]) -> str:
    paragraphs = []
    for head, lines in sections.items():
        indented = [f"  {line}" for line in lines]
        paragraphs.append("\n".join([head, *indented]))
    return "\n\n".join(paragraphs)


def _list_items(sentences: Iterable[str]) -> Iterator[str]:
    for sentence in sentences:
        yield fill(
            sentence, width=WIDTH - 2, initial_indent="- ", subsequent_indent="    "
        )


def _describe_size(identified: Identified) -> str:
    model = identified.model
    of = ""
    if identified.findings.is_linear_fit:
        of = f" of {identified.fit.regression.terms_total}"
    variables = f"X = {', '.join(model.variables)}"
    kept = f"Kept {model.terms_kept}{of} terms, step {model.dt:g} s ({variables})"
    return f"{kept}, with standard errors:"


def _describe_range(identified: Identified) -> Iterator[str]:
    model = identified.model
    units = list_units(identified.drive.spec)
    assumed = dict(model.assumed)
    for name, low, high in zip(model.variables, model.low, model.high, strict=True):
        mark = " (assumed)" if model.bounded and f"d_{name}" in assumed else ""
        yield f"{name:<24} {low:.4g} to {high:.4g} {units[name]}{mark}"


def format_equations(model: TaylorModel) -> list[str]:
    """Returns one line per degree of freedom: `wz = (4.63 +- 0.02)*speed*steering  [rad/s]`."""
    errors = model.named_errors
    lines = [curve.equation for curve in model.inputs]
    for dof, unit, row in zip(
        model.dofs, model.dof_units, model.coefficients, strict=True
    ):
        text = ""
        terms = zip(model.term_names, model.shown_terms, map(float, row), strict=True)
        for name, shown, value in terms:
            if value == 0.0:
                continue
            sign = "-" if value < 0.0 else "+"
            if text:
                text += f" {sign} "
            elif sign == "-":
                text = sign
            text += format_with_error(abs(value), errors.get(dof, {}).get(name))
            if name != "1":
                text += f"*{shown}"
            if (dof, name) in model.assumed:
                text += " (assumed)"
        lines.append(f"{dof} = {text or '0'}{model.describe_limits(dof)}  [{unit}]")
    return lines


def list_units(spec: RobotSpec) -> dict[str, str]:
    """Returns the units of a robot's variables, by name; empty for fractions."""
    names = zip(spec.variable_names, spec.variable_units, strict=True)
    return {name: unit * (unit != "1") for name, unit in names}


def list_motor_effects(identified: Identified) -> Iterator[str]:
    """Yields a line per parameter of a motor or an input curve, with its uncertainty.

    The names are `throttle.dead`, `.least`, `.most`, `.back` and `.delay` for a command, `vx.fall`,
    `.rise`, `.friction` and `.drag` for a state, and `vx.back_emf.throttle` for a pair.
    """
    sigma = identified.calibration.uncertainty
    units = list_units(identified.drive.spec)
    effects = (
        *_list_curve_effects(identified.model, units),
        *_list_state_effects(identified.model),
    )
    for name, parameter, words, value, unit, usual in effects:
        if value == usual:
            continue
        error = sigma.get(f"{name}.{parameter}")
        spread = "" if error is None else f" +- {error:.2g}"
        yield f"{name:<24} {words}: {value:.4g}{spread} {unit}".rstrip()


# name, parameter, description, value, unit, and the value that means "no effect"
Effect = tuple[str, str, str, float, str, float]


def _list_curve_effects(model: TaylorModel, units: Mapping[str, str]) -> list[Effect]:
    """Lists the parameters of the input curves."""
    effects: list[Effect] = []
    back = "reverse gain, relative to forward"
    for curve in model.inputs:
        name = curve.command
        unit = units[name]
        dead = DEAD_ZONE if curve.dead > 0.0 else EAGER
        effects += [
            (name, "dead", dead, curve.dead, unit, 0.0),
            (name, "least", "saturates below", curve.least, unit, -np.inf),
            (name, "most", "saturates above", curve.most, unit, np.inf),
            (name, "back", back, curve.back, "", 1.0),
            (name, "delay", "delay after the common latency", curve.delay, "s", 0.0),
        ]
    return effects


def _list_state_effects(model: TaylorModel) -> list[Effect]:
    """Lists the limits, friction, drag and back-EMF of the states."""
    effects: list[Effect] = []
    commands = model.variables[model.state_size :]
    for i, state in enumerate(model.variables[: model.state_size]):
        unit = model.dof_units[3 + i]
        fall, rise = model.limits[i].tolist()
        friction = float(model.friction[i])
        effects += [
            (state, "fall", "maximum fall", fall, unit, -np.inf),
            (state, "rise", "maximum rise", rise, unit, np.inf),
            (state, "friction", "dry friction", friction, unit, 0.0),
            (state, "drag", "drag, times its square", float(model.drag[i]), "", 0.0),
        ]
        for command, value in zip(commands, model.back_emf[i].tolist(), strict=True):
            words = f"back-EMF, times {state} and |{command}|"
            effects.append((state, f"back_emf.{command}", words, value, "", 0.0))
    return effects


def format_with_error(value: float, error: float | None) -> str:
    """Formats a number with its standard error, ready for computation: `(4.63 +- 0.02)`.

    Keeps the digits that the error allows, but at least `LEAST_DIGITS`.
    """
    if error is None or error <= 1e-6 * value:
        return f"{value:.5g}"
    exponent = int(np.floor(np.log10(error)))
    leading = error / 10.0**exponent
    by_error = -exponent + (leading < 1.95 or leading >= 9.5)
    by_value = LEAST_DIGITS - 1 - int(np.floor(np.log10(value))) if value > 0.0 else 0
    if by_value > max(0, by_error):
        return f"({value:.{LEAST_DIGITS}g} +- {error:.2g})"
    digits = max(0, by_error)
    return f"({value:.{digits}f} +- {error:.{digits}f})"


def _describe_candidates(identified: Identified) -> Iterator[str]:
    """Yields a line per candidate that was tried in the trial; none if a textbook was written."""
    findings = identified.findings
    if findings.replacement:
        return
    order = identified.drive.settings.order
    for candidate in list_candidates(findings.base, findings.trials, order):
        if np.isfinite(candidate.error):
            mark = " *" if candidate.kept else ""
            yield f"{candidate.name:<36} {candidate.error:7.2%}{mark}"


def _describe_fit(identified: Identified) -> dict[str, Iterable[str]]:
    """Describes the linear fit if it is the model, and the pruning of what predictions chose."""
    findings = identified.findings
    alpha = identified.alpha
    if findings.is_pruned_prediction:
        alpha = PRUNING if alpha == "auto" else alpha
        return {fill(_describe_pruning(alpha), WIDTH): ()}
    if not findings.is_linear_fit:
        return {}
    fit = identified.fit
    model = identified.model
    rows = zip(
        model.dofs, model.dof_units, fit.rmse, fit.r2, fit.condition, strict=True
    )
    return {
        fill(_describe_pruning(alpha), WIDTH): (),
        "Cross-validated error against the number of terms, largest first, * for those kept:": (
            chain.from_iterable(map(_format_curve, fit.curves))
        ),
        "Error of the linear fit per degree of freedom, on the part it was fitted to:": (
            f"{dof:<24} RMSE {rmse:.3g} {unit}, R2 {r2:.6f}, condition number {number:.3g}"
            for dof, unit, rmse, r2, number in rows
        ),
    }


def _describe_pruning(alpha: Alpha) -> str:
    if alpha == "auto":
        knee = "Pruned (Eq. 2) per degree of freedom at the knee of its accuracy curve"
        fewest = "the fewest terms, largest standardised coefficient first"
        return (
            f"{knee}: {fewest}, whose cross-validated error is as good as the minimum."
        )
    pruned = (
        f"Pruned by Eq. 2 at alpha = {alpha:g}, for each degree of freedom on its own"
    )
    return f"{pruned}; the term that crosses the threshold is kept too."


def _format_curve(curve: Curve) -> list[str]:
    shown = min(max(CURVE_POINTS, curve.kept + 1), len(curve.error))
    points = []
    for n in range(shown):
        mark = "*" if n == curve.kept else ""
        points.append(f"{n}{mark}: {100.0 * curve.share[n]:.3g} %")
    more = f" ({len(curve.error) - 1} in all)" if shown < len(curve.error) else ""
    text = f"{curve.dof:<14} " + ", ".join(points) + more
    return fill(text, WIDTH, subsequent_indent=" " * 15).splitlines()


def _describe_held_out(identified: Identified) -> Iterator[str]:
    held_out = identified.held_out
    model = identified.model
    quality = identified.model.quality
    if held_out is None:
        yield "the drive is too short to hold data out"
    else:
        mean = f"position error {held_out.mean_position_error_m:.3g} m on average"
        most = f"{held_out.max_position_error_m:.3g} m at most"
        yield f"after {held_out.horizon_s:g} s: {mean}, {most},"
        mean = f"heading error {held_out.mean_heading_error_rad:.3g} rad on average"
        path = f"a mean path of {held_out.mean_path_m:.2f} m"
        yield f"{mean}, over {path} ({held_out.windows} windows)"
    if quality is not None and quality.held_out_rmse:
        yield "the rates there:"
        for unit, dof in zip(model.dof_units, quality.held_out_rmse, strict=True):
            rmse = quality.held_out_rmse[dof]
            r2 = quality.held_out_r2[dof]
            yield f"{dof:<24} RMSE {rmse:.3g} {unit}, R2 {r2:.6f}"


HEADS = (
    "after",
    "path",
    "model",
    "fitted textbook",
    "constant twist",
    "95 % within",
    "held",
)
COMPARED = (
    "By horizon, mean errors of position [m] (share of the path) and heading [rad]:"
)


def tabulate_judgement(judgement: Sequence[HorizonErrors]) -> list[tuple[str, ...]]:
    """Returns a table of predictions beside those of yardsticks, a row per horizon for `HEADS`."""
    rows = []
    for at in judgement:
        cells = [f"{at.horizon_s:g} s", f"{at.path_m:.3g} m"]
        for errors in (at.model, at.textbook, at.kept_twist):
            cells.append("-" if errors is None else _format_errors(errors, at.path_m))
        cells.append("-" if at.band_m is None else f"{at.band_m:.3g} m")
        cells.append("-" if at.coverage is None else f"{at.coverage:.1%}")
        rows.append(tuple(cells))
    return rows


def _format_errors(errors: EndErrors, path: float) -> str:
    share = f" ({errors.position_m / path:.1%})" if path > 0.0 else ""
    return f"{errors.position_m:.3g}{share} {errors.heading_rad:.2g}"


def _format_comparison(judgement: Sequence[HorizonErrors]) -> dict[str, Iterator[str]]:
    rows = [HEADS, *tabulate_judgement(judgement)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.rjust, row, widths)) for row in rows)
    return {COMPARED: lines} if judgement else {}


@dataclass(frozen=True)
class CalibratedValue:
    """One estimate; without a value if it could not be made."""

    name: str  # in words
    value: float | None
    sigma: float | None  # standard uncertainty; None if there is none
    unit: str  # of both
    remark: str = ""  # why it could not be estimated, or its meaning

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


def collect_estimates(identified: Identified) -> dict[str, CalibratedValue]:
    """Returns all estimates of the calibration by their names in `Calibration`."""
    calibration = identified.calibration
    sigma = calibration.uncertainty
    replaced = bool(identified.findings.replacement)
    values = {}
    for key, (name, value, unit, why) in _list_estimates(identified).items():
        if replaced and key in TEXTBOOK_VALUES:
            known = CalibratedValue(name, value, None, unit, "by the fitted textbook")
        elif key in sigma:
            is_zero = value == 0.0 and key in MOUNTING_VALUES
            remark = "below its uncertainty: taken as zero" if is_zero else ""
            known = CalibratedValue(name, value, sigma[key], unit, remark)
        else:
            known = CalibratedValue(name, None, None, unit, why)
        values[key] = known
    period = calibration.burst_period_s
    if period > 0.0:
        values["burst_period_s"] = replace(
            values["burst_period_s"], value=period, remark=""
        )
    swapped = calibration.wheels_swapped
    if swapped is not None:
        meaning = "left and right are interchanged" if swapped else "as named"
        values["wheels_swapped"] = replace(
            values["wheels_swapped"], value=float(swapped), remark=meaning
        )
    return values


def _list_estimates(
    identified: Identified,
) -> dict[str, tuple[str, float | None, str, str]]:
    """Returns name, value, unit, and why it may be unknown, of each estimate."""
    recording = identified.recording
    calibration = identified.calibration
    mounting = identified.findings.mounting
    one_clock = recording.pose.clock == recording.command.clock
    changed = bool(select_moved_commands(recording.command).any())
    untold = "the motion does not show it" if changed else "no command changed"
    clocks = "pose and commands are on one clock" if one_clock else untold
    latency = untold
    if "clock_offset_s" in calibration.uncertainty:
        latency = "only its sum with the clock offset is known"
    elif identified.findings.motion_width_s is not None:
        latency = "it can't be separated from the lags"
    few = "the drive shows too few directions of motion"
    x_why, y_why = (few, few) if mounting is None else mounting.hidden
    wheels = "the wheels do not show it"
    if recording.wheels is None:
        wheels = "no wheel speeds were recorded"
    x, y = calibration.lever_arm_m
    speed_unit = "m/s per unit"
    turn_unit = "rad/s per unit"
    singly = "the poses are stamped one by one"
    return {
        "clock_offset_s": ("clock offset", calibration.clock_offset_s, "s", clocks),
        "command_latency_s": (
            "command latency",
            calibration.command_latency_s,
            "s",
            latency,
        ),
        "burst_period_s": ("period of bursts", None, "s", singly),
        "rotation_rad": ("rotation of base_link", calibration.rotation_rad, "rad", few),
        "lever_arm_x_m": ("lever arm x", x, "m", x_why),
        "lever_arm_y_m": ("lever arm y", y, "m", y_why),
        "wheel_scale": ("wheel scale", calibration.wheel_scale, speed_unit, wheels),
        "turn_scale": ("turn scale", calibration.turn_scale, turn_unit, wheels),
        "wheels_swapped": ("swapped wheels", None, "", wheels),
    }


def is_useless(error: float, standing: float, path: float, radius: float) -> bool:
    """True if median errors [m] (may be NaN, inf) are hardly below those of standing still."""
    # The mean path and the robot's radius [m] set the scale for circles.
    return not error <= max(MOST_LEFT * standing, FAR_OFF * path, radius)


def explain_uselessness(identified: Identified) -> str:
    """Returns a sentence on why a model is useless, by median errors; empty if it is not."""
    held_out = identified.held_out
    recording = identified.recording
    spec = identified.drive.spec
    if held_out is None:
        return ""
    error = held_out.median_position_error_m
    standing = held_out.median_displacement_m
    if not np.isfinite(held_out.mean_position_error_m):
        error = np.inf
    if not is_useless(error, standing, held_out.mean_path_m, spec.footprint_radius):
        return ""
    end = f"end {error:.3g} m off" if np.isfinite(error) else "have diverged"
    way = f"after {held_out.horizon_s:g} s and a path of {held_out.mean_path_m:.2f} m"
    still = f"while a robot standing still would be {standing:.2f} m off"
    fault = f"the fitted model is useless: on unseen data its predictions {end} {way}, {still}"
    return f"{recording.source}: {fault}; {_name_suspect(identified, spec)}"


def _name_suspect(identified: Identified, spec: RobotSpec) -> str:
    """Returns the end of a sentence, on the most likely cause of a useless model."""
    recording = identified.recording
    unmoved = identified.trial.fit.unmoved
    rows = recording.pose if recording.state is None else recording.state
    apart = f"{np.median(np.diff(rows.t)):.2g} s apart"
    coarse = describe_coarsest_state(recording, spec, unmoved)
    if coarse:
        return f"{coarse}."
    still = ", ".join(c.name for c in spec.command if c.name in unmoved)
    if still:
        reason = f"{still} never moved in its first {identified.train_until_s:.0f} s"
        return f"{reason}, which the fit learns from, so change it from the start."
    if identified.alpha != "auto" or identified.drive.settings.order == 1:
        return "it may lack terms, so leave order and alpha at `auto`."
    for note in identified.notes:
        if isinstance(note, Mistake | Doubt):
            return f"the likely cause: {note}"
    got = "that nothing blocked the robot, that it received each command"
    shown = f"{got} and that rows {apart} show how it responds"
    return f"the recording does not show why, so make sure {shown}, and record again."


# duration of a drive above which errors have other causes than its length
ENOUGH_S = 60.0
UNSEEN = "otherwise a policy would rely on motion the model never saw"
UNTRIED = "The drive was too short to test the model on unseen data."


class Conclusion(NamedTuple):
    """Sentences that sum up a fit."""

    verdict: Verdict
    accuracy: str
    doubts: tuple[str, ...]  # reasons not to trust it
    gaps: tuple[str, ...]  # what the drive could not teach
    advice: str  # the recommended next step
    ready: bool  # False if another drive or mapping should come before a policy

    @property
    def lines(self) -> tuple[str, ...]:
        """All sentences, in reading order."""
        first = f"Verdict: {self.verdict}. {self.accuracy}"
        return (first, *self.doubts, *self.gaps, self.advice)


def conclude(identified: Identified) -> Conclusion:
    """Draws the conclusion of a fit."""
    spec = identified.drive.spec
    assessment = identified.assessment
    wrong = tuple(str(note) for note in identified.notes if isinstance(note, Mistake))
    strange = tuple(str(note) for note in identified.notes if isinstance(note, Doubt))
    replaced = identified.findings.replacement
    doubts = (
        *wrong,
        *strange,
        *(str(note) for note in identified.notes if isinstance(note, Alone)),
        *((replaced,) if replaced else ()),
        *list_doubts_of_commands(identified.judgement, identified.calibration),
        *assessment.reasons,
    )
    overdrive = describe_overdrive(spec)
    gaps = (
        *identified.gaps,
        *describe_narrow_commands(identified.recording, spec),
        *((overdrive,) if overdrive else ()),
    )
    ready = (
        assessment.verdict is not Verdict.DO_NOT_TRAIN and not identified.model.assumed
    )
    advice = (
        f"Next: {_choose_advice(identified, bool(wrong), bool(strange), bool(gaps))}."
    )
    errors = (
        f"{accuracy(identified)} {describe_reference(identified.recording)}".strip()
    )
    return Conclusion(assessment.verdict, errors, doubts, gaps, advice, ready)


def _choose_advice(
    identified: Identified, mistaken: bool, strange: bool, gaps: bool
) -> str:
    """Returns the next step, by the first condition that is not met."""
    duration = identified.drive.duration_s
    if mistaken:
        return "fix the mapping as described above, or the robot's own driver, and generate again"
    if list_missed(identified.fit, identified.drive.spec) or identified.model.assumed:
        return f"record another drive as described above; {UNSEEN}"
    if not identified.judgement:
        return f"record a longer drive than these {duration:.0f} s, best 60 s, and generate again"
    if strange and identified.verdict is Verdict.WITH_CARE:
        return "check what looks mistaken above; if the robot really behaves so, train a policy"
    first = ", or first fix the points above" if gaps else ""
    if identified.verdict is Verdict.GOOD:
        return f"train a policy in the simulator{first}"
    if identified.verdict is Verdict.WITH_CARE:
        wide = (
            "under a randomisation as wide as this error, and drive it slowly at first"
        )
        return f"train a policy {wide}{first}"
    if duration < ENOUGH_S:
        return f"record another drive, longer than these {duration:.0f} s, and generate again"
    look = "see in report.html where the predicted paths leave the measured ones"
    return f"{look}, fix the cause or record another drive, and generate again before training"


def accuracy(identified: Identified) -> str:
    """Formats how far off predictions of unseen data are, compared with the yardsticks'."""
    for at in select_usual_horizon(identified.judgement):
        if not isfinite(at.model.position_m):
            return f"On unseen data the predictions diverge within {at.horizon_s:g} s."
        yardsticks = {"a fitted textbook": at.textbook, "constant twist": at.kept_twist}
        beside = [
            f"{name} {format_error(errors, at.path_m)}"
            for name, errors in yardsticks.items()
            if errors is not None
        ]
        finding = f"On unseen data the predictions end {at.model.position_m:.3g} m off"
        share = ""
        if at.path_m > 0.0:
            share = f" ({format_error(at.model, at.path_m)} of the path)"
        return f"{finding} after {at.horizon_s:g} s{share}; {', '.join(beside)}."
    return UNTRIED


def is_share(errors: EndErrors, path: float) -> bool:
    """True if `format_error` states a fraction of the path [m]."""
    return path > 0.0 and isfinite(errors.position_m)


def format_error(errors: EndErrors, path: float) -> str:
    """Formats a position error as a fraction of the path [m], or in metres without a path."""
    if not is_share(errors, path):
        return f"{errors.position_m:.3g} m"
    percentage = 100.0 * errors.position_m / path
    return f"{percentage:.1f} %" if percentage >= 0.1 else "< 0.1 %"
