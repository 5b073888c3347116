"""A middleware of a robot that stands still, and what tests ask of it."""

from __future__ import annotations

import numpy as np

SECOND = 1_000_000_000
PERIOD = SECOND // 10
STILL = (np.zeros(3), np.zeros(3))
RANGES = np.arange(72, dtype=np.float32)


def state(middleware, now=20 * SECOND):
    view = middleware.view(now)
    return [view.pose, view.twist, view.ranges, middleware.estimator.covariance]


def assert_same(one, other):
    assert all(
        np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True)
    )
