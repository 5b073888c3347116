"""Fits a Taylor model to rates of motion: least squares, pruning, least squares again (Sec. IV-A).

For each degree of freedom d and features chi(X), products of state and commands up to an order:

    Eq. 1   dQ_d/dt = sum_k A_dk chi_k(X)            least squares over the rows of a drive
    Eq. 2   keep the fewest, largest terms with  sum |beta_kept| >= alpha sum |beta|

beta is A for features that are divided by their standard deviations (their means stay), so that the
sizes of terms can be compared.
`regress` is Eq. 1 on all features; `prune_and_refit` is Eq. 2, and Eq. 1 again on the kept terms.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify import statistics
from nics_drl_bridge.identify.calibration import Alpha
from nics_drl_bridge.identify.statistics import GAUSSIAN_MAD, measure_white_noise
from nics_drl_bridge.recording.recording import Recording, Samples, samples_on_one_clock
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.threads import one_blas_thread

STILL = 1e-3  # a variable whose spread is below this fraction of its range did not move
# a state below this multiple of its noise did not move if its command did not
NOISE_ONLY = 1.5
# a normalised feature whose part orthogonal to the earlier ones is smaller is a copy
DEPENDENT = 1e-7
# commands are linearly dependent if a normalised combination is smaller
TOGETHER = 1e-3
MIN_SAMPLES_PER_TERM = 5
# a velocity component below this fraction of the other one is modelled as zero
NEGLIGIBLE = 1e-3
# a measured state is noisy if its noise exceeds this fraction of its range
NOISY = 5e-4
BULK = 0.75  # fraction of the rows used in the initial fit
CONCENTRATIONS = 12
FAR = 8.0  # an outlier is this many standard deviations of the bulk away
LEAST = 1e-6  # rates below this, in SI units, are rounding errors and never outliers
# percentiles that bound the usual range; jumps in 5 % of the rows lie outside
USUAL = (5.0, 95.0)
MOST = 0.2  # a larger fraction of rows are not outliers but a misfit of the model
# a value beyond its limits by this fraction of its range is a sensor fault
BEYOND = 0.5
# If there are outliers, the misfit of the rest is estimated from its tail, not from its median.
BULK_PERCENTILE = 90.0
GAUSSIAN_BULK = 1.645
GRID_S = 0.05
ENDS = (2.0, 98.0)  # percentiles that bound the range of a command
# a drive over a smaller fraction of a command's range says little about the rest
NARROW = 0.4


@dataclass(frozen=True)
class Excitation:
    """Which of a robot's variables a drive moves."""

    # variables that the drive never moved, so no term contains them
    unmoved: tuple[str, ...]
    together: tuple[str, ...]  # commands that moved, but were linearly dependent

    @classmethod
    def of(cls, samples: Samples, spec: RobotSpec) -> "Excitation":
        """Computes the excitation from a drive's samples."""
        return cls(
            list_unmoved_variables(samples, spec), list_commands_together(samples, spec)
        )


def list_unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the variables of X that stayed constant, or show only noise without a command."""
    limits = np.array([v.max - v.min for v in (*spec.state, *spec.command)])
    spread = samples.x.std(axis=0)
    still = spread < STILL * limits
    noise_only = spread < NOISE_ONLY * measure_white_noise(samples.x)
    named = dict(zip(spec.variable_names, still, strict=True))
    for i, variable in enumerate(spec.state):
        if variable.follows:
            followed = [variable.follows]
        else:
            followed = [c.name for c in spec.command]
        still[i] |= noise_only[i] and all(named[name] for name in followed)
    return tuple(compress(spec.variable_names, still))


def list_commands_together(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Returns the commands that moved, but were linearly dependent."""
    part_of = (
        np.abs(find_constant_combinations(samples, spec)).max(axis=0, initial=0.0) > 0.1
    )
    return tuple(c.name for c, part in zip(spec.command, part_of, strict=True) if part)


