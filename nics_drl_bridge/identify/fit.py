"""Fits a Taylor model to rates of motion: least squares, pruning, least squares again (Sec. IV-A).

For each degree of freedom d and features chi(X), products of state and commands up to an order:

    Eq. 1   dQ_d/dt = sum_k A_dk chi_k(X)            least squares over the rows of a drive
    Eq. 2   keep the fewest, largest terms with  sum |beta_kept| >= alpha sum |beta|

beta is A for features that are divided by their standard deviations (their means stay), so that the
sizes of terms can be compared.
`regress` is Eq. 1 on all features; `prune_and_refit` is Eq. 2, and Eq. 1 again on the kept terms.
"""

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
# From the exponents (K, V) of features, selects the terms (D, K) that a model may have.
TermFilter = Callable[[NDArray[np.int64], RobotSpec], NDArray[np.bool_]]

ALPHA: Alpha = 0.99
ORDER = 2
TWIST_ROWS = slice(3)  # rows of dQ/dt: vx, vy, wz; the rates of the states follow
# Standardised coefficients below this fraction of the largest rate are rounding errors.
ROUNDING = 1e-9
LEAST_RATE = 1e-9  # that rate is at least so large [unit of the rate]
# A row is one step after the previous one if it is within this fraction of a step, and this time.
STEP_TOLERANCE = 1e-3
STEP_TOLERANCE_S = 1e-6


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold: a number from 0 to 1, or `auto`; else ConfigError."""
    if text == "auto":
        return "auto"
    with suppress(ValueError):
        value = float(text)
        if 0.0 <= value <= 1.0:
            return value
    raise ConfigError(f"alpha is {text!r}; it must be a number from 0 to 1, or auto.")


def parse_order(text: str) -> Order:
    """Parses the order of a model: 1 to 4, or `auto`; else ConfigError."""
    if text not in ("auto", "1", "2", "3", "4"):
        raise ConfigError(f"order is {text!r}; it must be 1, 2, 3 or 4, or auto.")
    return "auto" if text == "auto" else int(text)


@dataclass(frozen=True)
class Regression:
    """Least squares of dQ/dt on all features (Eq. 1).

    Attributes:
        samples: the T rows, without implausible ones.
        powers: (K, V) exponents of the independent features of the variables that moved.
        chi: (T, K) features.
        beta: (D, K) standardised coefficients; zero for a term that is not allowed or was dropped.
        inliers: (D, T) rows that are not outliers.
        moving: degrees of freedom that are fitted: all but a vx or vy that hardly moves.
        excitation: of the variables by the drive.
        dependent: terms that are linear combinations of others on this drive.
        terms_total: number of coefficients before any selection.
        left_out: fraction of the rows that were implausible.
    """

    samples: Samples
    powers: NDArray[np.int64]
    chi: Array
    beta: Array
    inliers: NDArray[np.bool_]
    moving: tuple[int, ...]
    excitation: excitation.Excitation
    dependent: tuple[str, ...]
    terms_total: int
    left_out: float

    def rows(self, d: int) -> tuple[Array, Array]:
        """Returns features (n, K) and rates (n,) of a degree of freedom without its outliers."""
        inside = self.inliers[d]
        target = self.samples.dq[:, d]
        if inside.all():
            return (self.chi, target)
        return (self.chi[inside], target[inside])

    def noise_floor(self, d: int) -> float:
        """Returns the standardised coefficient up to which a term is a rounding error."""
        largest_rate = float(np.abs(self.rows(d)[1]).max())
        return ROUNDING * max(largest_rate, LEAST_RATE)


@dataclass(frozen=True)
class Fit:
    """A fitted model and its goodness of fit.

    Attributes:
        model: the pruned model, with standard errors.
        regression: on all features.
        rmse: (D,) root mean square residual of dQ/dt without outliers, in units of dQ/dt.
        r2: (D,) fraction of the variance that the model explains.
        alpha: threshold used for pruning, or `auto`.
        outliers: (D,) fraction of the rows left out, as implausible or as outliers.
        condition: (D,) condition number of the kept standardised features.
    """

    model: TaylorModel
    regression: Regression
    rmse: Array
    r2: Array
    alpha: Alpha
    outliers: Array
    condition: Array

    @cached_property
    @np.errstate(over="ignore", invalid="ignore")
    def curves(self) -> tuple[statistics.Curve, ...]:
        """Accuracy against the number of terms, for the degrees of freedom that move."""
        curves = []
        for d in self.regression.moving:
            curve = _cross_validate(
                self.regression, d, self.model.dofs, self.model.variables
            )
            if self.alpha != "auto":
                beta = self.regression.beta[d]
                kept = prune(beta, self.alpha, self.regression.noise_floor(d))
                curve = replace(curve, kept=int(kept.sum()))
            curves.append(curve)
        return tuple(curves)

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Variables that never changed during the drive; no term uses them."""
        return self.regression.excitation.unmoved


