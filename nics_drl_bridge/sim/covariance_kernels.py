"""Compiled propagation of the covariances of poses by odometry."""

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel


@kernel
def propagate(covariances: Array, before: Array, after: Array, added: Array) -> None:
    """Propagate covariances in place, see `device.propagate`: P' = F P F^T + Q.

    Args:
        covariances: (M, 3, 3) P of x, y [m] and heading [rad].
        before: (M, 3) poses by odometry.
        after: (M, 3) poses by odometry one period later.
        added: (3, 3) Q.
    """
    for m in range(covariances.shape[0]):
        p = covariances[m]
        # F differs from the identity only in its last column.
        last_column = before[m, 1] - after[m, 1], after[m, 0] - before[m, 0]
        for i in range(2):
            for j in range(3):
                p[i, j] += last_column[i] * p[2, j]
        for j in range(2):
            for i in range(3):
                p[i, j] += last_column[j] * p[i, 2]
        for i in range(3):
            for j in range(3):
                p[i, j] += added[i, j]
