"""Eq. 1 and 2 on one page (Sec. IV-A): features, least squares, pruning, least squares again.

`dQ/dt = A chi`, `chi = vec([1, X] (x) [1, X])`: `robot.taylor` makes the features, `regress` finds
the coefficients of all, and `pruned` keeps those of Eq. 2 and estimates them anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.identify.excitation import (
    Excitation,
    excitation_of,
    independent_columns,
    inliers,
    moved_terms,
    moving_dofs,
    plausible,
    states_are_noisy,
    terms_through_state,
    usual_ranges,
)
from nics_drl_bridge.identify.statistics import (
    Curve,
    condition,
    curve,
    errors_of,
    instrumental,
    significant,
    standard_errors,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import one_blas_thread

Array = NDArray[np.float64]
Alpha = float | Literal["auto"]

ALPHA: Alpha = 0.99
ORDER = 2
ROUNDING = 1e-9
"""Standardised coefficients below this share of the rates are rounding errors."""
SAME_STEP, ROUNDING_S = 1e-3, 1e-6


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold of Eq. 2: a number from 0 to 1, or `auto`.

    Raises:
        ConfigError: it is neither.
    """
    if text == "auto":
        return "auto"
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 <= value <= 1.0:
        raise ConfigError(f"alpha is {text!r}; it must be a number from 0 to 1, or auto.")
    return value


@dataclass(frozen=True)
class Regression:
    """Least squares of dQ/dt on all features (Eq. 1).

    Attributes:
        samples: T rows, without implausible ones.
        powers: (K, V) exponents of the features of variables that moved, without copies.
        chi: (T, K) features.
        beta: (D, K) standardised coefficients; zero where not allowed or insignificant.
        inliers: (D, T) mask of the rows that are no outliers.
        moving: indices of the degrees of freedom that move; the others have no terms.
        excitation: of the variables by the drive.
        dependent: terms that are copies of others on this drive.
        terms_total: D x K before anything was left out.
        left_out: share of the rows that were implausible.
    """

    samples: Samples
    powers: NDArray[np.int64]
    chi: Array
    beta: Array
    inliers: NDArray[np.bool_]
    moving: tuple[int, ...]
    excitation: Excitation
    dependent: tuple[str, ...]
    terms_total: int
    left_out: float

    def rows(self, d: int) -> tuple[Array, Array]:
        """Returns features (n, K) and rates (n,) of a degree of freedom without its outliers."""
        inside, target = self.inliers[d], self.samples.dq[:, d]
        return (self.chi, target) if inside.all() else (self.chi[inside], target[inside])


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
    """Fits and prunes a Taylor model; see `regress` and `pruned` for arguments and errors."""
    return pruned(regress(samples, spec, order, noisy), spec, alpha)


def regress(
    samples: Samples, spec: RobotSpec, order: int = ORDER, noisy: bool = False
) -> Regression:
    """Finds the coefficients of all features by least squares (Eq. 1).

    Args:
        samples: (t, Q, X, dQ) on one time axis. Rows that jump are dropped as outliers.
        spec: gives names, units and limits.
        order: of the expansion, 1 to 4; the paper's is 2.
        noisy: True for any recording but an exact one. Insignificant terms are dropped before
            Eq. 2 is applied to the rest. The body twist is then modelled as a function of the
            state alone, if there is a state, and as zero at zero speed, if the speed moved:
            within a step a command acts through the state, and in noise the two are
            indistinguishable.

    Raises:
        FitError: too few samples, or nothing moved.
    """
    believed = plausible(samples.x, spec)
    samples = samples.rows(believed)
    excitation, names = excitation_of(samples, spec), spec.variable_names
    every = taylor.exponents(len(names), order)
    powers = moved_terms(samples, every, names, excitation.unmoved)
    chi = taylor.evaluate(samples.x, powers)
    independent, dependent = independent_columns(chi)
    chi, kept = chi[:, independent], powers[independent]
    beta = np.zeros((samples.dq.shape[1], len(kept)))
    used = np.ones(samples.dq.T.shape, dtype=np.bool_)
    through_state = terms_through_state(kept, spec, excitation.unmoved)
    usual, moving = usual_ranges(samples.dq), moving_dofs(samples.dq)
    for d in moving:
        allowed = through_state if noisy and d < 3 else np.ones_like(through_state)
        some, target = chi[:, allowed], samples.dq[:, d]
        used[d] = inliers(some / _scale(some), target, float(usual[d]))
        if not used[d].all():
            some, target = some[used[d]], target[used[d]]
        beta[d, allowed] = _standardised(some / _scale(some), target, noisy)
    return Regression(
        samples, kept, chi, beta, used, moving, excitation,
        dependent=tuple(taylor.term_name(row, names) for row in powers[dependent]),
        terms_total=samples.dq.shape[1] * len(every),
        left_out=1.0 - float(believed.mean()),
    )  # fmt: skip


def _standardised(unit: Array, target: Array, noisy: bool) -> Array:
    """Returns coefficients (K,) of standardised features (T, K); insignificant ones are zero."""
    beta = np.zeros(unit.shape[1])
    candidates = significant(unit, target) if noisy else np.ones(len(beta), dtype=np.bool_)
    if candidates.any():
        beta[candidates] = np.linalg.lstsq(unit[:, candidates], target, rcond=None)[0]
    return beta