@one_blas_thread
def fit(
    samples: Samples,
    spec: RobotSpec,
    order: int = ORDER,
    alpha: Alpha = ALPHA,
    noisy: bool = False,
) -> Fit:
    """Fits and prunes a Taylor model; for arguments and errors see `regress`, `prune_and_refit`."""
    return prune_and_refit(regress(samples, spec, order, noisy), spec, alpha)


def regress(
    samples: Samples,
    spec: RobotSpec,
    order: int,
    noisy: bool = False,
    term_filter: TermFilter | None = None,
) -> Regression:
    """Fits all features up to an order (Eq. 1).

    Args:
        samples: rows of X and dQ/dt.
        spec: the robot.
        order: maximum order of a feature, 1 to 4.
        noisy: leave out terms that are not significant. Without a `term_filter`, the twist of a
            robot with a state then has terms of the state only, and no constant if a speed changed:
            a command acts through the state; noise hides any direct effect within a step.
        term_filter: selects the terms of each degree of freedom.

    Raises:
        FitError: too few samples, or no variable changed.
    """
    plausible = excitation.select_plausible_rows(samples.x, spec)
    samples = samples.rows(plausible)
    names = spec.variable_names
    excited = excitation.Excitation.of(samples, spec)
    all_powers = taylor.list_exponents(len(names), order)
    moved_powers = excitation.select_moved_terms(all_powers, names, excited.unmoved)
    if term_filter is not None:
        used = term_filter(moved_powers, spec).any(axis=0)
        moved_powers = moved_powers[used]
    excitation.check_sample_count(samples, len(moved_powers))
    chi = taylor.evaluate(samples.x, moved_powers)
    independent, dependent = excitation.split_independent_columns(chi)
    chi = chi[:, independent]
    powers = moved_powers[independent]

    dofs = samples.dq.shape[1]
    if term_filter is not None:
        allowed = term_filter(powers, spec)
    else:
        allowed = np.ones((dofs, len(powers)), dtype=np.bool_)
        if noisy:
            allowed[TWIST_ROWS] = excitation.select_twist_terms(
                powers, spec, excited.unmoved
            )
    beta = np.zeros((dofs, len(powers)))
    inliers = np.ones((dofs, len(samples.dq)), dtype=np.bool_)
    moving = excitation.list_moving_dofs(samples.dq)
    usual_ranges = excitation.measure_usual_ranges(samples.dq)
    for d in moving:
        terms = np.flatnonzero(allowed[d])
        features = chi[:, terms]
        target = samples.dq[:, d]
        # The spreads change when outliers are left out.
        inliers[d] = excitation.select_inliers(
            features / _spreads(features), target, float(usual_ranges[d])
        )
        if not inliers[d].all():
            features = features[inliers[d]]
            target = target[inliers[d]]
        standardised = features / _spreads(features)
        if noisy:
            significant = statistics.select_significant(standardised, target)
            standardised = standardised[:, significant]
            terms = terms[significant]
        if len(terms):
            beta[d, terms] = np.linalg.lstsq(standardised, target, rcond=None)[0]
    return Regression(
        samples=samples,
        powers=powers,
        chi=chi,
        beta=beta,
        inliers=inliers,
        moving=moving,
        excitation=excited,
        dependent=tuple(
            taylor.format_term(row, names) for row in moved_powers[dependent]
        ),
        terms_total=dofs * len(all_powers),
        left_out=1.0 - float(plausible.mean()),
    )


