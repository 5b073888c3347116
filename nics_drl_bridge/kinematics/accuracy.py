"""Accuracy against the number of terms: what each further term of Eq. 2 is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

Array = NDArray[np.float64]

BLOCKS = 5
WORTH = 1e-3
"""Terms that lower the error by less than this share of the rates' size are not worth it."""


@dataclass(frozen=True)
class Curve:
    """Cross-validated error of one degree of freedom against its number of terms.

    Attributes:
        dof: name.
        terms: (n,) terms in the order of Eq. 2, the largest weight first.
        alpha: (n + 1,) share of the summed weights that the first 0..n terms reach.
        error: (n + 1,) RMSE of the first 0..n terms on blocks that their fit did not see, in
            the unit of the rate.
        sigma: (n + 1,) standard error of `error` over the blocks.
        kept: how many terms the model has.
    """

    dof: str
    terms: tuple[str, ...]
    alpha: Array
    error: Array
    sigma: Array
    kept: int

    @property
    def share(self) -> Array:
        """(n + 1,) error as a share of the size of the rates."""
        return self.error / max(float(self.error[0]), np.finfo(np.float64).tiny)


def curve(dof: str, terms: tuple[str, ...], chi: Array, target: Array, beta: Array) -> Curve:
    """The curve of one degree of freedom; `kept` is its knee.

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
    """The fewest terms whose error can't be told from the least, or is hardly above it.

    Breiman's rule of one standard error; Hastie, Tibshirani, Friedman: The Elements of
    Statistical Learning, ch. 7.10.
    """
    least = int(np.argmin(error))
    limit = error[least] + max(float(sigma[least]), WORTH * float(error[0]))
    return int(np.flatnonzero(error <= limit)[0])


def cross_validated(chi: Array, target: Array) -> Array:
    """Mean squared errors (B, n + 1) of the first 0..n features on each of B blocks in time.

    Each block is predicted by a fit to the others. The blocks are compressed to triangles
    first, so that all numbers of terms cost one factorisation.
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
    """A triangle that can be solved: a feature that the other blocks did not move is left out."""
    diagonal = np.abs(np.diag(r))
    singular = diagonal <= 1e-10 * max(float(diagonal.max()), 1e-300)
    if not singular.any():
        return r
    r = r.copy()
    r[np.diag_indices(len(r))] = np.where(singular, 1e300, np.diag(r))
    return r
