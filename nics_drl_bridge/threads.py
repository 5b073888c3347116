"""Threads: a pool for the parts of one job, and a single BLAS thread for small problems."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
MOST_THREADS = 1024


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The waiting threads of a process, started as they are needed: a fork has none."""
    return ThreadPoolExecutor(MOST_THREADS, thread_name_prefix=f"crew-{process}")


def run_parts(function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
    """Returns a function's result for each part, in order; threads run all but the first part.

    It helps if the work releases the interpreter lock. Exceptions are raised when all have ended.
    """
    others = [_pool(os.getpid()).submit(function, part) for part in parts[1:]]
    try:
        first = function(parts[0])
    finally:
        if others:  # waiting for none takes 8 us
            wait(others)
    return [first, *(other.result() for other in others)]


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Limits a function to one BLAS thread: for thousands of small problems, ten times as fast."""
    limited: Callable[P, R] = threadpool_limits.wrap(limits=1, user_api="blas")(
        function
    )
    return limited
