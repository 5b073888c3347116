"""The fit of one degree of freedom: least squares, Eq. 2, least squares anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kinematics.accuracy import Curve, curve
from nics_drl_bridge.kinematics.prune import by_weight, prune, significant
from nics_drl_bridge.kinematics.robust import inliers
from nics_drl_bridge.kinematics.statistics import condition, standard_errors

Array = NDArray[np.float64]
Alpha = float | Literal["auto"]

ROUNDING = 1e-9
"""Standardised coefficients below this share of the rates are rounding errors."""


def parse_alpha(text: str) -> Alpha:
    """The pruning threshold of Eq. 2 as a user writes it: a number, or `auto`.

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
class DofFit:
    """A degree of freedom of dQ/dt.

    Attributes:
        coefficients: (K,) zero where a term is not kept.
        errors: (K,) their standard errors.
        curve: accuracy against the number of terms.
        inliers: (T,) the rows that the fit used.
        condition: condition number of the standardised features that are kept.
    """

    coefficients: Array
    errors: Array
    curve: Curve
    inliers: NDArray[np.bool_]
    condition: float

    def spread_over(self, allowed: NDArray[np.bool_]) -> DofFit:
        """The same among more features (K',), of which only those `allowed` were used."""
        coefficients, errors = np.zeros(len(allowed)), np.zeros(len(allowed))
        coefficients[allowed], errors[allowed] = self.coefficients, self.errors
        return replace(self, coefficients=coefficients, errors=errors)


def fit_dof(
    name: str,
    terms: tuple[str, ...],
    chi: Array,
    target: Array,
    usual: float,
    alpha: Alpha,
    noisy: bool = False,
) -> DofFit:
    """Fits and prunes one degree of freedom.

    Args:
        name: of the degree of freedom.
        terms: (K,) names of the features.
        chi: (T, K) features.
        target: (T,) rates.
        usual: width of their usual range, for outliers.
        alpha: see `fit.fit`.
        noisy: see `fit.fit`.
    """
    used = inliers(chi / _scale(chi), target, usual)
    if not used.all():
        chi, target = chi[used], target[used]
    scale = _scale(chi)
    unit = chi / scale
    candidates = significant(unit, target) if noisy else np.ones(len(scale), dtype=np.bool_)
    beta = np.zeros(len(scale))
    if candidates.any():
        beta[candidates] = np.linalg.lstsq(unit[:, candidates], target, rcond=None)[0]
    floor = ROUNDING * max(float(np.abs(target).max()), ROUNDING)
    order = by_weight(beta, floor)
    found = curve(name, tuple(terms[k] for k in order), unit[:, order], target, beta[order])
    keep = np.zeros(len(beta), dtype=np.bool_)
    if alpha == "auto":
        keep[order[: found.kept]] = True
    else:
        keep = prune(beta, alpha, floor)
    coefficients, errors = np.zeros(len(beta)), np.zeros(len(beta))
    if keep.any():
        standardised = np.linalg.lstsq(unit[:, keep], target, rcond=None)[0]
        coefficients[keep] = standardised / scale[keep]
        rest = target - unit[:, keep] @ standardised
        errors[keep] = standard_errors(unit[:, keep], rest) / scale[keep]
    found = replace(found, kept=int(keep.sum()))
    return DofFit(coefficients, errors, found, used, condition(chi[:, keep]))


def _scale(chi: Array) -> Array:
    """The spread (K,) of each feature; 1 for the constant."""
    spread = chi.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)