def find_constant_combinations(samples: Samples, spec: RobotSpec) -> Array:
    """Returns orthonormal combinations (N, C) of the scaled commands that stayed constant."""
    command = samples.x[:, len(spec.state) :]
    reach = np.array([c.max - c.min for c in spec.command])
    moved = np.flatnonzero(command.std(axis=0) >= STILL * reach)
    unit = command[:, moved] - command[:, moved].mean(axis=0)
    size, axes = np.linalg.svd(
        unit / np.linalg.norm(unit, axis=0), full_matrices=False
    )[1:]
    constant = np.zeros((np.count_nonzero(size <= TOGETHER), len(reach)))
    constant[:, moved] = axes[size <= TOGETHER]
    return constant


def split_independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; earlier, low-order ones are kept first.

    A column of zeros counts as a copy.
    """
    unit = chi / np.maximum(np.linalg.norm(chi, axis=0), np.finfo(np.float64).tiny)
    # no pivoting: each column is compared with its predecessors
    apart = np.abs(np.diag(scipy.linalg.qr(unit, mode="r")[0])) > DEPENDENT
    return np.flatnonzero(apart), np.flatnonzero(~apart)


def select_moved_terms(
    powers: NDArray[np.int64], names: tuple[str, ...], unmoved: tuple[str, ...]
) -> NDArray[np.int64]:
    """Returns the terms (K, V) of variables that moved; FitError if none did."""
    if len(unmoved) == len(names):
        raise FitError(
            "no command ever changed, so nothing can be learnt; vary each command."
        )
    still = [names.index(name) for name in unmoved]
    moved: NDArray[np.int64] = powers[(powers[:, still] == 0).all(axis=1)]
    return moved


def check_sample_count(samples: Samples, terms: int) -> None:
    """Raises FitError if the samples are too few for a number of terms."""
    if len(samples.t) < MIN_SAMPLES_PER_TERM * terms:
        few = f"{len(samples.t)} samples are too few for {terms} terms"
        raise FitError(f"{few}; drive for longer, or lower the order.")


def select_twist_terms(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved: tuple[str, ...]
) -> NDArray[np.bool_]:
    """Selects the terms (K,) allowed in the body twist of a noisy recording."""
    if not spec.state:
        return np.ones(len(powers), dtype=np.bool_)
    allowed = (powers[:, len(spec.state) :] == 0).all(axis=1)
    if any(v.unit == "m/s" and v.name not in unmoved for v in spec.state):
        allowed &= powers.sum(axis=1) > 0
    return np.asarray(allowed)


def list_moving_dofs(dq: Array) -> tuple[int, ...]:
    """Returns indices of the rates (T, D) that move: vx, vy unless negligible, and the others."""
    size = np.sqrt((dq**2).mean(axis=0))
    return tuple(
        d for d in range(len(size)) if d > 1 or size[d] > NEGLIGIBLE * size[:2].max()
    )


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """True if the noise of a measured state would bias a fit."""
    width = np.array([v.max - v.min for v in spec.state])
    return bool((measure_white_noise(samples.x[:, : len(width)]) > NOISY * width).any())


def select_inliers(chi: Array, target: Array, usual: float) -> NDArray[np.bool_]:
    """Selects the rows of a target (T,) on features (T, K) that are not outliers."""
    everything = np.ones(len(target), dtype=np.bool_)
    plain = _measure_residuals(chi, target)
    if not (
        plain > max(FAR / 2.0 * float(np.median(plain)) / GAUSSIAN_MAD, usual)
    ).any():
        return everything
    count = max(int(BULK * len(target)), min(len(target), chi.shape[1] + 1))
    bulk = np.argsort(np.abs(target - np.median(target)), kind="stable")[:count]
    for start in (np.argsort(plain, kind="stable")[:count], bulk):
        rest = _fit_best_rows(chi, target, start)
        inside = (
            rest <= FAR * float(np.percentile(rest, BULK_PERCENTILE)) / GAUSSIAN_BULK
        )
        if inside.mean() >= 1.0 - MOST:
            return np.asarray(inside)
    return everything


def select_plausible_rows(x: Array, spec: RobotSpec) -> NDArray[np.bool_]:
    """Selects the rows (T,) of X (T, V) that are within or close to the variables' limits."""
    low, high = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    margin = BEYOND * (high - low)
    inside = ((x >= low - margin) & (x <= high + margin)).all(axis=1)
    if inside.mean() >= 1.0 - MOST:
        return np.asarray(inside)
    return np.ones(len(x), dtype=np.bool_)


