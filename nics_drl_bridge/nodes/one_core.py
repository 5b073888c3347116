"""Two threads that take turns, on one core."""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading

try:
    _core_now = ctypes.PyDLL(None).sched_getcpu
    _allowed, _allow = os.sched_getaffinity, os.sched_setaffinity
    CAN_CHOOSE = True
except (AttributeError, TypeError):  # no Linux with glibc
    CAN_CHOOSE = False


class OneCore:
    """Keeps a thread that waits, and the helper that it waits for, on one core while it waits.

    Then nobody has to be woken on another core that sleeps, which on a virtual machine takes about
    a tenth of a lock-step step, for each of the two. The helper follows the waiting thread wherever
    the system moves that. That one may run anywhere again as soon as it waits no more, so that
    threads that it starts do not inherit anything.

    Where the system does not let threads choose, this only waits.
    """

    def __init__(self) -> None:
        self._helper, self._place = 0, (0, -1)

    def help(self) -> None:
        """Says that the calling thread is the helper."""
        self._helper = threading.get_native_id()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Waits for an event; whether it came within a time [s]."""
        cores = _allowed(0) if CAN_CHOOSE and self._helper else set()
        if len(cores) < 2:
            return event.wait(timeout_s)
        try:
            self._share()
            return event.wait(timeout_s)
        finally:  # also of whoever is interrupted in the middle of it
            with contextlib.suppress(OSError):
                _allow(0, cores)

    def _share(self) -> None:
        # The helper may have ended, and somebody else may decide about cores.
        with contextlib.suppress(OSError, ValueError):
            core = _core_now()
            if self._place != (self._helper, core):
                _allow(self._helper, {core})
                self._place = self._helper, core
            _allow(0, {core})
