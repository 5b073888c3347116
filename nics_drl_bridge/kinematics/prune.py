"""Pruning: the terms that Eq. 2 keeps, and those that noise could have made."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CERTAIN = 3.0
"""A term of a noisy fit must be this many times its standard error."""


def by_weight(beta: Array, noise_floor: float = 0.0) -> NDArray[np.intp]:
    """Indices of standardised coefficients (K,), the largest first, without rounding errors."""
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    order = np.argsort(-size, kind="stable")
    return np.asarray(order[size[order] > 0.0])


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Which of the standardised coefficients (K,) to keep (Eq. 2).

    Sorted by size, those are kept whose sum stays below `alpha` of the whole, and the one
    that crosses it. Coefficients below `noise_floor` are rounding errors and never count.
    """
    order = by_weight(beta, noise_floor)
    size = np.abs(beta[order])
    keep = np.zeros(len(beta), dtype=np.bool_)
    keep[order] = np.cumsum(size) - size < alpha * size.sum()
    return keep


def significant(chi: Array, target: Array) -> NDArray[np.bool_]:
    """Which features (K,) of a noisy target (T,) can be told from noise.

    The least certain goes first, until each of those left is `CERTAIN` times its standard
    error; the error is widened for residuals that resemble their neighbours.
    """
    rest = target - chi @ np.linalg.lstsq(chi, target, rcond=None)[0]
    power = max(float(rest @ rest), np.finfo(np.float64).tiny)
    rho = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 0.98)
    variance = power / max(1, len(chi) - chi.shape[1]) * (1.0 + rho) / (1.0 - rho)
    gram, moment = chi.T @ chi, chi.T @ target
    keep = np.ones(chi.shape[1], dtype=np.bool_)
    while keep.any():
        inverse = np.linalg.pinv(gram[np.ix_(keep, keep)], hermitian=True)
        beta = inverse @ moment[keep]
        error = np.sqrt(np.maximum(np.diag(inverse) * variance, np.finfo(np.float64).tiny))
        ratio = np.abs(beta) / error
        if ratio.min() >= CERTAIN:
            break
        keep[np.flatnonzero(keep)[int(np.argmin(ratio))]] = False
    return keep