def _fit_best_rows(chi: Array, target: Array, chosen: NDArray[np.intp]) -> Array:
    """Returns absolute residuals (T,) of a fit to the best-fitting rows, starting from `chosen`."""
    for _ in range(CONCENTRATIONS):
        rest = _measure_residuals(chi, target, chosen)
        again = np.argsort(rest, kind="stable")[: len(chosen)]
        if np.array_equal(np.sort(again), np.sort(chosen)):
            return rest
        chosen = again
    return _measure_residuals(chi, target, chosen)


def _measure_residuals(
    chi: Array, target: Array, rows: NDArray[np.intp] | slice = slice(None)
) -> Array:
    """Returns absolute residuals (T,) of a least-squares fit to some rows."""
    return np.abs(
        target - chi @ np.linalg.lstsq(chi[rows], target[rows], rcond=None)[0]
    )


def measure_usual_ranges(dq: Array) -> Array:
    """Returns the width (D,) of the usual range of rates (T, D); x and y share the wider one."""
    low, high = np.percentile(dq, USUAL, axis=0)
    width = np.maximum(high - low, LEAST)
    width[:2] = width[:2].max()
    return np.asarray(width)


@dataclass(frozen=True)
class CommandCoverage:
    """Coverage of one command by a drive."""

    name: str
    unit: str
    low: float  # its range, without the outer 2 % at each end
    high: float
    share: float  # fraction of the range that the robot's limits allow
    own: float  # fraction of its spread that the other commands do not explain
    fault: str  # why it can't be learnt; empty if it can

    def line(self) -> str:
        """Formats one line for people."""
        if self.fault:
            return f"{self.name}: {self.fault}"
        moved = f"from {self.low:.2f} to {self.high:.2f} {self.unit}"
        share = f"{100.0 * self.share:.0f} % of its range"
        return f"{self.name}: moved {moved} ({share}), {100.0 * self.own:.0f} % of it on its own"


def describe_narrow_commands(recording: Recording, spec: RobotSpec) -> list[str]:
    """Returns a sentence for each command of which a drive covers only a small part."""
    return [
        f"{c.name} covers {100.0 * c.share:.0f} % of its range, {c.low:.3g} to {c.high:.3g} "
        f"{c.unit}: beyond that the simulator guesses; drive over the whole range, or narrow it in "
        "the robot's file."
        for c in measure_coverage(recording, spec)
        if not c.fault and c.share < NARROW
    ]


def measure_coverage(
    recording: Recording, spec: RobotSpec
) -> tuple[CommandCoverage, ...]:
    """Measures the coverage of each command of a recording, by the same rules as a fit."""
    t = recording.command.t
    grid = np.arange(t[0], t[-1], GRID_S)
    rows = np.searchsorted(t, grid, side="right") - 1
    command = recording.command.values[rows]
    nothing = np.zeros((len(grid), 3))
    samples = samples_on_one_clock(grid, nothing, nothing[:, :0], command)
    excited = Excitation.of(samples, spec.model_copy(update={"state": ()}))
    faults = dict.fromkeys(excited.together, "moved only together with others")
    faults |= dict.fromkeys(excited.unmoved, "never moved")
    ranges = np.percentile(command, ENDS, axis=0).T.tolist()
    own_shares = _measure_own_shares(samples.x).tolist()
    return tuple(
        CommandCoverage(
            c.name,
            c.unit,
            low=low,
            high=high,
            share=(high - low) / (c.max - c.min),
            own=own,
            fault=faults.get(c.name, ""),
        )
        for c, (low, high), own in zip(spec.command, ranges, own_shares, strict=True)
    )


