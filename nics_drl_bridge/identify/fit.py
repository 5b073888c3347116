"""Fit by least squares, then pruning of terms that hardly matter (Sec. IV-A, Eq. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.identify.dof import (
    Alpha,
    DofFit,
    fit_dof,
    prune,
    reestimated,
    states_are_noisy,
)
from nics_drl_bridge.identify.excitation import (
    commands_together,
    independent_columns,
    levels,
    plausible,
    unmoved_variables,
    usual_ranges,
)
from nics_drl_bridge.identify.statistics import Curve, errors_of
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import one_blas_thread

__all__ = ["ALPHA", "ORDER", "Alpha", "Fit", "fit", "prune"]

Array = NDArray[np.float64]

ALPHA = 0.99
ORDER = 2
MIN_SAMPLES_PER_TERM = 5
NEGLIGIBLE = 1e-3
"""A velocity component below this share of the other one is modelled as zero."""


@dataclass(frozen=True)
class Excitation:
    """Excitation of a robot's variables by a drive.

    Attributes:
        unmoved: variables that the drive never moved, so that no term contains them.
        together: commands that moved, but were linearly dependent.
        levels: number of different values of each command, at most 10.
    """

    unmoved: tuple[str, ...]
    together: tuple[str, ...]
    levels: dict[str, int]


@dataclass(frozen=True)
class Fit:
    """A fitted model and its goodness of fit.

    Attributes:
        model: the pruned model, with standard errors.
        rmse: (D,) root mean square residual of dQ/dt, in the dof's unit, without outliers.
        r2: (D,) share of the variance explained; 1 if the dof does not move.
        terms_total: D x K before pruning.
        excitation: of the variables by the drive.
        dependent: terms that are copies of others on this drive.
        curves: accuracy against the number of terms, for the dofs that move.
        outliers: (D,) share of the rows that were dropped as outliers.
        condition: (D,) condition number of the standardised kept features.
        samples: number of rows.
    """

    model: TaylorModel
    rmse: Array
    r2: Array
    terms_total: int
    excitation: Excitation
    dependent: tuple[str, ...]
    curves: tuple[Curve, ...]
    outliers: Array
    condition: Array
    samples: int

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Variables that the drive never moved, so that no term contains them."""
        return self.excitation.unmoved


@one_blas_thread
def fit(
    samples: Samples,
    spec: RobotSpec,
    order: int = ORDER,
    alpha: Alpha = ALPHA,
    noisy: bool = False,
) -> Fit:
    """Fits and prunes a Taylor model.

    Args:
        samples: (t, Q, X, dQ) on one time axis. Rows that jump are dropped as outliers.
        spec: gives names, units and limits.
        order: of the expansion, 1 to 4; the paper's is 2.
        alpha: the share of the summed standardised coefficients that the kept terms of each
            degree of freedom reach (Eq. 2). The term that crosses the threshold is kept too:
            with a literal Eq. 2 a differential robot, whose wheels have equal weight, would
            lose one of them. `auto` keeps as many terms, in the same order, as improve the
            cross-validated error (`accuracy.knee`).
        noisy: True for any recording but an exact one. Insignificant terms are dropped before
            Eq. 2 is applied to the rest. The body twist is then modelled as a function of the
            state alone, if there is a state, and as zero at zero speed, if the speed moved:
            within a step a command acts through the state, and in noise the two are
            indistinguishable.

    Returns:
        The model with its errors.

    Raises:
        FitError: too few samples, or nothing moved.
    """
    low, high = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    believed = plausible(samples.x, low, high)
    samples = samples.rows(believed)
    excitation = excitation_of(samples, spec)
    names, size = spec.variable_names, samples.dq.shape[1]
    every = taylor.exponents(len(names), order)
    powers = _moved_terms(samples, every, names, excitation.unmoved)
    chi = taylor.evaluate(samples.x, powers)
    independent, dependent = independent_columns(chi)
    chi, kept = chi[:, independent], powers[independent]
    parts = _fit_dofs(samples, spec, kept, chi, alpha, noisy, excitation.unmoved)
    model = build_model(samples, spec, kept, *_stacked(parts, size, len(kept)))
    rmse, r2 = _errors(model, samples, parts)
    left_out = 1.0 - float(believed.mean())
    return Fit(
        model,
        rmse,
        r2,
        terms_total=size * len(every),
        excitation=excitation,
        dependent=tuple(taylor.term_name(row, names) for row in powers[dependent]),
        curves=tuple(part.curve for part in parts.values()),
        outliers=np.array([_outliers(parts.get(d), left_out) for d in range(size)]),
        condition=np.array([parts[d].condition if d in parts else 1.0 for d in range(size)]),
        samples=len(samples.t),
    )


