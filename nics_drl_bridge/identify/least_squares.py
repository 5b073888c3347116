"""Least squares of a calibration: unexplained parts of signals, and minimised residuals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

DIFFERENCE = 1e-4
TOLERANCE = 1e-7
MAX_STEPS = 40


def unexplained(chi: Array, signal: Array) -> Array:
    """Returns the residual of a signal (n, D) on features (n, K) by least squares, flattened.

    It is a share of each component's spread.
    """
    spread = signal.std(axis=0)
    scaled = (signal - signal.mean(axis=0)) / np.where(spread > 1e-9, spread, 1e9)
    norm = np.linalg.norm(chi, axis=0)
    chi = chi / np.where(norm > 0.0, norm, 1.0)
    beta = np.linalg.lstsq(np.concatenate([np.ones((len(chi), 1)), chi], axis=1), scaled, 1e-10)[0]
    return np.asarray(scaled - beta[0] - chi @ beta[1:]).ravel()


def minimise(
    residual: Callable[[Array], Array],
    start: Array,
    scale: Array,
    bounds: tuple[Array, Array] | None = None,
    jacobian: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array, Array]:
    """Minimises a residual by least squares, in steps of each parameter's scale.

    Args:
        residual: function of parameters (P,).
        start: (P,).
        scale: (P,) expected change of each parameter, whatever its value.
        bounds: least and greatest parameters (P,).
        jacobian: of the residual (n, P); by finite differences when None.

    Returns:
        Parameters (P,), and Jacobian (n, P) and residual (n,) there.
    """
    low, high = bounds or (np.full(len(start), -np.inf), np.full(len(start), np.inf))
    slope: Any = "2-point"
    if jacobian is not None:
        slope = lambda z: jacobian(start + (z - 1.0) * scale) * scale  # noqa: E731
    found = least_squares(
        lambda z: residual(start + (z - 1.0) * scale),
        np.ones(len(start)),
        jac=slope,
        bounds=((low - start) / scale + 1.0, (high - start) / scale + 1.0),
        diff_step=DIFFERENCE,
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        max_nfev=MAX_STEPS,
    )
    return start + (found.x - 1.0) * scale, found.jac / scale, np.asarray(found.fun)


def uncertainty(jacobian: Array, residual: Array) -> Array:
    """Returns the standard uncertainty (P,) of least squares.

    It is widened for autocorrelated residuals.
    """
    rest = residual - residual.mean()
    power = float((rest**2).sum())
    rho = float((rest[1:] * rest[:-1]).sum()) / power if power > 0.0 else 0.0
    rho = float(np.clip(rho, 0.0, 0.95))
    variance = power / max(1, len(residual) - jacobian.shape[1]) * (1.0 + rho) / (1.0 - rho)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
