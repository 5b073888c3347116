"""Fit of one degree of freedom: least squares, Eq. 2, least squares again.

Pruning: the terms that Eq. 2 keeps, and those that are significant in noise.

Instrumental variables: a fit to measured states that are themselves noisy.

The noise of a state is both in X and in its rate, so that least squares would mistake it for a
fast decay. The noise of the state one step earlier is independent of the noise in dQ, so that
state serves as an instrument for X. Soederstroem, Stoica: Instrumental variable methods for
system identification, 1983; two-stage least squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.identify.excitation import inliers, white_noise
from nics_drl_bridge.identify.statistics import Curve, condition, curve, long_run, standard_errors
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Alpha = float | Literal["auto"]

ROUNDING = 1e-9
"""Standardised coefficients below this share of the rates are rounding errors."""


def parse_alpha(text: str) -> Alpha:
    """Parses a pruning threshold of Eq. 2: a number from 0 to 1, or `auto`.

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
    """Fit of one degree of freedom of dQ/dt.

    Attributes:
        coefficients: (K,) zero where a term is not kept.
        errors: (K,) their standard errors.
        curve: accuracy against the number of terms.
        inliers: (T,) mask of the rows that the fit used.
        condition: condition number of the standardised kept features.
    """

    coefficients: Array
    errors: Array
    curve: Curve
    inliers: NDArray[np.bool_]
    condition: float

    def spread_over(self, allowed: NDArray[np.bool_]) -> DofFit:
        """Expands the fit to all features (K',), of which it used only those `allowed`."""
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
        usual: width of the usual range of the rates, for outliers.
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
    """Returns the spread (K,) of each feature; 1 for the constant."""
    spread = chi.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


CERTAIN = 3.0
"""A term of a noisy fit must be this many times its standard error."""


def by_weight(beta: Array, noise_floor: float = 0.0) -> NDArray[np.intp]:
    """Returns indices of standardised coefficients (K,), largest first, without rounding errors."""
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    order = np.argsort(-size, kind="stable")
    return np.asarray(order[size[order] > 0.0])


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Selects the standardised coefficients (K,) to keep (Eq. 2).

    In order of size, coefficients are kept while their sum stays below the share `alpha` of the
    total, and also the one that crosses it. Those up to `noise_floor` are rounding errors and
    never count.
    """
    order = by_weight(beta, noise_floor)
    size = np.abs(beta[order])
    keep = np.zeros(len(beta), dtype=np.bool_)
    keep[order] = np.cumsum(size) - size < alpha * size.sum()
    return keep


def significant(chi: Array, target: Array) -> NDArray[np.bool_]:
    """Selects the significant features (K,) of a noisy target (T,).

    The least certain feature is removed until each coefficient is at least `CERTAIN` times its
    standard error, which is widened for autocorrelated residuals.
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


NOISY = 5e-4
"""A measured state is noisy if its noise exceeds this share of its range."""
SAME_STEP, ROUNDING_S = 1e-3, 1e-6
WEAK = 1e4
"""Instruments are too weak if the condition number of their products with the features is
larger."""


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """True if the noise of a measured state would bias a fit."""
    if not spec.state:
        return False
    size = len(spec.state)
    width = np.array([v.max - v.min for v in spec.state])
    return bool((white_noise(samples.x[:, :size]) > NOISY * width).any())


def reestimated(
    part: DofFit, dof: int, samples: Samples, powers: NDArray[np.int64], states: int
) -> DofFit:
    """Estimates the kept coefficients of a state's rate again, by instrumental variables.

    Args:
        part: the fit by least squares; its terms stay.
        dof: its index in dQ.
        samples: (T,) rows of that fit.
        powers: (K, V) of the features.
        states: S, number of measured variables in X.

    Returns:
        The fit with the new values; unchanged if the instruments are too weak.
    """
    kept = np.flatnonzero(part.coefficients)
    follows = np.abs(np.diff(samples.t) - samples.dt) < SAME_STEP * samples.dt + ROUNDING_S
    now = np.flatnonzero(follows & part.inliers[1:] & part.inliers[:-1]) + 1
    if len(kept) == 0 or len(now) <= len(kept):
        return part
    earlier = samples.x[now].copy()
    earlier[:, :states] = samples.x[now - 1, :states]
    chi, told = (taylor.evaluate(x, powers[kept]) for x in (samples.x[now], earlier))
    scale, size = np.linalg.norm(chi, axis=0), np.linalg.norm(told, axis=0)
    bread = (told / size).T @ (chi / scale)
    if not np.linalg.cond(bread) < WEAK:
        return part
    target = samples.dq[now, dof]
    inverse = np.linalg.inv(bread)
    beta = inverse @ ((told / size).T @ target)
    middle = long_run(told / size, target - chi / scale @ beta)
    spread = np.sqrt(np.diag(inverse @ middle @ inverse.T))
    coefficients, errors = part.coefficients.copy(), part.errors.copy()
    coefficients[kept], errors[kept] = beta / scale, spread / scale
    return replace(part, coefficients=coefficients, errors=errors)
