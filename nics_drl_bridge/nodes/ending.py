"""The end of a node's process: at once while it has nothing to leave behind, and never slowly.

Python runs its handlers of signals between two steps of its own, and none is run while LLVM
compiles for seconds. Until a node runs, it has nothing to leave behind, and the signals have their
default effect: they end the process, whose exit code is then that of the signal. Nor is Python
finalised in the end, which takes as long again as all else on a busy machine: libraries are
unloaded while their threads run.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from typing import NoReturn

from nics_drl_bridge.nodes.output import finish_output

ENDING = (
    signal.SIGHUP,  # the terminal or the ssh session is gone
    signal.SIGINT,
    signal.SIGQUIT,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGALRM,
    signal.SIGTERM,
    signal.SIGVTALRM,
    signal.SIGPROF,
    signal.SIGXCPU,
    signal.SIGIO,
    signal.SIGPWR,
    *range(signal.SIGRTMIN, signal.SIGRTMAX + 1),
)
"""Signals that end a process unless it handles them, but SIGKILL, those of a fault in the process
itself, and those that Python ignores, as SIGPIPE."""
OUTPUT_S = 1.0  # for which the last lines may take to be written
_own_process = False  # True in a process that is one node and nothing else
_within = False  # `at_once`


def leave(code: int) -> NoReturn:
    """End the process; call it when all is closed."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # whoever read it has gone
            stream.flush()
    finish_output(OUTPUT_S)
    os._exit(code)


def ending_signals() -> list[int]:
    """Return the signals at which this process ends in order.

    If it was started to outlive its terminal, as by `nohup`, SIGHUP is not one of them.
    """
    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in ENDING if not (outlives and number == signal.SIGHUP)]


def own_process() -> None:
    """Let `at_once` take effect: this process is one node and nothing else."""
    global _own_process
    _own_process = True


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Let the signals that end it end the process at once, whatever it is doing."""
    global _within
    if not _own_process or _within:
        yield
        return
    handlers = {number: signal.getsignal(number) for number in ending_signals()}
    for number in handlers:
        signal.signal(number, signal.SIG_DFL)
    _within = True
    try:
        yield
    finally:
        _within = False
        for number, handler in handlers.items():
            signal.signal(number, handler)
