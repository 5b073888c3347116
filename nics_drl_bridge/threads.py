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
    """Returns the thread pool of a process; a forked process needs its own."""
    return ThreadPoolExecutor(MOST_THREADS, thread_name_prefix=f"crew-{process}")


def run_parts(function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
    """Returns a function's result for each part, in order; threads run all but the first part.

    This is faster if the work releases the interpreter lock. An exception is raised after all
    parts have ended.
    """
    futures = [_pool(os.getpid()).submit(function, part) for part in parts[1:]]
    try:
        first = function(parts[0])
    finally:
        if futures:  # even an empty wait takes 8 us
            wait(futures)
    return [first, *(future.result() for future in futures)]


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Limits a function to one BLAS thread: ten times as fast for thousands of small problems."""
    limited: Callable[P, R] = threadpool_limits.wrap(limits=1, user_api="blas")(
        function
    )
    return limited
