"""Eqs. 1 and 2 on one page (Sec. IV-A): features, least squares, pruning, least squares again."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import excitation, statistics
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import one_blas_thread

Alpha = float | Literal["auto"]
Order = int | Literal["auto"]
# selects terms (D, K) by their powers
Library = Callable[[NDArray[np.int64], RobotSpec], NDArray[np.bool_]]

ALPHA: Alpha = 0.99
ORDER = 2
# standardised coefficients below this fraction of the rates are rounding errors
ROUNDING = 1e-9
SAME_STEP = 1e-3
ROUNDING_S = 1e-6


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold: a number from 0 to 1, or `auto`; else ConfigError."""
    if text == "auto":
        return "auto"
    with suppress(ValueError):
        if 0.0 <= (value := float(text)) <= 1.0:
            return value
    raise ConfigError(f"alpha is {text!r}; it must be a number from 0 to 1, or auto.")


def parse_order(text: str) -> Order:
    """Parses the order of a model: 1 to 4, or `auto`; else ConfigError."""
    if text not in ("auto", "1", "2", "3", "4"):
        raise ConfigError(f"order is {text!r}; it must be 1, 2, 3 or 4, or auto.")
    return "auto" if text == "auto" else int(text)


@dataclass(frozen=True)
class Regression:
    """Least squares of dQ/dt on all features (Eq. 1)."""

    samples: Samples  # T rows, without implausible ones
    # (K, V) exponents of the features that moved, without copies
    powers: NDArray[np.int64]
    chi: Array  # (T, K) features
    # (D, K) standardised coefficients; zero where not allowed or insignificant
    beta: Array
    inliers: NDArray[np.bool_]  # (D, T) rows that are not outliers
    moving: tuple[int, ...]  # degrees of freedom that move; the others have no terms
    excitation: excitation.Excitation  # of the variables by the drive
    dependent: tuple[str, ...]  # terms that duplicate others on this drive
    terms_total: int  # D x K before any selection
    left_out: float  # fraction of the rows that were implausible

    def rows(self, d: int) -> tuple[Array, Array]:
        """Returns features (n, K) and rates (n,) of a degree of freedom without its outliers."""
        inside = self.inliers[d]
        target = self.samples.dq[:, d]
        if inside.all():
            return (self.chi, target)
        return (self.chi[inside], target[inside])


@dataclass(frozen=True)
class Fit:
    """A fitted model and its goodness of fit."""

    model: TaylorModel  # the pruned model, with standard errors
    regression: Regression  # on all features
    rmse: Array  # (D,) root mean square residual of dQ/dt, in the dof's unit, without outliers
    r2: Array  # (D,) fraction of the variance explained; 1 if the dof does not move
    alpha: Alpha  # threshold used for pruning
    outliers: Array  # (D,) fraction of the rows dropped as outliers
    condition: Array  # (D,) condition number of the standardised kept features

    @cached_property
    @np.errstate(over="ignore", invalid="ignore")
    def curves(self) -> tuple[statistics.Curve, ...]:
        """Accuracy against the number of terms, for the degrees of freedom that move."""
        found = self.regression
        names = (self.model.dofs, self.model.variables)
        kept = {d: _kept(found, d, self.alpha, *names) for d in found.moving}
        return tuple(
            replace(_curve(found, d, *names), kept=int(keep.sum()))
            for d, keep in kept.items()
        )

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Variables that the drive never moved, so no term contains them."""
        return self.regression.excitation.unmoved


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
    samples: Samples,
    spec: RobotSpec,
    order: int = ORDER,
    noisy: bool = False,
    allowed: Library | None = None,
) -> Regression:
    """Fits all features of order 1 to 4 (Eq. 1); FitError: too few samples, or nothing moved."""
    # `allowed`, if given, selects the features of each degree of freedom.
    # `noisy` is True unless a recording is exact: insignificant terms are dropped before Eq. 2, and
    # the body twist depends on the state alone, if there is one, and is zero at zero speed: within
    # a step a command acts through the state, and in noise the two can't be separated.
    believed = excitation.plausible(samples.x, spec)
    samples = samples.rows(believed)
    excited = excitation.Excitation.of(samples, spec)
    names = spec.variable_names
    every = taylor.list_exponents(len(names), order)
    powers = excitation.moved_terms(samples, every, names, excited.unmoved)
    chi = taylor.evaluate(samples.x, powers)
    independent, dependent = excitation.independent_columns(chi)
    chi = chi[:, independent]
    kept = powers[independent]
    beta = np.zeros((samples.dq.shape[1], len(kept)))
    used = np.ones(samples.dq.T.shape, dtype=np.bool_)
    if allowed is None:
        terms = np.ones((beta.shape[0], len(kept)), dtype=np.bool_)
        if noisy:
            terms[:3] = excitation.terms_through_state(kept, spec, excited.unmoved)
    else:
        terms = allowed(kept, spec)
    usual = excitation.usual_ranges(samples.dq)
    moving = excitation.moving_dofs(samples.dq)
    for d in moving:
        some = chi[:, terms[d]]
        target = samples.dq[:, d]
        used[d] = excitation.inliers(some / _scale(some), target, float(usual[d]))
        if not used[d].all():
            some = some[used[d]]
            target = target[used[d]]
        unit = some / _scale(some)
        used_terms = np.flatnonzero(terms[d])
        if noisy:
            candidates = statistics.significant(unit, target)
            unit = unit[:, candidates]
            used_terms = used_terms[candidates]
        if len(used_terms):
            beta[d, used_terms] = np.linalg.lstsq(unit, target, rcond=None)[0]
    return Regression(
        samples,
        kept,
        chi,
        beta,
        used,
        moving,
        excited,
        dependent=tuple(taylor.format_term(row, names) for row in powers[dependent]),
        terms_total=samples.dq.shape[1] * len(every),
        left_out=1.0 - float(believed.mean()),
    )


def _scale(chi: Array) -> Array:
    spread = chi.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def by_weight(beta: Array, noise_floor: float = 0.0) -> NDArray[np.intp]:
    """Returns indices of standardised coefficients (K,), largest first, without rounding errors."""
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    order = np.argsort(-size, kind="stable")
    return np.asarray(order[size[order] > 0.0])


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Selects the standardised coefficients (K,) to keep: the largest, up to a fraction `alpha`."""
    # Includes the one that crosses it (Eq. 2); those up to `noise_floor` are rounding errors.
    order = by_weight(beta, noise_floor)
    size = np.abs(beta[order])
    return np.isin(
        np.arange(len(beta)), order[np.cumsum(size) - size < alpha * size.sum()]
    )


