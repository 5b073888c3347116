"""The verdict: what a drive could not show, in sentences, or as a refusal."""

from __future__ import annotations

from math import isfinite

from nics_drl_bridge.calibration.calibration import Calibration
from nics_drl_bridge.calibration.open_loop import OpenLoop
from nics_drl_bridge.errors import FitError
from nics_drl_bridge.kinematics.fit import Fit
from nics_drl_bridge.kinematics.spec import RobotSpec

FEW_LEVELS = 2
ILL_CONDITIONED = 1e6
FAR_OFF = 0.25
"""A prediction that ends off by this share of its path is no prediction."""
UNEXPLAINED = 0.5
MANY_OUTLIERS = 0.001


def refuse_unexcited(linear: Fit, spec: RobotSpec) -> None:
    """Refuses a drive that did not move every input on its own.

    Raises:
        FitError: names the inputs.
    """
    still = linear.excitation.unmoved
    commands = [c.name for c in spec.command]
    named = [name for name in still if name in commands] or list(still)
    if named:
        raise FitError(
            f"{_list(named)} never moved in this drive; drive with {_list(named)} changing over "
            "the whole range, or allow a model without."
        )
    if linear.excitation.together:
        raise FitError(
            f"{_list(linear.excitation.together)} always moved together in this drive; drive with "
            "each changing on its own, or allow a model without."
        )


def unlearnt(linear: Fit, calibration: Calibration, spec: RobotSpec) -> tuple[str, ...]:
    """A sentence on each input that the drive did not move, or not on its own."""
    already = {r.command for r in calibration.responses} | {r.state for r in calibration.responses}
    excitation = linear.excitation
    missing = [name for name in excitation.unmoved if name not in already]
    notes = []
    if excitation.unmoved:
        notes.append(
            f"The model has no terms of {', '.join(excitation.unmoved)}, which never moved: it "
            "holds for this drive's constant value only."
        )
    if missing:
        notes.append(
            f"Drive with {', '.join(missing)} changing over the whole range to learn them."
        )
    if excitation.together:
        notes.append(
            f"{_list(excitation.together)} always moved together, so their effects can't be told "
            "apart: the model holds for this proportion only; drive with each changing on its own."
        )
    copies = [v.name for v in spec.state if v.name in linear.dependent]
    if copies:
        notes.append(
            f"{_list(copies)} always followed from the other variables, so their effects can't be "
            "told apart: the model does without, and holds for as long as that is so."
        )
    coarse = [
        c.name
        for c in spec.command
        if excitation.levels[c.name] == FEW_LEVELS and c.name not in excitation.unmoved
    ]
    if coarse:
        notes.append(
            f"{_list(coarse)} took two values only: between them the model is a straight line, "
            "whatever the robot does; drive with values in between."
        )
    return tuple(notes)


def doubts(linear: Fit, held_out: OpenLoop | None, exact: bool) -> tuple[str, ...]:
    """A sentence on each thing that makes the fit or its predictions doubtful."""
    notes = []
    for d, dof in enumerate(linear.model.dofs):
        if linear.outliers[d] > MANY_OUTLIERS:
            notes.append(
                f"{linear.outliers[d]:.1%} of the rows of {dof} were outliers and were left out "
                "of the fit."
            )
        if linear.condition[d] > ILL_CONDITIONED:
            notes.append(
                f"The terms of {dof} are nearly copies of each other on this drive (condition "
                f"number {linear.condition[d]:.1g}): their coefficients are no use one by one; "
                "lower the order or drive with more variety."
            )
    lost = [n for n, r2 in zip(linear.model.dofs, linear.r2, strict=True) if r2 < UNEXPLAINED]
    lost = [n for n in lost if exact and n in {c.dof for c in linear.curves} and n != "vy"]
    if lost:
        notes.append(
            f"The model explains less than half of {_list(lost)}: the robot did not follow its "
            "commands in a way that a polynomial can describe; do not trust its predictions."
        )
    if held_out is not None and held_out.mean_path_m > 0.0:
        share = held_out.mean_position_error_m / held_out.mean_path_m
        end = f"end {share:.0%} of their path away" if isfinite(share) else "run away"
        if not share <= FAR_OFF:
            notes.append(
                f"On unseen data the predictions {end}: the response does not follow the commands "
                "as the model has it; do not train with this model."
            )
    return tuple(notes)


def _list(names: tuple[str, ...] | list[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
