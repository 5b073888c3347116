"""How uncertain a pose by odometry is after a drive, given the noise of its twist."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.sim import dead_reckoning_kernels as kernels

Array = NDArray[np.float64]
LEAST_VARIANCE = 1e-9
"""Of odometry without noise: a covariance of zeros would mean that it is unknown."""


def variances(std: tuple[float, float]) -> Array:
    """(3,) of a measured twist, from its linear [m/s] and its angular deviation [rad/s]."""
    linear, angular = (max(one * one, LEAST_VARIANCE) for one in std)
    return np.array([linear, linear, angular])


def step_covariance(std: tuple[float, float], period: float) -> Array:
    """(3, 3) what one period [s] adds to the covariance of x, y [m] and heading [rad]."""
    return np.diag(np.maximum(variances(std) * period * period, LEAST_VARIANCE))


def propagate(covariance: Array, before: ArrayLike, after: ArrayLike, added: Array) -> Array:
    """Covariances (M, 3, 3) of poses by odometry after one more period.

    An error of the heading turns the way that follows: P' = F P F^T + Q, with F the derivative of
    the new pose with respect to the old one (Thrun et al., Probabilistic Robotics, Sec. 5.4).

    Args:
        covariance: (M, 3, 3) before.
        before: (M, 3) poses by odometry before.
        after: (M, 3) and after.
        added: (3, 3) of one period, see `step_covariance`.
    """
    after_that = np.array(covariance, np.float64)
    poses = (np.ascontiguousarray(pose, np.float64) for pose in (before, after))
    kernels.propagate(after_that, *poses, added)
    return after_that
