"""Robust regression: which rows of a fit are outliers, as a jump of the pose makes them.

Least trimmed squares in concentration steps finds the bulk of the rows (Rousseeuw, Van
Driessen: Computing LTS regression for large data sets), what lies far from it is left out, and
the rest is fitted by ordinary least squares: reweighted least squares with weights of 0 and 1.
A recording without outliers is so fitted as if this did not exist.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BULK = 0.75
"""Share of the rows that the start is fitted to."""
CONCENTRATIONS = 12
FAR = 8.0
"""An outlier is this many standard deviations of the bulk away,"""
LARGE = 1.0
"""and by more than this share of the rates' usual range: no misfit of the model is that."""
LEAST = 1e-6
"""Rates below this, in SI units, are rounding errors and never outliers."""
USUAL = (5.0, 95.0)
"""Percentiles that bound the usual range; jumps in 5 % of the rows lie outside."""
MOST = 0.2
"""More rows than this are no outliers: the model does not fit."""
BEYOND = 0.5
"""A variable this share of its range beyond its limits was not measured but made up."""
GAUSSIAN_MAD = 0.6745
BULK_PERCENTILE, GAUSSIAN_BULK = 90.0, 1.645
"""Once there are outliers, the misfit of the rest is judged by its tail, not by its middle."""


def inliers(chi: Array, target: Array, usual: float) -> NDArray[np.bool_]:
    """Which rows (T,) of a regression of a target (T,) on features (T, K) are no outliers.

    Args:
        chi: (T, K).
        target: (T,).
        usual: width of the usual range of such rates, see `usual_ranges`.
    """
    everything = np.ones(len(target), dtype=np.bool_)
    least = LARGE * usual
    plain = np.abs(target - chi @ _solve(chi, target))
    if not (plain > max(FAR / 2.0 * _sigma(plain), least)).any():
        return everything
    count = max(int(BULK * len(target)), min(len(target), chi.shape[1] + 1))
    bulk = np.argsort(np.abs(target - np.median(target)), kind="stable")[:count]
    for start in (np.argsort(plain, kind="stable")[:count], bulk):
        rest = _concentrated(chi, target, start)
        inside = rest <= FAR * float(np.percentile(rest, BULK_PERCENTILE)) / GAUSSIAN_BULK
        if inside.mean() >= 1.0 - MOST:
            return np.asarray(inside)
    return everything


def plausible(x: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Which rows (T,) of X (T, V) lie not far outside the variables' limits (V,)."""
    margin = BEYOND * (high - low)
    inside = ((x >= low - margin) & (x <= high + margin)).all(axis=1)
    everything = np.ones(len(x), dtype=np.bool_)
    return np.asarray(inside) if inside.mean() >= 1.0 - MOST else everything


def _concentrated(chi: Array, target: Array, chosen: NDArray[np.intp]) -> Array:
    """Residuals (T,) of the fit to the rows that it fits best."""
    rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    for _ in range(CONCENTRATIONS):
        again = np.argsort(rest, kind="stable")[: len(chosen)]
        if np.array_equal(np.sort(again), np.sort(chosen)):
            break
        chosen = again
        rest = np.abs(target - chi @ _solve(chi[chosen], target[chosen]))
    return rest


def usual_ranges(dq: Array) -> Array:
    """Width (D,) of the range in which rates (T, D) usually are; x and y share the wider."""
    low, high = np.percentile(dq, USUAL, axis=0)
    width = np.maximum(high - low, LEAST)
    width[:2] = width[:2].max()
    return np.asarray(width)


def _solve(chi: Array, target: Array) -> Array:
    return np.asarray(np.linalg.lstsq(chi, target, rcond=None)[0])


def _sigma(rest: Array) -> float:
    return float(np.median(rest)) / GAUSSIAN_MAD
