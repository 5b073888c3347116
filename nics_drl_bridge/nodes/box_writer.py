"""Writing what this process remembers now, without ever waiting for a disk."""

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
"""Writers that a disk may hold up at a time; each keeps a copy of this process's memory."""
PATIENCE_S = 20.0
"""A writer that takes longer gives up."""
OVERDUE_S = PATIENCE_S + 5.0
"""One that has not even given up by then never will: another thread may have held a lock when it
was copied, or the disk holds it."""
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
    """Writes files, each in a process of its own that begins as a copy of this one.

    The copy (`fork`, which shares memory until somebody changes it) is the snapshot: it takes this
    process some milliseconds, however much there is to write, and what happens here later is not in
    it. A disk that hangs holds up the copy and nobody else, not even the end of this process, as a
    thread that waits for it would. The copy has no other thread, lets go of all sockets, and runs
    at ordinary priority.
    """

    def __init__(self) -> None:
        self._writers: list[_Writer] = []
        self._failed: list[str] = []

    def begin(self, write: Callable[[], object]) -> bool:
        """Lets a copy of this process write; False when too many are at work.

        Args:
            write: called in the copy. Where an exception ends it, it has to clean up after itself.

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
        """What went wrong with those that have ended since the last look."""
        self._look()
        failed, self._failed = self._failed, []
        return failed

    def _look(self) -> None:
        """Parts with the writers that have ended, and ends those that are overdue."""
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
            seconds: to wait at most, but for a moment to clean up.

        Returns:
            What went wrong.
        """
        failed = self._wait(seconds)
        for writer in self._writers:
            os.kill(writer.pid, signal.SIGTERM)
        failed += self._wait(GRACE_S)
        for writer in self._writers:  # held up by the disk; it ends when that lets it go
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
    """Keeps signals waiting, lest the copy runs the handlers of the original."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, *ENDING))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _copied() -> int:
    """0 in a copy of this process, and its id in this one."""
    with warnings.catch_warnings():
        # Of Python 3.12: locks that other threads hold stay locked in the copy. It needs none of
        # theirs, and one that hangs all the same gives up.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


def _ended(pid: int) -> int | None:
    """The status with which a writer has ended; None while it lives."""
    try:
        ended, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:  # where SIGCHLD is ignored nobody keeps it
        return 0
    return status if ended else None


def _live(write: Callable[[], object], told: int) -> NoReturn:
    """The life of a copy: it never returns to the code that it was copied from."""
    code = 1
    try:
        gc.disable()  # which would touch, and so copy, all memory
        _let_go(told)
        write()
        code = 0
    finally:  # whatever comes, also out of a signal
        error = sys.exc_info()[1]
        if error is not None:
            os.write(told, (str(error) or type(error).__name__).encode()[:MOST_TOLD])
        os._exit(code)


def _let_go(told: int) -> None:
    """Gives up sockets, files, priority and signals that belong to the original."""
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