def excitation_of(samples: Samples, spec: RobotSpec) -> Excitation:
    """Returns the excitation of the variables by a drive."""
    return Excitation(
        unmoved_variables(samples, spec), commands_together(samples, spec), levels(samples, spec)
    )


def build_model(
    samples: Samples, spec: RobotSpec, powers: NDArray[np.int64], coefficients: Array, errors: Array
) -> TaylorModel:
    """Builds a TaylorModel of the terms that any degree of freedom keeps."""
    used = np.abs(coefficients).sum(axis=0) > 0.0
    return TaylorModel(
        variables=spec.variable_names,
        dofs=spec.dof_names,
        dof_units=spec.dof_units,
        powers=powers[used],
        coefficients=coefficients[:, used],
        dt=samples.dt,
        low=samples.x.min(axis=0),
        high=samples.x.max(axis=0),
        std_errors=errors[:, used],
    )


def _moved_terms(
    samples: Samples, powers: NDArray[np.int64], names: tuple[str, ...], unmoved: tuple[str, ...]
) -> NDArray[np.int64]:
    """Returns the terms (K, V) of variables that moved; refuses too few samples for them."""
    still = [names.index(name) for name in unmoved]
    moved: NDArray[np.int64] = powers[(powers[:, still] == 0).all(axis=1)]
    if len(samples.t) < MIN_SAMPLES_PER_TERM * len(moved):
        raise FitError(
            f"{len(samples.t)} samples are too few for {len(moved)} terms; drive for longer, or "
            "lower the order."
        )
    if len(unmoved) == len(names):
        raise FitError(
            "no command ever changed, so nothing can be learnt; vary each over its range."
        )
    return moved


def _fit_dofs(
    samples: Samples,
    spec: RobotSpec,
    powers: NDArray[np.int64],
    chi: Array,
    alpha: Alpha,
    noisy: bool,
    unmoved: tuple[str, ...],
) -> dict[int, DofFit]:
    """Fits each degree of freedom that moves."""
    labels = np.array([taylor.term_name(row, spec.variable_names) for row in powers])
    by_state = _through_state(powers, spec, unmoved)
    usual, parts = usual_ranges(samples.dq), {}
    for d in map(int, np.flatnonzero(_moves(samples.dq))):
        allowed = by_state if noisy and d < 3 else np.ones_like(by_state)
        part = fit_dof(
            spec.dof_names[d],
            tuple(map(str, labels[allowed])),
            chi[:, allowed],
            samples.dq[:, d],
            float(usual[d]),
            alpha,
            noisy,
        )
        parts[d] = part.spread_over(allowed)
    if states_are_noisy(samples, spec):
        for d in [d for d in parts if d >= 3]:
            parts[d] = reestimated(parts[d], d, samples, powers, len(spec.state))
    return parts


def _stacked(parts: dict[int, DofFit], dofs: int, terms: int) -> tuple[Array, Array]:
    """Returns coefficients and standard errors (D, K); zero for a dof that does not move."""
    coefficients, errors = np.zeros((dofs, terms)), np.zeros((dofs, terms))
    for d, part in parts.items():
        coefficients[d], errors[d] = part.coefficients, part.errors
    return coefficients, errors


def _errors(model: TaylorModel, samples: Samples, parts: dict[int, DofFit]) -> tuple[Array, Array]:
    """Returns RMSE (D,) and R2 (D,) on the rows that each degree of freedom was fitted to."""
    rmse, r2 = errors_of(model, samples)
    for d, part in parts.items():
        if not part.inliers.all():
            some = errors_of(model, samples.rows(part.inliers))
            rmse[d], r2[d] = some[0][d], some[1][d]
    return rmse, r2


def _outliers(part: DofFit | None, left_out: float) -> float:
    inside = 1.0 if part is None else float(part.inliers.mean())
    return 1.0 - (1.0 - left_out) * inside


def _through_state(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved: tuple[str, ...]
) -> NDArray[np.bool_]:
    """Selects the terms (K,) allowed in the body twist of a noisy recording."""
    if not spec.state:
        return np.ones(len(powers), dtype=np.bool_)
    allowed = (powers[:, len(spec.state) :] == 0).all(axis=1)
    if any(v.unit == "m/s" and v.name not in unmoved for v in spec.state):
        allowed &= powers.sum(axis=1) > 0
    return np.asarray(allowed)


def _moves(dq: Array) -> NDArray[np.bool_]:
    """Selects the dofs (D,) that move: of vx and vy the non-negligible, and all others."""
    size = np.sqrt((dq**2).mean(axis=0))
    moves = np.ones(len(size), dtype=np.bool_)
    moves[:2] = size[:2] > NEGLIGIBLE * size[:2].max()
    return moves