def _scale(chi: Array) -> Array:
    """Returns the spread (K,) of each feature; 1 for the constant."""
    spread = chi.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def by_weight(beta: Array, noise_floor: float = 0.0) -> NDArray[np.intp]:
    """Returns indices of standardised coefficients (K,), largest first, without rounding errors."""
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    order = np.argsort(-size, kind="stable")
    return np.asarray(order[size[order] > 0.0])


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Selects the standardised coefficients (K,) to keep (Eq. 2).

    In order of size, coefficients are kept while their sum stays below the share `alpha` of the
    total, and also the one that crosses it. Those up to `noise_floor` are rounding errors and
    never count.
    """
    order = by_weight(beta, noise_floor)
    size = np.abs(beta[order])
    keep = np.zeros(len(beta), dtype=np.bool_)
    keep[order] = np.cumsum(size) - size < alpha * size.sum()
    return keep


def pruned(regression: Regression, spec: RobotSpec, alpha: Alpha = ALPHA) -> Fit:
    """Prunes a regression (Eq. 2) and estimates the coefficients of the kept terms anew.

    Args:
        regression: on all features.
        spec: the robot.
        alpha: the share of the summed standardised coefficients that the kept terms of each
            degree of freedom reach (Eq. 2). The term that crosses the threshold is kept too:
            with a literal Eq. 2 a differential robot, whose wheels have equal weight, would
            lose one of them. `auto` keeps as many terms, in the same order, as improve the
            cross-validated error (`statistics.knee`).
    """
    samples, shape = regression.samples, regression.beta.shape
    coefficients, errors, conditions = np.zeros(shape), np.zeros(shape), np.ones(shape[0])
    curves, noisy_state = [], states_are_noisy(samples, spec)
    for d in regression.moving:
        chi, target = regression.rows(d)
        scale = _scale(chi)
        unit = chi / scale
        keep, found = _kept(regression, d, unit, target, spec, alpha)
        if keep.any():
            beta = np.linalg.lstsq(unit[:, keep], target, rcond=None)[0]
            rest = target - unit[:, keep] @ beta
            coefficients[d, keep] = beta / scale[keep]
            errors[d, keep] = standard_errors(unit[:, keep], rest) / scale[keep]
        if noisy_state and d >= 3:
            _reestimate(coefficients[d], errors[d], d, regression, len(spec.state))
        conditions[d] = condition(chi[:, keep])
        curves.append(found)
    model = _model(regression, spec, coefficients, errors)
    rmse, r2 = errors_of(model, samples)
    for d in regression.moving:
        if not regression.inliers[d].all():
            some = errors_of(model, samples.rows(regression.inliers[d]))
            rmse[d], r2[d] = some[0][d], some[1][d]
    return Fit(
        model, rmse, r2, regression.terms_total, regression.excitation, regression.dependent,
        curves=tuple(curves),
        outliers=1.0 - (1.0 - regression.left_out) * regression.inliers.mean(axis=1),
        condition=conditions,
        samples=len(samples.t),
    )  # fmt: skip


def _kept(
    regression: Regression, d: int, unit: Array, target: Array, spec: RobotSpec, alpha: Alpha
) -> tuple[NDArray[np.bool_], Curve]:
    """Returns a mask (K,) of the terms that a degree of freedom keeps, and its accuracy curve."""
    beta = regression.beta[d]
    floor = ROUNDING * max(float(np.abs(target).max()), ROUNDING)
    order = by_weight(beta, floor)
    names = (taylor.term_name(row, spec.variable_names) for row in regression.powers[order])
    found = curve(spec.dof_names[d], tuple(names), unit[:, order], target)
    if alpha == "auto":
        keep = np.zeros(len(beta), dtype=np.bool_)
        keep[order[: found.kept]] = True
    else:
        keep = prune(beta, alpha, floor)
    return keep, replace(found, kept=int(keep.sum()))


def _reestimate(
    coefficients: Array, errors: Array, d: int, regression: Regression, states: int
) -> None:
    """Replaces the coefficients (K,) of a state's rate, and their errors, by instruments.

    The noise of a state is both in X and in its rate, so that least squares would mistake it for a
    fast decay. The noise of the state one step earlier is independent of the noise in dQ, so that
    state serves as an instrument for X. They stay if the instruments are too weak.
    """
    samples, inside, kept = regression.samples, regression.inliers[d], np.flatnonzero(coefficients)
    follows = np.abs(np.diff(samples.t) - samples.dt) < SAME_STEP * samples.dt + ROUNDING_S
    now = np.flatnonzero(follows & inside[1:] & inside[:-1]) + 1
    if len(kept) == 0 or len(now) <= len(kept):
        return
    earlier, powers = samples.x[now].copy(), regression.powers[kept]
    earlier[:, :states] = samples.x[now - 1, :states]
    chi, instruments = (taylor.evaluate(x, powers) for x in (samples.x[now], earlier))
    found = instrumental(chi, instruments, samples.dq[now, d])
    if found is not None:
        coefficients[kept], errors[kept] = found


def _model(
    regression: Regression, spec: RobotSpec, coefficients: Array, errors: Array
) -> TaylorModel:
    """Builds a TaylorModel of the terms that any degree of freedom keeps."""
    samples, used = regression.samples, np.abs(coefficients).sum(axis=0) > 0.0
    return TaylorModel(
        variables=spec.variable_names,
        dofs=spec.dof_names,
        dof_units=spec.dof_units,
        powers=regression.powers[used],
        coefficients=coefficients[:, used],
        dt=samples.dt,
        low=samples.x.min(axis=0),
        high=samples.x.max(axis=0),
        std_errors=errors[:, used],
    )