def _measure_own_shares(x: Array) -> Array:
    """Returns the fraction (C,) of each column's spread that is independent of the others."""
    centred = x - x.mean(axis=0)
    shares = np.zeros(x.shape[1])
    for i, size in enumerate(np.linalg.norm(centred, axis=0)):
        others = np.delete(centred, i, axis=1)
        rest = (
            centred[:, i]
            - others @ np.linalg.lstsq(others, centred[:, i], rcond=None)[0]
        )
        shares[i] = np.linalg.norm(rest) / size if size > 0.0 else 0.0
    return shares


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
    excitation: Excitation
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
    plausible = select_plausible_rows(samples.x, spec)
    samples = samples.rows(plausible)
    excited = Excitation.of(samples, spec)
    if term_filter is None:
        unmoved = excited.unmoved if noisy else None
        term_filter = partial(_select_default_terms, unmoved_if_noisy=unmoved)
    moved_powers = select_moved_terms(
        taylor.list_exponents(len(spec.variable_names), order),
        spec.variable_names,
        excited.unmoved,
    )
    moved_powers = moved_powers[term_filter(moved_powers, spec).any(axis=0)]
    check_sample_count(samples, len(moved_powers))
    chi = taylor.evaluate(samples.x, moved_powers)
    independent, dependent = split_independent_columns(chi)
    powers = moved_powers[independent]
    chi = chi[:, independent]
    beta, inliers = _fit_rates(samples.dq, chi, term_filter(powers, spec), noisy)
    return Regression(
        samples=samples,
        powers=powers,
        chi=chi,
        beta=beta,
        inliers=inliers,
        moving=list_moving_dofs(samples.dq),
        excitation=excited,
        dependent=_name_terms(moved_powers[dependent], spec.variable_names),
        terms_total=_count_terms(spec, order),
        left_out=1.0 - float(plausible.mean()),
    )


def _select_default_terms(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved_if_noisy: tuple[str, ...] | None
) -> NDArray[np.bool_]:
    """Selects the terms (D, K) of a recording: all, but not in the twist if it is noisy."""
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    if unmoved_if_noisy is not None:
        allowed[TWIST_ROWS] = select_twist_terms(powers, spec, unmoved_if_noisy)
    return allowed


