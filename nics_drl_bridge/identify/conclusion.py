"""Conclusion of a fit, to be read first: how well it predicts, its gaps, and the next step."""

from math import isfinite
from typing import NamedTuple

from nics_drl_bridge.identify.by_recording import Alone
from nics_drl_bridge.identify.command_doubts import doubts_of_commands
from nics_drl_bridge.identify.excitation import narrow
from nics_drl_bridge.identify.gyro import relative_to
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.judgement import shortfall, usual
from nics_drl_bridge.identify.verdict import Mistake, doubts, missed
from nics_drl_bridge.robot.kinds import overdriven
from nics_drl_bridge.robot.taylor import EndErrors

OF_PATH = " of the path"
UNSEEN = "otherwise a policy would rely on motion the model never saw"
UNTRIED = "The drive was too short to test the model on unseen data."


class Conclusion(NamedTuple):
    """Sentences on a fit."""

    accuracy: str
    doubts: tuple[str, ...]  # reasons not to trust it
    gaps: tuple[str, ...]  # what the drive could not teach
    advice: str  # the next step
    ready: bool  # false if a policy had better wait for another drive or mapping

    @property
    def lines(self) -> tuple[str, ...]:
        """All sentences, in the order in which they are to be read."""
        return (self.accuracy, *self.doubts, *self.gaps, self.advice)


def conclude(identified: Identified) -> Conclusion:
    """Draws the conclusion of a fit."""
    spec, ready = identified.drive.spec, False
    wrong = tuple(str(note) for note in identified.notes if isinstance(note, Mistake))
    about = (
        *wrong,
        *(str(note) for note in identified.notes if isinstance(note, Alone)),
        *doubts_of_commands(identified.judgement, identified.calibration),
        *shortfall(identified.judgement),
        *doubts(identified.held_out),
    )
    beyond = *narrow(identified.recording, spec), overdriven(spec)
    gaps = *identified.gaps, *(one for one in beyond if one)
    if wrong:
        advice = "fix the mapping as described above, or the robot's own driver, and generate again"
    elif about or not identified.judgement:
        advice = "record another drive, 60 s or longer, and generate again before training a policy"
    elif missed(identified.fit, spec) or identified.model.assumed:
        advice = f"record another drive as described above; {UNSEEN}"
    else:
        first = ", or first fix the points above" if gaps else ""
        advice, ready = f"train a policy in the simulator{first}", True
    told = f"{accuracy(identified)} {relative_to(identified.recording)}".strip()
    return Conclusion(told, about, gaps, f"Next: {advice}.", ready)


def accuracy(identified: Identified) -> str:
    """Says how far off predictions of unseen data are, beside those of the yardsticks."""
    for at in usual(identified.judgement):
        if not isfinite(at.model.position_m):
            return f"On unseen data the predictions run away within {at.horizon_s:g} s."
        named = {"a fitted textbook": at.textbook, "constant twist": at.kept_twist}
        ends = {name: end_of(each, at.path_m) for name, each in named.items() if each}
        beside = (f"{name} {end.removesuffix(OF_PATH)}" for name, end in ends.items())
        found = f"On unseen data the predictions end {at.model.position_m:.3g} m off"
        share = f" ({end_of(at.model, at.path_m)})" if at.path_m > 0.0 else ""
        return f"{found} after {at.horizon_s:g} s{share}; {', '.join(beside)}."
    return UNTRIED


def end_of(errors: EndErrors, path: float) -> str:
    """Formats an error of position as a share of the path [m], or in metres if there is none."""
    if path > 0.0 and isfinite(errors.position_m):
        share = 100.0 * errors.position_m / path
        return f"{f'{share:.1f}' if share >= 0.1 else '< 0.1'} %{OF_PATH}"
    return f"{errors.position_m:.3g} m"
