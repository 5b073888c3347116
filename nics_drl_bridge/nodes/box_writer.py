"""Snapshots of this process's memory, written without ever waiting for a disk."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NoReturn

MOST_AT_WORK = 3
"""Greatest number of writers at work; each keeps a copy of this process's memory."""
PATIENCE_S = 20.0
"""A writer that takes longer gives up [s]."""
OVERDUE_S = PATIENCE_S + 5.0
"""A writer that still runs after this never gives up [s]: another thread may have held a lock
during the fork, or the disk blocks it."""
GRACE_S, POLL_S = 0.5, 0.005
NICENESS = 5
MOST_TOLD = 500
ENDING = (signal.SIGTERM, signal.SIGALRM)


@dataclass(frozen=True)
class _Writer:
    pid: int
    told: int
    begun_s: float


class BoxWriter:
    """Writes files, each in its own process, which starts as a copy of this one.

    The copy (`fork`, which shares memory until it is modified) is the snapshot: it takes this
    process some milliseconds, however much there is to write, and later changes here are not in
    it. A disk that hangs blocks the copy and nothing else, not even the end of this process, as a
    waiting thread would. The copy has no other thread, closes all sockets, and runs at ordinary
    priority.
    """

    def __init__(self) -> None:
        self._writers: list[_Writer] = []
        self._failed: list[str] = []

    def begin(self, write: Callable[[], object]) -> bool:
        """Starts a copy of this process that writes; returns False if too many are at work.

        Args:
            write: called in the copy. If an exception ends it, it has to clean up after itself.

        Raises:
            OSError: the system can't make another process.
        """
        self._look()
        if len(self._writers) >= MOST_AT_WORK:
            return False
        heard, told = os.pipe()
        os.set_blocking(heard, False)
        try:
            with _no_signals():
                pid = _copied()
                if pid == 0:
                    _live(write, told)
        except OSError:
            os.close(heard)
            raise
        finally:
            os.close(told)
        self._writers.append(_Writer(pid, heard, time.monotonic()))
        return True

    def failures(self) -> list[str]:
        """Returns the failures of the writers that have ended since the last call."""
        self._look()
        failed, self._failed = self._failed, []
        return failed

    def _look(self) -> None:
        """Removes the writers that have ended, and kills those that are overdue."""
        for writer in tuple(self._writers):
            status = _ended(writer.pid)
            if status is None:
                if time.monotonic() - writer.begun_s > OVERDUE_S:
                    os.kill(writer.pid, signal.SIGKILL)
                continue
            self._writers.remove(writer)
            if status != 0:
                self._failed.append(_read(writer.told) or f"its writer ended with {status}")
            os.close(writer.told)

    def close(self, seconds: float) -> list[str]:
        """Waits for the writers, and makes those give up that take longer.

        Args:
            seconds: longest wait, plus a moment for clean-up.

        Returns:
            The failures.
        """
        failed = self._wait(seconds)
        for writer in self._writers:
            os.kill(writer.pid, signal.SIGTERM)
        failed += self._wait(GRACE_S)
        for writer in self._writers:  # blocked by the disk; it ends when that releases it
            os.kill(writer.pid, signal.SIGKILL)
            failed.append("the disk does not answer")
        return failed

    def _wait(self, seconds: float) -> list[str]:
        failed, deadline = self.failures(), time.monotonic() + seconds
        while self._writers and time.monotonic() < deadline:
            time.sleep(POLL_S)
            failed += self.failures()
        return failed


@contextlib.contextmanager
def _no_signals() -> Iterator[None]:
    """Defers signals, so that the copy does not run the handlers of the original."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, *ENDING))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _copied() -> int:
    """Forks; returns 0 in the copy of this process, and its id in this one."""
    with warnings.catch_warnings():
        # Of Python 3.12: locks that other threads hold stay locked in the copy. It needs none of
        # theirs, and a copy that hangs nevertheless gives up.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


def _ended(pid: int) -> int | None:
    """Returns the exit status of a writer; None while it runs."""
    try:
        ended, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:  # if SIGCHLD is ignored, no status is kept
        return 0
    return status if ended else None


def _live(write: Callable[[], object], told: int) -> NoReturn:
    """Runs in the copy; never returns to the code that it was copied from."""
    code = 1
    try:
        gc.disable()  # which would touch, and so copy, all memory
        _let_go(told)
        write()
        code = 0
    finally:  # on any exception, also from a signal
        error = sys.exc_info()[1]
        if error is not None:
            os.write(told, (str(error) or type(error).__name__).encode()[:MOST_TOLD])
        os._exit(code)


def _let_go(told: int) -> None:
    """Releases sockets, files, priority and signals that belong to the original."""
    for number in [int(name) for name in os.listdir("/proc/self/fd")]:
        if number != told:
            with contextlib.suppress(OSError):
                os.close(number)
    for _ in range(3):
        os.open(os.devnull, os.O_RDWR)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the original decides
    for number in ENDING:
        signal.signal(number, _give_up)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, *ENDING))


def _give_up(*_: object) -> NoReturn:
    raise TimeoutError("it took too long")


def _read(told: int) -> str:
    try:
        return os.read(told, MOST_TOLD).decode(errors="replace")
    except BlockingIOError:
        return ""
