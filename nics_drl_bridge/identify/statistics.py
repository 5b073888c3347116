"""Statistics of a fit: standard errors, conditioning, errors per degree of freedom.

Accuracy against the number of terms: the benefit of each further term of Eq. 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.taylor import TaylorModel

Array = NDArray[np.float64]

UNLIKE = 0.05
"""Correlation below which residuals are assumed to be independent."""
LONGEST = 0.1
"""Longest correlation of residuals, as a share of the rows."""


def standard_errors(chi: Array, residual: Array) -> Array:
    """Returns standard errors (K,) of least squares for unequal and correlated residuals.

    Newey, West: A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix, Econometrica 1987.

    Args:
        chi: (T, K) features.
        residual: (T,) residual of the fit, in order of time.
    """
    count, terms = chi.shape
    if terms == 0 or count <= terms:
        return np.full(terms, np.nan)
    scale = np.maximum(np.linalg.norm(chi, axis=0), np.finfo(np.float64).tiny)
    unit = chi / scale
    middle = long_run(unit, residual)
    inverse = np.linalg.pinv(unit.T @ unit, hermitian=True)
    covariance = inverse @ middle @ inverse * count / (count - terms)
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)) / scale)


def long_run(chi: Array, residual: Array) -> Array:
    """Returns the covariance (K, K) of summed features (T, K) x autocorrelated residuals (T,)."""
    scores = chi * residual[:, None]
    middle = scores.T @ scores
    reach = correlation_reach(residual)
    for lag in range(1, reach + 1):
        cross = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    return np.asarray(middle)


def clustered_errors(jacobian: Array, residual: Array, cluster: NDArray[np.intp]) -> Array:
    """Returns standard errors (P,) of least squares with residuals correlated within clusters (n,).

    Cameron, Miller: A practitioner's guide to cluster-robust inference, 2015, with their
    correction for few clusters.
    """
    groups = np.unique(cluster)
    count, terms = jacobian.shape
    if len(groups) < 2 or count <= terms:
        return np.full(terms, np.nan)
    scores = jacobian * residual[:, None]
    sums = np.stack([scores[cluster == g].sum(axis=0) for g in groups])
    inverse = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    few = len(groups) / (len(groups) - 1.0) * (count - 1.0) / (count - terms)
    if len(groups) > 3:  # the variance of Student's t
        few *= (len(groups) - 1.0) / (len(groups) - 3.0)
    covariance = inverse @ (sums.T @ sums) @ inverse * few
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def correlation_reach(residual: Array) -> int:
    """Returns the largest lag [rows] at which residuals (T,) are treated as correlated."""
    count = len(residual)
    usual = int(4.0 * (count / 100.0) ** (2.0 / 9.0))
    rest = residual - residual.mean()
    power = float(rest @ rest)
    if power <= 0.0:
        return usual
    longest = max(usual, int(LONGEST * count))
    size = 1 << (2 * count - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(rest, size)) ** 2
    alike = np.fft.irfft(spectrum, size)[1 : longest + 1] / power
    unlike = np.flatnonzero(alike < UNLIKE)
    apart = int(unlike[0]) + 1 if len(unlike) else longest
    return min(max(usual, 2 * apart), longest, count - 1)


def condition(chi: Array) -> float:
    """Returns the condition number of the standardised features (T, K); inf if singular."""
    if chi.shape[1] == 0:
        return 1.0
    spread = chi.std(axis=0)
    size = np.linalg.svd(chi / np.where(spread > 0.0, spread, 1.0), compute_uv=False)
    return float(size[0] / size[-1]) if size[-1] > 0.0 else float("inf")


def errors_of(model: TaylorModel, samples: Samples) -> tuple[Array, Array]:
    """Returns RMSE (D,) and R2 (D,) of the rates of a model on samples."""
    residual = samples.dq - model.rates(samples.x)
    rmse = np.sqrt((residual**2).mean(axis=0))
    variance = samples.dq.var(axis=0)
    unexplained = (residual**2).mean(axis=0) / np.maximum(variance, 1e-18)
    r2 = np.where(variance > 1e-18, 1.0 - unexplained, 1.0)
    return rmse, r2


BLOCKS = 5
WORTH = 1e-3
"""Terms that lower the error by less than this share of the rates' size are not kept."""