def pruned(regression: Regression, spec: RobotSpec, alpha: Alpha = ALPHA) -> Fit:
    """Keeps the fraction `alpha` of a regression (Eq. 2), or `auto`; refits the kept terms."""
    # The term that crosses the threshold is kept, else a differential robot would lose a wheel.
    # `auto` keeps as many terms, in the same order, as improve the cross-validated error.
    samples = regression.samples
    shape = regression.beta.shape
    coefficients = np.zeros(shape)
    errors = np.zeros(shape)
    conditions = np.ones(shape[0])
    noisy_state = excitation.states_are_noisy(samples, spec)
    for d in regression.moving:
        chi, target = regression.rows(d)
        scale = _scale(chi)
        unit = chi / scale
        keep = _kept(regression, d, alpha, spec.dof_names, spec.variable_names)
        if keep.any():
            beta = np.linalg.lstsq(unit[:, keep], target, rcond=None)[0]
            rest = target - unit[:, keep] @ beta
            coefficients[d, keep] = beta / scale[keep]
            errors[d, keep] = (
                statistics.standard_errors(unit[:, keep], rest) / scale[keep]
            )
        if noisy_state and d >= 3:
            _reestimate(coefficients[d], errors[d], d, regression, len(spec.state))
        conditions[d] = statistics.condition(chi[:, keep])
    used = np.abs(coefficients).sum(axis=0) > 0.0
    model = TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        regression.powers[used],
        coefficients[:, used],
        samples.dt,
        samples.x.min(axis=0),
        samples.x.max(axis=0),
        std_errors=errors[:, used],
    )
    rmse, r2 = statistics.errors_of(model, samples)
    for d in regression.moving:
        if not (inside := regression.inliers[d]).all():
            rmse[d], r2[d] = (
                each[d] for each in statistics.errors_of(model, samples.rows(inside))
            )
    outliers = 1.0 - (1.0 - regression.left_out) * regression.inliers.mean(axis=1)
    return Fit(model, regression, rmse, r2, alpha, outliers, conditions)


def _kept(
    regression: Regression,
    d: int,
    alpha: Alpha,
    dofs: tuple[str, ...],
    variables: tuple[str, ...],
) -> NDArray[np.bool_]:
    """Returns a mask (K,) of the terms that a degree of freedom keeps."""
    beta = regression.beta[d]
    floor = _floor(regression, d)
    if alpha != "auto":
        return prune(beta, alpha, floor)
    order = by_weight(beta, floor)[: _curve(regression, d, dofs, variables).kept]
    return np.isin(np.arange(len(beta)), order)


def _floor(regression: Regression, d: int) -> float:
    return ROUNDING * max(float(np.abs(regression.rows(d)[1]).max()), ROUNDING)


def _curve(
    regression: Regression, d: int, dofs: tuple[str, ...], variables: tuple[str, ...]
) -> statistics.Curve:
    """Returns the accuracy of a degree of freedom by its number of terms; `kept` is the knee."""
    order, (chi, target) = (
        by_weight(regression.beta[d], _floor(regression, d)),
        regression.rows(d),
    )
    names = tuple(
        taylor.format_term(row, variables) for row in regression.powers[order]
    )
    return statistics.curve(dofs[d], names, (chi / _scale(chi))[:, order], target)


def _reestimate(
    coefficients: Array, errors: Array, d: int, regression: Regression, states: int
) -> None:
    """Replaces a state's coefficients (K,) and errors by instrumental ones, unless weak."""
    # The noise of a state is in both X and its rate, which least squares would mistake for a fast
    # decay. The noise one step earlier is independent, so the earlier state is an instrument for X.
    samples = regression.samples
    inside = regression.inliers[d]
    kept = np.flatnonzero(coefficients)
    follows = (
        np.abs(np.diff(samples.t) - samples.dt) < SAME_STEP * samples.dt + ROUNDING_S
    )
    now = np.flatnonzero(follows & inside[1:] & inside[:-1]) + 1
    if len(kept) == 0 or len(now) <= len(kept):
        return
    earlier = samples.x[now].copy()
    powers = regression.powers[kept]
    earlier[:, :states] = samples.x[now - 1, :states]
    chi, instruments = (taylor.evaluate(x, powers) for x in (samples.x[now], earlier))
    found = statistics.instrumental(chi, instruments, samples.dq[now, d])
    if found is not None:
        coefficients[kept], errors[kept] = found
