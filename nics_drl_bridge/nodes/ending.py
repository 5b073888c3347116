"""The end of a node's process: immediate while it has nothing to clean up, and never slow.

Python runs signal handlers between two of its own instructions, so none runs while LLVM compiles
for seconds. Until a node runs, it has nothing to clean up, and signals keep their default effect:
they end the process, with the signal's exit code. At the end, Python is not finalised either: on a
busy machine that takes as long as everything before, and unloads libraries while their threads run.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from typing import NoReturn

from nics_drl_bridge.nodes.output import FINISH_S, finish_output

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
"""Signals that end a process unless it handles them, except SIGKILL, signals of a fault in the
process itself, and those that Python ignores, such as SIGPIPE."""
_own_process = False  # True if this process is a single node


def leave(code: int) -> NoReturn:
    """End the process; call it when all is closed."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # whoever read it has gone
            stream.flush()
    finish_output(FINISH_S)
    os._exit(code)


def ending_signals() -> list[int]:
    """Return the signals at which this process ends cleanly.

    SIGHUP is not among them if the process is to outlive its terminal, as under `nohup`.
    """
    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in ENDING if not (outlives and number == signal.SIGHUP)]


def own_process() -> None:
    """Let `at_once` take effect, because this process is a single node."""
    global _own_process
    _own_process = True


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Within this context, let ending signals end the process at once, whatever it is doing."""
    if not _own_process:
        yield
        return
    handlers = {number: signal.getsignal(number) for number in ending_signals()}
    for number in handlers:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