@dataclass(frozen=True)
class Curve:
    """Cross-validated error of one degree of freedom against its number of terms.

    Attributes:
        dof: name.
        terms: (n,) terms in the order of Eq. 2, the largest weight first.
        alpha: (n + 1,) share of the summed weights that the first 0..n terms reach.
        error: (n + 1,) RMSE of the first 0..n terms on blocks held out of their fit, in the unit
            of the rate.
        sigma: (n + 1,) standard error of `error` over the blocks.
        kept: number of terms in the model.
    """

    dof: str
    terms: tuple[str, ...]
    alpha: Array
    error: Array
    sigma: Array
    kept: int

    @property
    def share(self) -> Array:
        """Error (n + 1,) as a share of the size of the rates."""
        return self.error / max(float(self.error[0]), np.finfo(np.float64).tiny)


def curve(dof: str, terms: tuple[str, ...], chi: Array, target: Array, beta: Array) -> Curve:
    """Returns the curve of one degree of freedom; `kept` is its knee.

    Args:
        dof: name.
        terms: (n,) names.
        chi: (T, n) standardised features, the largest weight first.
        target: (T,) rates.
        beta: (n,) standardised coefficients.
    """
    squares = cross_validated(chi, target)
    error = np.sqrt(squares.mean(axis=0))
    sigma = squares.std(axis=0, ddof=1) / np.sqrt(len(squares)) / (2.0 * np.maximum(error, 1e-300))
    weight = np.append(0.0, np.cumsum(np.abs(beta)))
    return Curve(dof, terms, weight / max(weight[-1], 1e-300), error, sigma, knee(error, sigma))


def knee(error: Array, sigma: Array) -> int:
    """Returns the fewest terms whose error is not significantly, or hardly, above the least.

    Breiman's one-standard-error rule; Hastie, Tibshirani, Friedman: The Elements of Statistical
    Learning, ch. 7.10.
    """
    least = int(np.argmin(error))
    limit = error[least] + max(float(sigma[least]), WORTH * float(error[0]))
    return int(np.flatnonzero(error <= limit)[0])


def cross_validated(chi: Array, target: Array) -> Array:
    """Returns mean squared errors (B, n + 1) of the first 0..n features on B blocks in time.

    Each block is predicted by a fit to the others. The blocks are first compressed to triangles
    (QR), so that all numbers of terms share one factorisation.
    """
    rows = np.array_split(np.arange(len(target)), BLOCKS)
    both = np.concatenate([chi, target[:, None]], axis=1)
    triangles = [np.atleast_2d(qr(both[r], mode="r", check_finite=False)[0]) for r in rows]
    triangles = [t[: both.shape[1]] for t in triangles]
    result = np.empty((BLOCKS, chi.shape[1] + 1))
    for block, unseen in enumerate(triangles):
        others = np.concatenate([t for b, t in enumerate(triangles) if b != block])
        r = qr(others, mode="economic", check_finite=False)[1]
        for n in range(chi.shape[1] + 1):
            beta = solve_triangular(_safe(r[:n, :n]), r[:n, -1]) if n else np.zeros(0)
            rest = unseen[:, -1] - unseen[:, :n] @ beta
            result[block, n] = float(rest @ rest) / len(rows[block])
    return result


def _safe(r: Array) -> Array:
    """Makes a triangle solvable: features that the other blocks did not excite are dropped."""
    diagonal = np.abs(np.diag(r))
    singular = diagonal <= 1e-10 * max(float(diagonal.max()), 1e-300)
    if not singular.any():
        return r
    r = r.copy()
    r[np.diag_indices(len(r))] = np.where(singular, 1e300, np.diag(r))
    return r
