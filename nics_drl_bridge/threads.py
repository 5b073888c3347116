"""One thread for linear algebra on small matrices."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function compute with one thread of BLAS, and restores their number afterwards.

    A fit solves thousands of small least squares. Several threads would wait for each other at
    each of them, which on a busy machine takes ten times as long.
    """
    limited: Callable[P, R] = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited
