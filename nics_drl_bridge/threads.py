"""Threads: a crew that shares the parts of one job, and one thread for small linear algebra."""

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
    """Some threads that wait for work; the one that calls is one of them.

    Python runs in one thread at a time: it helps where the work is in compiled functions that
    let go of the interpreter (`nogil`).

    Args:
        threads: how many, the caller's included.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def run(self, function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
        """What a function gives for each part, in their order; the caller does the first one.

        An exception in a part is raised after all have ended.
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
        """The other threads; they begin with the first job, anew in a forked process."""
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="crew")
            self._process = os.getpid()
        return self._pool

    def __getstate__(self) -> dict[str, int]:
        """A copy has threads of its own."""
        return {"threads": self.threads}

    def __setstate__(self, state: dict[str, int]) -> None:
        self.__init__(state["threads"])  # type: ignore[misc]


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function compute with one thread of BLAS, and restores their number afterwards.

    A fit solves thousands of small least squares. Several threads would wait for each other at
    each of them, which on a busy machine takes ten times as long.
    """
    limited: Callable[P, R] = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited
