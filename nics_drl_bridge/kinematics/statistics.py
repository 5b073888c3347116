"""Statistics of a fit: standard errors, conditioning, errors per degree of freedom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Samples

Array = NDArray[np.float64]

UNLIKE = 0.05
"""Correlation below which residuals are taken as independent."""
LONGEST = 0.1
"""Share of the rows that residuals may stay alike for."""


def standard_errors(chi: Array, residual: Array) -> Array:
    """Standard errors (K,) of least squares, valid for unequal and correlated residuals.

    Newey, West: A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix, Econometrica 1987.

    Args:
        chi: (T, K) features.
        residual: (T,) what they leave over, in order of time.
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
    """Covariance (K, K) of the sum of features (T, K) times residuals (T,), alike for a while."""
    scores = chi * residual[:, None]
    middle = scores.T @ scores
    reach = correlation_reach(residual)
    for lag in range(1, reach + 1):
        cross = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    return np.asarray(middle)


def clustered_errors(jacobian: Array, residual: Array, cluster: NDArray[np.intp]) -> Array:
    """Standard errors (P,) of least squares whose residuals (n,) are alike within clusters (n,).

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
    """How many rows apart residuals (T,) still resemble each other, or more."""
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
    """Condition number of the standardised features (T, K); 1 is best, inf is singular."""
    if chi.shape[1] == 0:
        return 1.0
    spread = chi.std(axis=0)
    size = np.linalg.svd(chi / np.where(spread > 0.0, spread, 1.0), compute_uv=False)
    return float(size[0] / size[-1]) if size[-1] > 0.0 else float("inf")


def errors_of(model: TaylorModel, samples: Samples) -> tuple[Array, Array]:
    """RMSE (D,) and R2 (D,) of the rates of a model on samples."""
    residual = samples.dq - model.rates(samples.x)
    rmse = np.sqrt((residual**2).mean(axis=0))
    variance = samples.dq.var(axis=0)
    unexplained = (residual**2).mean(axis=0) / np.maximum(variance, 1e-18)
    r2 = np.where(variance > 1e-18, 1.0 - unexplained, 1.0)
    return rmse, r2
