"""Fit by least squares, then prune the terms that hardly matter (Sec. IV-A, Eq. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from nics_drl_bridge.errors import FitError
from nics_drl_bridge.kinematics import features
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.kinematics.recording import Samples
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

ALPHA = 0.99
ORDER = 2
MIN_SAMPLES_PER_TERM = 5
NEGLIGIBLE = 1e-3
"""A direction in which the robot moves by less than this share of the other is left at zero."""
STILL = 1e-3
"""A variable whose spread is below this share of its range did not move."""
CERTAIN = 3.0
"""A term of a noisy fit must be this many times its standard error."""
DEPENDENT = 1e-7
"""A standardised feature whose part orthogonal to the others is below this is a copy."""


@dataclass(frozen=True)
class Fit:
    """A fitted model and how well it fits.

    Attributes:
        model: the pruned model.
        rmse: (D,) root mean square of dQ/dt that the model leaves over, in the dof's unit.
        r2: (D,) share of the variance explained; 1 where the dof does not move.
        terms_total: D x K before pruning.
        unmoved: variables that the drive never moved, so that no term has them.
        dependent: terms that are copies of others on this drive.
    """

    model: TaylorModel
    rmse: Array
    r2: Array
    terms_total: int
    unmoved: tuple[str, ...]
    dependent: tuple[str, ...]


def unmoved_variables(samples: Samples, spec: RobotSpec) -> tuple[str, ...]:
    """Names of the variables of X that stayed where they were for the whole drive."""
    limits = np.array([v.max - v.min for v in (*spec.state, *spec.command)])
    spread = samples.x.std(axis=0)
    return tuple(
        name
        for name, s, limit in zip(spec.variable_names, spread, limits, strict=True)
        if s < STILL * limit
    )


def fit(
    samples: Samples,
    spec: RobotSpec,
    order: int = ORDER,
    alpha: float = ALPHA,
    noisy: bool = False,
) -> Fit:
    """Fits and prunes a Taylor model.

    Args:
        samples: (t, Q, X, dQ) on one time axis.
        spec: gives names and units.
        order: of the expansion; the paper's is 2.
        alpha: the share of the summed standardised coefficients that the kept terms reach
            (Eq. 2). The term that crosses the threshold is kept too: to the letter of Eq. 2 a
            differential robot, whose wheels weigh the same, would lose one of them.
        noisy: for any recording but an exact one. Terms that can't be told from noise are
            dropped before Eq. 2 counts the rest. The body twist is then taken to be a function
            of the state alone, if there is a state, and to be zero at zero speed, if the speed
            moved: within a step a command acts through the state, and noise can't tell the two.

    Returns:
        The model with its errors.

    Raises:
        FitError: too few samples, or nothing moved.
    """
    unmoved = unmoved_variables(samples, spec)
    names = spec.variable_names
    powers = features.exponents(len(names), order)
    still = [names.index(name) for name in unmoved]
    moved = powers[(powers[:, still] == 0).all(axis=1)]
    if len(samples.t) < MIN_SAMPLES_PER_TERM * len(moved):
        raise FitError(
            f"{len(samples.t)} samples are too few for {len(moved)} terms; drive for longer, or "
            "lower the order."
        )
    if len(unmoved) == len(names):
        raise FitError("nothing moved in this drive; vary every command over its range.")
    chi = features.evaluate(samples.x, moved)
    independent, dependent = _independent_columns(chi)
    chi, kept_powers = chi[:, independent], moved[independent]
    coefficients = np.zeros((samples.dq.shape[1], len(kept_powers)))
    by_state = _through_state(kept_powers, spec, unmoved)
    for d in np.flatnonzero(_moves(samples.dq)):
        allowed = by_state if noisy and d < 3 else np.ones_like(by_state)
        coefficients[d, allowed] = fit_dof(chi[:, allowed], samples.dq[:, d], alpha, noisy)
    model = build_model(samples, spec, kept_powers, coefficients)
    rmse, r2 = errors_of(model, samples)
    names_dependent = tuple(features.term_name(row, names) for row in moved[dependent])
    return Fit(model, rmse, r2, samples.dq.shape[1] * len(powers), unmoved, names_dependent)


def fit_dof(chi: Array, target: Array, alpha: float, noisy: bool = False) -> Array:
    """Coefficients (K,) of one degree of freedom: least squares, Eq. 2, least squares anew.

    Args:
        chi: (T, K) features.
        target: (T,) rates.
        alpha: see `fit`.
        noisy: see `fit`.
    """
    scale = _scale(chi)
    beta: Array = np.asarray(np.linalg.lstsq(chi / scale, target, rcond=None)[0])
    if noisy:
        certain = significant(chi / scale, target)
        beta = np.zeros(len(scale))
        beta[certain] = np.linalg.lstsq(chi[:, certain] / scale[certain], target, rcond=None)[0]
    keep = prune(beta, alpha, noise_floor=1e-9 * max(float(np.abs(target).max()), 1e-9))
    result = np.zeros(chi.shape[1])
    if keep.any():
        standardised = np.linalg.lstsq(chi[:, keep] / scale[keep], target, rcond=None)[0]
        result[keep] = standardised / scale[keep]
    return result


def prune(beta: Array, alpha: float, noise_floor: float = 0.0) -> NDArray[np.bool_]:
    """Which of the standardised coefficients (K,) to keep (Eq. 2).

    Sorted by size, those are kept whose sum stays below `alpha` of the whole, and the one
    that crosses it. Coefficients below `noise_floor` are rounding errors and never count.
    """
    size = np.where(np.abs(beta) > noise_floor, np.abs(beta), 0.0)
    order = np.argsort(-size, kind="stable")
    before = np.cumsum(size[order]) - size[order]
    keep = np.zeros(len(beta), dtype=np.bool_)
    keep[order] = (before < alpha * size.sum()) & (size[order] > 0.0)
    return keep


def _through_state(
    powers: NDArray[np.int64], spec: RobotSpec, unmoved: tuple[str, ...]
) -> NDArray[np.bool_]:
    """Which terms (K,) the body twist of a noisy recording may have."""
    if not spec.state:
        return np.ones(len(powers), dtype=np.bool_)
    allowed = (powers[:, len(spec.state) :] == 0).all(axis=1)
    if any(v.unit == "m/s" and v.name not in unmoved for v in spec.state):
        allowed &= powers.sum(axis=1) > 0
    return np.asarray(allowed)


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


def build_model(
    samples: Samples, spec: RobotSpec, powers: NDArray[np.int64], coefficients: Array
) -> TaylorModel:
    """A TaylorModel of the terms that some degree of freedom keeps."""
    used = np.abs(coefficients).sum(axis=0) > 0.0
    return TaylorModel(
        variables=spec.variable_names,
        dofs=spec.dof_names,
        dof_units=spec.dof_units,
        powers=powers[used],
        coefficients=coefficients[:, used],
        dt=samples.dt,
        low=samples.x.min(axis=0),
        high=samples.x.max(axis=0),
    )


def errors_of(model: TaylorModel, samples: Samples) -> tuple[Array, Array]:
    """RMSE (D,) and R2 (D,) of the rates of a model on samples."""
    residual = samples.dq - model.rates(samples.x)
    rmse = np.sqrt((residual**2).mean(axis=0))
    variance = samples.dq.var(axis=0)
    unexplained = (residual**2).mean(axis=0) / np.maximum(variance, 1e-18)
    r2 = np.where(variance > 1e-18, 1.0 - unexplained, 1.0)
    return rmse, r2


def _moves(dq: Array) -> NDArray[np.bool_]:
    """Which degrees of freedom (D,) move at all, beside the fastest of their kind."""
    size = np.sqrt((dq**2).mean(axis=0))
    moves = np.ones(len(size), dtype=np.bool_)
    moves[:2] = size[:2] > NEGLIGIBLE * size[:2].max()
    return moves


def _scale(chi: Array) -> Array:
    """The spread (K,) of each feature; 1 for the constant."""
    spread = chi.std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def _independent_columns(chi: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Splits columns into an independent set and copies; low orders are kept first."""
    unit = chi / np.linalg.norm(chi, axis=0)
    independent: list[int] = []
    dependent: list[int] = []
    r = np.abs(np.diag(qr(unit, mode="r")[0]))  # without pivoting: each against those before it
    for k in range(chi.shape[1]):
        (independent if k < len(r) and r[k] > DEPENDENT else dependent).append(k)
    return np.array(independent, dtype=np.intp), np.array(dependent, dtype=np.intp)
