"""The fit of one degree of freedom: least squares, Eq. 2, least squares anew.

Pruning: the terms that Eq. 2 keeps, and those that noise could have made.

Instrumental variables: a fit to measured states that are themselves noisy.

The noise of a state stands both in X and in its rate, so that least squares would take it for
a fast decay. The state one step earlier has noise of its own: what it tells of X is free of the
noise in dQ. Soederstroem, Stoica: Instrumental variable methods for system identification,
1983; two-stage least squares.
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


NOISY = 5e-4
"""A measured state is noisy from this share of its range on."""
SAME_STEP, ROUNDING_S = 1e-3, 1e-6
WEAK = 1e4
"""Instruments whose products with the features are conditioned worse tell too little."""


def states_are_noisy(samples: Samples, spec: RobotSpec) -> bool:
    """Whether the noise of a measured state would bend a fit."""
    if not spec.state:
        return False
    size = len(spec.state)
    width = np.array([v.max - v.min for v in spec.state])
    return bool((white_noise(samples.x[:, :size]) > NOISY * width).any())


def reestimated(
    part: DofFit, dof: int, samples: Samples, powers: NDArray[np.int64], states: int
) -> DofFit:
    """A rate of the state with its kept coefficients estimated by instruments.

    Args:
        part: the fit by least squares; its terms stay.
        dof: its place in dQ.
        samples: (T,) rows that it was made of.
        powers: (K, V) of the features.
        states: S, how many of X are measured.

    Returns:
        The same with other values; unchanged where the instruments tell too little.
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
