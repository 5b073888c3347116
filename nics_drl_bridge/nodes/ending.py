"""The end of a node's process: at once while it has nothing to leave behind, and never slowly.

Python runs its handlers of signals between two steps of its own, and none is run while LLVM
compiles for seconds. Until a node runs, it has nothing to leave behind, and the handler is a C
function that ends the process. Nor is Python finalised in the end, which takes as long again as
all else on a busy machine: libraries are unloaded while their threads run.
"""

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from typing import NoReturn

ENDING = (signal.SIGINT, signal.SIGTERM)
_leave: int | None = None  # address of the handler; None in a process that is more than one node
_within = False  # `at_once`


def leave(code: int) -> NoReturn:
    """Ends the process; call it when all is closed."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # whoever read it has gone
            stream.flush()
    os._exit(code)


def own_process() -> None:
    """Lets `at_once` take effect: this process is one node and nothing else."""
    global _leave
    from nics_drl_bridge.nodes.ending_kernels import address_of_leave

    _leave = address_of_leave()


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Lets SIGINT and SIGTERM end the process with code 0, whatever it is doing."""
    global _within
    if _leave is None or _within:
        yield
        return
    handle = ctypes.CDLL(None).signal
    handle.argtypes, handle.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
    for number in ENDING:
        handle(number, _leave)
    _within = True
    try:
        yield
    finally:
        _within = False
        for number in ENDING:  # Python's own handlers again
            signal.signal(number, signal.getsignal(number))
