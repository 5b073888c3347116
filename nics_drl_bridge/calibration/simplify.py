"""Leaves out refined terms that hardly help to predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nics_drl_bridge.calibration.free import free_coefficients
from nics_drl_bridge.calibration.problem import Problem
from nics_drl_bridge.calibration.refine import Refined, refine
from nics_drl_bridge.kinematics.spec import RobotSpec

WORTH = 0.1
"""A term whose loss raises the error by less than this share is left out."""


def simplify(problem: Problem, refined: Refined) -> Refined:
    """Leaves out terms of the body twist that hardly help to predict the training part.

    The one that is least certain goes first; the rest is refined anew.
    """
    best, tried = refined, set[tuple[int, int]]()
    limit = refined.error * (1.0 + WORTH)
    while (weakest := _weakest(best, problem.spec, tried)) is not None:
        tried.add(weakest)
        coefficients = best.model.coefficients.copy()
        coefficients[weakest] = 0.0
        if not coefficients[:3].any():  # the last one: without it the robot would not move
            break
        shorter = replace(best.model, coefficients=coefficients)
        try:
            again = refine(problem, shorter, best.calibration)
        except np.linalg.LinAlgError:  # what is left is unstable: its slopes overflow
            continue
        if again.error < limit:
            best = again
    used = np.abs(best.model.coefficients).sum(axis=0) > 0.0
    model = replace(
        best.model,
        powers=best.model.powers[used],
        coefficients=np.ascontiguousarray(best.model.coefficients[:, used]),
    )
    return replace(best, model=model, std_errors=best.std_errors[:, used])


def _weakest(
    refined: Refined, spec: RobotSpec, tried: set[tuple[int, int]]
) -> tuple[int, int] | None:
    """The free term of the twist that weighs least, standardised by the range of X."""
    model = refined.model
    free = free_coefficients(model, refined.calibration, spec)[:3]
    reach = np.maximum(np.abs(model.low), np.abs(model.high))
    size = np.abs(model.coefficients[:3]) * np.prod(reach**model.powers, axis=1)
    size = size / np.maximum(size.sum(axis=1, keepdims=True), 1e-12)
    order = np.argsort(np.where(free, size, np.inf), axis=None)
    for flat in order:
        d, k = divmod(int(flat), size.shape[1])
        if free[d, k] and (d, k) not in tried:
            return d, k
    return None
