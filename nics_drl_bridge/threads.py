"""Threads: a pool for the parts of one job, and a single BLAS thread for small problems."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class Crew:
    """A pool of threads that wait for work; the calling thread is one of them.

    It helps only if the work is in compiled functions that release the interpreter lock (`nogil`).
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def run(self, function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
        """Returns a function's result for each part, in order; the caller runs the first part.

        An exception in a part is raised after all parts have ended.
        """
        if self.threads == 1 or len(parts) == 1:
            return [function(part) for part in parts]
        others = [self._started().submit(function, part) for part in parts[1:]]
        try:
            first = function(parts[0])
        finally:
            for other in others:
                other.exception()
        return [first, *(other.result() for other in others)]

    def _started(self) -> ThreadPoolExecutor:
        """The other threads, started with the first job and again in a forked process."""
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="crew")
            self._process = os.getpid()
        return self._pool

    def __getstate__(self) -> dict[str, int]:
        """Keeps only the number of threads: a copy starts its own."""
        return {"threads": self.threads}

    def __setstate__(self, state: dict[str, int]) -> None:
        self.__init__(state["threads"])  # type: ignore[misc]


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Limits a function to one BLAS thread, and restores their number afterwards.

    A fit solves thousands of small least-squares problems. Several threads would synchronise at
    each of them, which takes ten times as long on a busy machine.
    """
    limited: Callable[P, R] = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited
