"""Statistics of least squares: minima, standard errors, significance, accuracy of more terms."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import TaylorModel

UNLIKE = 0.05  # correlation below which residuals are assumed to be independent
LONGEST = 0.1  # longest correlation of residuals, as a fraction of the rows
# minimum ratio of a term of a noisy fit, or of a correction, to its standard error
CERTAIN = 3.0
WEAK = 1e4  # condition number of instruments x features above which instruments are too weak
# relative step and termination of `minimise`
DIFFERENCE = 1e-4
TOLERANCE = 1e-7
MAX_STEPS = 40
# relative improvement of the loss below which `minimise_robustly` ends: hundreds of searches rank
# models whose errors differ by per cent
ROBUST_TOLERANCE = 1e-4
# part of the improvement that its quadratic model expects, from which that is believed
WELL_FORESEEN = 0.25
# damping of its first step, relative to the normal equations, and its range
FIRST_DAMPING = 1e-3
DAMPING_RANGE = (1e-9, 1e8)
EASIER = 1.0 / 3.0  # smallest factor of the damping after a successful step
BLOCKS = 5
# terms that lower the error by less than this fraction of the rates' size are dropped
WORTH = 1e-3
# Sixth differences cancel smooth motion (polynomials up to the fifth order) and leave white noise,
# which they amplify by the root of the sum of their squared weights.
DIFFERENCE_ORDER = 6
DIFFERENCE_GAIN = np.sqrt(924.0)
# median absolute deviation of a normal distribution with a standard deviation of 1
GAUSSIAN_MAD = 0.6745


def compute_unexplained(chi: Array, signal: Array) -> Array:
    """Returns the flat residual of a signal (n, D) on features (n, K), in units of its spread."""
    spread = signal.std(axis=0)
    scaled = (signal - signal.mean(axis=0)) / np.where(spread > 1e-9, spread, 1e9)
    norm = np.linalg.norm(chi, axis=0)
    chi = chi / np.where(norm > 0.0, norm, 1.0)
    beta = np.linalg.lstsq(
        np.concatenate([np.ones((len(chi), 1)), chi], axis=1), scaled, 1e-10
    )[0]
    return np.asarray(scaled - beta[0] - chi @ beta[1:]).ravel()


def minimise(
    residual: Callable[[Array], Array],
    start: Array,
    scale: Array,
    bounds: tuple[Array, Array],
) -> tuple[Array, Array, Array]:
    """Minimises a residual (n,) within bounds (P,); returns minimum, Jacobian (n, P), residual."""
    low, high = ((bound - start) / scale + 1.0 for bound in bounds)
    solution = scipy.optimize.least_squares(
        lambda z: residual(start + (z - 1.0) * scale),
        np.ones(len(start)),
        bounds=(low, high),
        diff_step=DIFFERENCE,
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        max_nfev=MAX_STEPS,
    )
    return (
        start + (solution.x - 1.0) * scale,
        solution.jac / scale,
        np.asarray(solution.fun),
    )


def minimise_robustly(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    start: Array,
    bounds: tuple[Array, Array],
    size: float,
    evaluations: int,
) -> Array:
    """Returns the parameters (P,) within bounds that minimise a residual (n,) by its soft L1 loss.

    Errors far above `size` count by their magnitude, not by their square. Each step is that of
    Levenberg and Marquardt, with the damping of Nielsen (1999), by the normal equations: a
    decomposition of the Jacobian (n, P) would take longer than to compute it. A step beyond a bound
    ends there. The residual is computed at most `evaluations` times. Raises ValueError if the
    residual of the start is not finite.
    """
    here = _Point(start, residual(start), size)
    if not np.isfinite(here.loss):
        raise ValueError("the residual of the start is not finite.")
    least, most = DAMPING_RANGE
    damping = FIRST_DAMPING
    left = evaluations - 1
    while left > 0 and damping < most:
        step = _DampedStep.at(here, jacobian(here.theta), bounds)
        if not step.gradient[step.free].any():
            break
        harder = 2.0
        improved = 0.0
        gain = 1.0
        while left > 0 and damping < most and not improved:
            theta = np.clip(here.theta + step.find(damping), *bounds)
            trial = _Point(theta, residual(theta), size)
            left -= 1
            if not trial.loss < here.loss:
                damping *= harder
                harder *= 2.0
                continue
            improved = (here.loss - trial.loss) / here.loss
            gain = step.rate(here, trial)
            damping *= max(EASIER, 1.0 - (2.0 * gain - 1.0) ** 3)
            damping = max(damping, least)
            here = trial
        if improved < ROBUST_TOLERANCE and gain > WELL_FORESEEN:
            break
    return here.theta


class _Point:
    """Parameters (P,), their residual (n,), and its loss."""

    def __init__(self, theta: Array, rest: Array, size: float) -> None:
        self.theta = theta
        self.rest = rest
        # The loss of an error e has the slope weight * e, and the curvature weight^3.
        self.weight = 1.0 / np.hypot(1.0, rest / size)
        self.loss = _sum_softly(rest, size)


@dataclass(frozen=True)
class _DampedStep:
    """Normal equations of a loss around a point, and the parameters that no bound holds."""

    gradient: Array  # (P,)
    normal: Array  # (P, P)
    free: NDArray[np.intp]

    @classmethod
    def at(
        cls, here: _Point, slopes: Array, bounds: tuple[Array, Array]
    ) -> "_DampedStep":
        """Returns the equations at a point with a Jacobian (n, P)."""
        low, high = bounds
        gradient = slopes.T @ (here.weight * here.rest)
        normal = (slopes * here.weight[:, None] ** 3).T @ slopes
        held = (here.theta <= low) & (gradient > 0.0)
        held |= (here.theta >= high) & (gradient < 0.0)
        free = np.flatnonzero(~held & (np.diag(normal) > 0.0))
        return cls(gradient, normal, free)

    def find(self, damping: float) -> Array:
        """Returns the step (P,)."""
        inner = self.normal[np.ix_(self.free, self.free)]
        damped = inner + damping * np.diag(np.diag(inner))
        step = np.zeros(len(self.gradient))
        step[self.free] = -np.linalg.solve(damped, self.gradient[self.free])
        return step

    def rate(self, here: _Point, trial: _Point) -> float:
        """Returns the share of the expected improvement that a trial made, up to 1."""
        step = trial.theta - here.theta
        expected = -float(self.gradient @ step + step @ self.normal @ step / 2.0)
        # a bound may end a step where the quadratic model is worse
        return min((here.loss - trial.loss) / expected, 1.0) if expected > 0.0 else 0.0


def _sum_softly(residual: Array, size: float) -> float:
    """Returns the soft L1 loss of a residual (n,): half its squares where it is below `size`."""
    return float(size**2 * (np.hypot(1.0, residual / size) - 1.0).sum())


def estimate_uncertainty(jacobian: Array, residual: Array) -> Array:
    """Returns standard uncertainties (P,) of least squares, widened for correlated residuals."""
    rest = residual - residual.mean()
    power = float((rest**2).sum())
    rho = float((rest[1:] * rest[:-1]).sum()) / power if power > 0.0 else 0.0
    rho = float(np.clip(rho, 0.0, 0.95))
    variance = (
        power / max(1, len(residual) - jacobian.shape[1]) * (1.0 + rho) / (1.0 - rho)
    )
    return _deviations(np.linalg.pinv(jacobian.T @ jacobian) * variance)


def _deviations(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def estimate_standard_errors(chi: Array, residual: Array) -> Array:
    """Returns standard errors (K,) for correlated residuals (T,) by time (Newey, West 1987)."""
    count, terms = chi.shape
    if terms == 0 or count <= terms:
        return np.full(terms, np.nan)
    scale = np.maximum(np.linalg.norm(chi, axis=0), np.finfo(np.float64).tiny)
    unit = chi / scale
    middle = estimate_long_run_covariance(unit, residual)
    inverse = np.linalg.pinv(unit.T @ unit, hermitian=True)
    return np.asarray(
        _deviations(inverse @ middle @ inverse * count / (count - terms)) / scale
    )


def estimate_long_run_covariance(chi: Array, residual: Array) -> Array:
    """Returns the covariance (K, K) of summed features (T, K) x autocorrelated residuals (T,)."""
    scores = chi * residual[:, None]
    middle = scores.T @ scores
    reach = find_correlation_reach(residual)
    for lag in range(1, reach + 1):
        cross = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    return np.asarray(middle)


def estimate_clustered_errors(
    jacobian: Array, residual: Array, cluster: NDArray[np.intp]
) -> Array:
    """Returns cluster-robust standard errors (P,) (Cameron, Miller 2015), even for few clusters."""
    return _deviations(estimate_clustered_covariance(jacobian, residual, cluster))


def estimate_clustered_covariance(
    jacobian: Array,
    residual: Array,
    cluster: NDArray[np.intp],
    prior: Array | None = None,
) -> Array:
    """Returns a cluster-robust covariance (P, P) of least squares; NaN for too few clusters.

    `prior` are the squared weights (P,) that pull each parameter towards its first value.
    """
    groups = np.unique(cluster)
    count, terms = jacobian.shape
    if len(groups) < 2 or count <= terms:
        return np.full((terms, terms), np.nan)
    scores = jacobian * residual[:, None]
    sums = np.stack([scores[cluster == g].sum(axis=0) for g in groups])
    normal = jacobian.T @ jacobian
    if prior is not None:
        normal = normal + np.diag(prior)
    inverse = np.linalg.pinv(normal, hermitian=True)
    few = len(groups) / (len(groups) - 1.0) * (count - 1.0) / (count - terms)
    if len(groups) > 3:  # variance of Student's t
        few *= (len(groups) - 1.0) / (len(groups) - 3.0)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse * few)


def find_correlation_reach(residual: Array) -> int:
    """Returns the largest lag [rows] at which residuals (T,) are treated as correlated."""
    count = len(residual)
    usual = int(4.0 * (count / 100.0) ** (2.0 / 9.0))
    rest = residual - residual.mean()
    power = float(rest @ rest)
    if power <= 0.0:
        return usual
    longest = max(usual, int(LONGEST * count))
    size = 1 << (2 * count - 1).bit_length()
    alike = (
        np.fft.irfft(np.abs(np.fft.rfft(rest, size)) ** 2, size)[1 : longest + 1]
        / power
    )
    unlike = np.flatnonzero(alike < UNLIKE)
    apart = int(unlike[0]) + 1 if len(unlike) else longest
    return min(max(usual, 2 * apart), longest, count - 1)


def compute_condition(chi: Array) -> float:
    """Returns the condition number of the standardised features (T, K); inf if singular."""
    if chi.shape[1] == 0:
        return 1.0
    spread = chi.std(axis=0)
    size = np.linalg.svd(chi / np.where(spread > 0.0, spread, 1.0), compute_uv=False)
    return float(size[0] / size[-1]) if size[-1] > 0.0 else float("inf")


def measure_white_noise(values: Array) -> Array:
    """Returns the standard deviation (D,) of white noise on otherwise smooth series (T, D)."""
    rest = np.diff(values, DIFFERENCE_ORDER, axis=0) / DIFFERENCE_GAIN
    if len(rest) < DIFFERENCE_ORDER:
        return np.zeros(values.shape[1])
    return np.asarray(np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD)


def measure_rate_errors(model: TaylorModel, samples: Samples) -> tuple[Array, Array]:
    """Returns RMSE (D,) and R2 (D,) of the rates of a model on samples."""
    residual = samples.dq - model.rates(samples.x)
    rmse = np.sqrt((residual**2).mean(axis=0))
    variance = samples.dq.var(axis=0)
    unexplained = (residual**2).mean(axis=0) / np.maximum(variance, 1e-18)
    return rmse, np.where(variance > 1e-18, 1.0 - unexplained, 1.0)


def select_significant(chi: Array, target: Array) -> NDArray[np.bool_]:
    """Selects features (K,) of a noisy target (T,) that exceed `CERTAIN` times their errors."""
    rest = target - chi @ np.linalg.lstsq(chi, target, rcond=None)[0]
    power = max(float(rest @ rest), np.finfo(np.float64).tiny)
    rho = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 0.98)
    variance = power / max(1, len(chi) - chi.shape[1]) * (1.0 + rho) / (1.0 - rho)
    gram = chi.T @ chi
    moment = chi.T @ target
    keep = np.ones(chi.shape[1], dtype=np.bool_)
    while keep.any():
        inverse = np.linalg.pinv(gram[np.ix_(keep, keep)], hermitian=True)
        beta = inverse @ moment[keep]
        error = np.sqrt(
            np.maximum(np.diag(inverse) * variance, np.finfo(np.float64).tiny)
        )
        ratio = np.abs(beta) / error
        if ratio.min() >= CERTAIN:
            break
        keep[np.flatnonzero(keep)[int(np.argmin(ratio))]] = False
    return keep


def fit_by_instruments(
    chi: Array, instruments: Array, target: Array
) -> tuple[Array, Array] | None:
    """Returns coefficients (K,) and errors by instruments (T, K); None if these are too weak."""
    # Two-stage least squares (Soederstroem, Stoica 1983).
    scale = np.linalg.norm(chi, axis=0)
    size = np.linalg.norm(instruments, axis=0)
    chi = chi / scale
    instruments = instruments / size
    bread = instruments.T @ chi
    if not np.linalg.cond(bread) < WEAK:
        return None
    inverse = np.linalg.inv(bread)
    beta = inverse @ (instruments.T @ target)
    middle = estimate_long_run_covariance(instruments, target - chi @ beta)
    return beta / scale, np.sqrt(np.diag(inverse @ middle @ inverse.T)) / scale


@dataclass(frozen=True)
class Curve:
    """Cross-validated error of one degree of freedom against its number of terms."""

    dof: str
    terms: tuple[str, ...]  # n terms in the order of Eq. 2, largest weight first
    # (n + 1,) RMSE of the first 0..n terms on blocks left out of their fit
    error: Array
    kept: int  # number of terms in the model

    @property
    def share(self) -> Array:
        """Error (n + 1,) as a fraction of the size of the rates."""
        return self.error / max(float(self.error[0]), np.finfo(np.float64).tiny)


def make_curve(dof: str, terms: tuple[str, ...], chi: Array, target: Array) -> Curve:
    """Returns the curve of features (T, n), largest weight first; `kept` is its knee."""
    squares = cross_validated(chi, target)
    error = np.sqrt(squares.mean(axis=0))
    sigma = (
        squares.std(axis=0, ddof=1)
        / np.sqrt(len(squares))
        / (2.0 * np.maximum(error, 1e-300))
    )
    return Curve(dof, terms, error, find_knee(error, sigma))


def find_knee(error: Array, sigma: Array) -> int:
    """Returns the fewest terms within one standard error of the minimum (Breiman's rule)."""
    least = int(np.argmin(error))
    limit = error[least] + max(float(sigma[least]), WORTH * float(error[0]))
    return int(np.flatnonzero(error <= limit)[0])


def cross_validated(chi: Array, target: Array) -> Array:
    """Returns mean squared errors (B, n + 1) of 0..n features on B blocks, fitted to the others."""
    rows = np.array_split(np.arange(len(target)), BLOCKS)
    both = np.concatenate([chi, target[:, None]], axis=1)
    triangles = [
        np.atleast_2d(scipy.linalg.qr(both[r], mode="r", check_finite=False)[0])
        for r in rows
    ]
    triangles = [t[: both.shape[1]] for t in triangles]
    result = np.empty((BLOCKS, chi.shape[1] + 1))
    for block, unseen in enumerate(triangles):
        others = np.concatenate([t for b, t in enumerate(triangles) if b != block])
        r = scipy.linalg.qr(others, mode="economic", check_finite=False)[1]
        for n in range(chi.shape[1] + 1):
            beta = (
                scipy.linalg.solve_triangular(_make_solvable(r[:n, :n]), r[:n, -1])
                if n
                else np.zeros(0)
            )
            rest = unseen[:, -1] - unseen[:, :n] @ beta
            result[block, n] = float(rest @ rest) / len(rows[block])
    return result


def _make_solvable(r: Array) -> Array:
    """Makes a triangle solvable by dropping features that the other blocks did not excite."""
    diagonal = np.abs(np.diag(r))
    singular = diagonal <= 1e-10 * max(float(diagonal.max()), 1e-300)
    if not singular.any():
        return r
    r = r.copy()
    r[np.diag_indices(len(r))] = np.where(singular, 1e300, np.diag(r))
    return r
