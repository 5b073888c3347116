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
except AttributeError:  # no Linux with glibc
    CAN_CHOOSE = False


class OneCore:
    """Keeps a thread that waits, and the helper that it waits for, on one core while it waits.

    They never work at the same time, so that they lose nothing by sharing a core; and nobody has to
    be woken on another core that sleeps, which on a virtual machine takes about as long as all
    that is done in between. The helper follows the waiting thread wherever the system moves that.
    That one may run anywhere again as soon as it waits no more, so that threads that it starts
    do not inherit anything.

    A context manager around the waiting. Where the system does not let threads choose, it does
    nothing.
    """

    def __init__(self) -> None:
        self._helper, self._place = 0, (0, -1)
        self._before: set[int] | None = None

    def help(self) -> None:
        """Says that the calling thread is the helper."""
        self._helper = threading.get_native_id()

    def __enter__(self) -> None:
        self._before = None
        if not (CAN_CHOOSE and self._helper):
            return
        with contextlib.suppress(OSError):  # the helper has ended, or somebody else decides
            before, core = _allowed(0), _core_now()
            if len(before) < 2:
                return
            if self._place != (self._helper, core):
                _allow(self._helper, {core})
                self._place = self._helper, core
            _allow(0, {core})
            self._before = before

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            with contextlib.suppress(OSError):
                _allow(0, self._before)
