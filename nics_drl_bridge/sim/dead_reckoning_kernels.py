"""The kernel of `dead_reckoning`: covariances (M, 3, 3) of odometry after one more step."""

from __future__ import annotations

from nics_drl_bridge.kernels import kernel


@kernel
def propagate(covariance, before, after, added):  # type: ignore[no-untyped-def]
    """P = F P F^T + Q for each robot, in place; see `dead_reckoning.propagate`."""
    for m in range(len(covariance)):
        p = covariance[m]
        u, v = before[m, 1] - after[m, 1], after[m, 0] - before[m, 0]
        # F differs from 1 only in its last column, (u, v, 1).
        for j in range(3):
            p[0, j] += u * p[2, j]
            p[1, j] += v * p[2, j]
        for i in range(3):
            p[i, 0] += u * p[i, 2]
            p[i, 1] += v * p[i, 2]
        for i in range(3):
            for j in range(3):
                p[i, j] += added[i, j]