def _name_terms(powers: NDArray[np.int64], names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(taylor.format_term(row, names) for row in powers)


def _count_terms(spec: RobotSpec, order: int) -> int:
    """Returns the number of coefficients of a model before any selection."""
    powers = taylor.list_exponents(len(spec.variable_names), order)
    return len(spec.dof_names) * len(powers)


def _fit_rates(
    dq: Array, chi: Array, allowed: NDArray[np.bool_], noisy: bool
) -> tuple[Array, NDArray[np.bool_]]:
    """Returns standardised coefficients (D, K), and the rows (D, T) of rates (T, D) that fit."""
    beta = np.zeros(allowed.shape)
    inliers = np.ones((len(allowed), len(dq)), dtype=np.bool_)
    usual_ranges = measure_usual_ranges(dq).tolist()
    for d in list_moving_dofs(dq):
        beta[d, allowed[d]], inliers[d] = _fit_features(
            chi[:, allowed[d]], dq[:, d], usual_ranges[d], noisy
        )
    return beta, inliers


def _fit_features(
    features: Array, target: Array, usual: float, noisy: bool
) -> tuple[Array, NDArray[np.bool_]]:
    """Returns standardised coefficients (K,) of features (T, K), and the rows (T,) that fit.

    Rates (T,) within their `usual` range are no outliers. Of a `noisy` target, insignificant
    coefficients are zero.
    """
    # The spreads change when outliers are left out.
    inliers = select_inliers(features / _spreads(features), target, usual)
    if not inliers.all():
        features = features[inliers]
        target = target[inliers]
    standardised = features / _spreads(features)
    used = np.ones(features.shape[1], dtype=np.bool_)
    if noisy:
        used = statistics.select_significant(standardised, target)
    beta = np.zeros(features.shape[1])
    if used.any():
        beta[used] = np.linalg.lstsq(standardised[:, used], target, rcond=None)[0]
    return beta, inliers


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
    coefficients, errors = _refit_dofs(regression, spec, alpha)
    conditions = np.ones(len(coefficients))
    for d in regression.moving:
        kept = coefficients[d] != 0.0
        features, _ = regression.rows(d)
        conditions[d] = statistics.compute_condition(features[:, kept])
        if np.isnan(errors[d, kept]).any():
            errors[d, kept] = _estimate_errors(regression, d, coefficients[d], kept)
    model = _make_model(regression, spec, coefficients, errors)
    rmse, r2 = _measure_fit(regression, model)
    outliers = 1.0 - (1.0 - regression.left_out) * regression.inliers.mean(axis=1)
    return Fit(model, regression, rmse, r2, alpha, outliers, conditions)


def fit_kept_terms(
    regression: Regression, spec: RobotSpec, alpha: Alpha
) -> TaylorModel:
    """Does the same as `prune_and_refit`, without errors, which take most of the time."""
    coefficients, _ = _refit_dofs(regression, spec, alpha)
    return _make_model(regression, spec, coefficients)


def _refit_dofs(
    regression: Regression, spec: RobotSpec, alpha: Alpha
) -> tuple[Array, Array]:
    """Returns coefficients (D, K) of the kept terms; errors of those by instruments, else NaN."""
    coefficients = np.zeros(regression.beta.shape)
    errors = np.full(regression.beta.shape, np.nan)
    needs_instruments = states_are_noisy(regression.samples, spec)
    for d in regression.moving:
        kept = _select_terms(regression, d, spec, alpha)
        if kept.any():
            coefficients[d, kept] = _refit_terms(regression, d, kept)
        if needs_instruments and d >= TWIST_ROWS.stop:
            by_instruments = _fit_by_instruments(
                regression, d, coefficients[d], len(spec.state)
            )
            if by_instruments is not None:
                terms = np.flatnonzero(coefficients[d])
                coefficients[d, terms], errors[d, terms] = by_instruments
    return coefficients, errors


def _make_model(
    regression: Regression,
    spec: RobotSpec,
    coefficients: Array,
    errors: Array | None = None,
) -> TaylorModel:
    """Returns the model of the terms that have coefficients (D, K), maybe with errors (D, K)."""
    samples = regression.samples
    used = coefficients.any(axis=0)
    model = TaylorModel(
        spec.variable_names,
        spec.dof_names,
        spec.dof_units,
        regression.powers[used],
        coefficients[:, used],
        samples.dt,
        samples.x.min(axis=0),
        samples.x.max(axis=0),
    )
    if errors is None:
        return model
    known = np.where(model.coefficients != 0.0, errors[:, used], 0.0)
    return replace(model, std_errors=known)


def _measure_fit(regression: Regression, model: TaylorModel) -> tuple[Array, Array]:
    """Returns RMSE (D,) and R2 (D,) of a model's rates, each without its outliers."""
    samples = regression.samples
    rmse, r2 = statistics.measure_rate_errors(model, samples)
    for d in regression.moving:
        inside = regression.inliers[d]
        if not inside.all():
            errors, shares = statistics.measure_rate_errors(model, samples.rows(inside))
            rmse[d] = errors[d]
            r2[d] = shares[d]
    return rmse, r2


def _refit_terms(regression: Regression, d: int, kept: NDArray[np.bool_]) -> Array:
    """Returns the coefficients of the terms (K,) that are kept (Eq. 1)."""
    features, target = regression.rows(d)
    spreads = _spreads(features[:, kept])
    beta = np.linalg.lstsq(features[:, kept] / spreads, target, rcond=None)[0]
    return np.asarray(beta / spreads)


def _estimate_errors(
    regression: Regression, d: int, coefficients: Array, kept: NDArray[np.bool_]
) -> Array:
    """Returns the standard errors of the coefficients (K,) that are kept."""
    features, target = regression.rows(d)
    residual = target - features @ coefficients
    spreads = _spreads(features[:, kept])
    standardised = features[:, kept] / spreads
    return statistics.estimate_standard_errors(standardised, residual) / spreads


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