def _spreads(features: Array) -> Array:
    """Returns the standard deviation (K,) of each feature; 1 for a constant one."""
    spread = features.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def sort_by_size(beta: Array, noise_floor: float) -> NDArray[np.intp]:
    """Returns the indices of standardised coefficients (K,), largest first.

    Leaves out coefficients that are not above `noise_floor`.
    """
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    by_size = np.argsort(-size, kind="stable")
    return np.asarray(by_size[size[by_size] > 0.0])


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Returns a mask (K,) of the standardised coefficients that are kept (Eq. 2).

    Keeps the largest until their sum reaches `alpha` times the total, including the term that
    crosses it: to stop before that term would drop one of two equal wheels. Coefficients up to
    `noise_floor` never count.
    """
    by_size = sort_by_size(beta, noise_floor)
    size = np.abs(beta[by_size])
    sum_of_larger = np.cumsum(size) - size
    kept = by_size[sum_of_larger < alpha * size.sum()]
    return np.isin(np.arange(len(beta)), kept)


def prune_and_refit(regression: Regression, spec: RobotSpec, alpha: Alpha) -> Fit:
    """Prunes a regression (Eq. 2) and fits the terms that are kept again (Eq. 1).

    With `auto` in place of a threshold, terms are taken in the order of their size, the fewest
    whose cross-validated error is within one standard error of the minimum.
    """
    samples = regression.samples
    coefficients = np.zeros(regression.beta.shape)
    errors = np.zeros(regression.beta.shape)
    conditions = np.ones(len(regression.beta))
    needs_instruments = excitation.states_are_noisy(samples, spec)
    for d in regression.moving:
        features, target = regression.rows(d)
        spreads = _spreads(features)
        standardised = features / spreads
        kept = _select_terms(regression, d, spec, alpha)
        if kept.any():
            beta = np.linalg.lstsq(standardised[:, kept], target, rcond=None)[0]
            residual = target - standardised[:, kept] @ beta
            beta_errors = statistics.estimate_standard_errors(
                standardised[:, kept], residual
            )
            coefficients[d, kept] = beta / spreads[kept]
            errors[d, kept] = beta_errors / spreads[kept]
        if needs_instruments and d >= TWIST_ROWS.stop:
            by_instruments = _fit_by_instruments(
                regression, d, coefficients[d], len(spec.state)
            )
            if by_instruments is not None:
                terms = np.flatnonzero(coefficients[d])
                coefficients[d, terms], errors[d, terms] = by_instruments
        conditions[d] = statistics.compute_condition(features[:, kept])
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
    rmse, r2 = statistics.measure_rate_errors(model, samples)
    for d in regression.moving:
        inside = regression.inliers[d]
        if not inside.all():
            rmse_inside, r2_inside = statistics.measure_rate_errors(
                model, samples.rows(inside)
            )
            rmse[d] = rmse_inside[d]
            r2[d] = r2_inside[d]
    outliers = 1.0 - (1.0 - regression.left_out) * regression.inliers.mean(axis=1)
    return Fit(model, regression, rmse, r2, alpha, outliers, conditions)


def _select_terms(
    regression: Regression, d: int, spec: RobotSpec, alpha: Alpha
) -> NDArray[np.bool_]:
    """Returns a mask (K,) of the terms that a degree of freedom keeps."""
    beta = regression.beta[d]
    noise_floor = regression.noise_floor(d)
    if alpha != "auto":
        return prune(beta, alpha, noise_floor)
    curve = _cross_validate(regression, d, spec.dof_names, spec.variable_names)
    kept = sort_by_size(beta, noise_floor)[: curve.kept]
    return np.isin(np.arange(len(beta)), kept)


def _cross_validate(
    regression: Regression, d: int, dofs: tuple[str, ...], variables: tuple[str, ...]
) -> statistics.Curve:
    """Returns the error of a degree of freedom by its number of terms; `kept` is at the knee."""
    by_size = sort_by_size(regression.beta[d], regression.noise_floor(d))
    features, target = regression.rows(d)
    standardised = features / _spreads(features)
    names = [taylor.format_term(row, variables) for row in regression.powers[by_size]]
    return statistics.make_curve(
        dofs[d], tuple(names), standardised[:, by_size], target
    )


def _fit_by_instruments(
    regression: Regression, d: int, coefficients: Array, state_count: int
) -> tuple[Array, Array] | None:
    """Returns coefficients (n,) and errors of a state's nonzero terms; None if data are too few.

    A state's noise appears in X and, with the opposite sign, in its rate; least squares would take
    that for a fast decay. The noise one step earlier is independent, so the earlier state is an
    instrument for X. Returns None also if the instruments are too weak.
    """
    samples = regression.samples
    inside = regression.inliers[d]
    terms = np.flatnonzero(coefficients)
    step_error = np.abs(np.diff(samples.t) - samples.dt)
    is_next = step_error < STEP_TOLERANCE * samples.dt + STEP_TOLERANCE_S
    rows = np.flatnonzero(is_next & inside[1:] & inside[:-1]) + 1
    if len(terms) == 0 or len(rows) <= len(terms):
        return None
    x = samples.x[rows]
    x_earlier = x.copy()
    x_earlier[:, :state_count] = samples.x[rows - 1, :state_count]
    powers = regression.powers[terms]
    return statistics.fit_by_instruments(
        taylor.evaluate(x, powers),
        taylor.evaluate(x_earlier, powers),
        samples.dq[rows, d],
    )
