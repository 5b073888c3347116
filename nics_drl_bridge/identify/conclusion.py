"""Conclusion of a fit: how well it predicts, what is missing, and the next step."""

from math import isfinite
from typing import NamedTuple

from nics_drl_bridge.identify.acceptance import (
    Verdict,
    list_doubts_of_commands,
    select_usual_horizon,
)
from nics_drl_bridge.identify.excitation import describe_narrow_commands
from nics_drl_bridge.identify.gyro import describe_reference
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.verdict import (
    Alone,
    Doubt,
    Mistake,
    list_missed,
)
from nics_drl_bridge.robot.kinds import describe_overdrive
from nics_drl_bridge.robot.taylor import EndErrors

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
