"""Entry point of `nics`: a missing or outdated library gives one sentence, not a traceback."""

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
ENDING = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
_interrupts: list[int] = []  # times [ns] of Ctrl-C


def take_signals() -> None:
    """Lets SIGINT and SIGTERM end the command, unless they are ignored or handled already."""
    if threading.current_thread() is not threading.main_thread():
        return  # Python can set handlers only in the main thread
    for number, usual in ENDING.items():
        if signal.getsignal(number) is usual:
            signal.signal(number, _note_and_end)


def was_interrupted(error: BaseException | None) -> bool:
    """Returns True if Ctrl-C caused an error, even if a library turned it into another one.

    A compiled function turns it into a SystemError, a prompt into an Abort, and an interrupt
    between two statements of a library can cause an unrelated error.
    """
    if _interrupts:
        return True
    visited = set[int]()
    waiting = [error]
    while waiting:
        link = waiting.pop()
        if isinstance(link, KeyboardInterrupt):
            return True
        if link is not None and id(link) not in visited:
            visited.add(id(link))
            waiting += [link.__cause__, link.__context__]
    return False


def _note_and_end(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGINT:
        _interrupts.append(time.monotonic_ns())
    _end(number, frame)


def _end(number: int, frame: FrameType | None) -> None:
    while frame is not None and not frame.f_code.co_name.startswith(
        "_raw_object_cache"
    ):
        frame = frame.f_back
    # No exception can leave this callback of llvmlite: try again later.
    if frame is not None:
        threading.Timer(0.01, signal.raise_signal, (number,)).start()
    elif number == signal.SIGINT:
        raise KeyboardInterrupt
    else:
        raise SystemExit(128 + number)


def main() -> None:
    """Runs a command; everything it needs is imported only now."""
    _interrupts.clear()
    take_signals()
    try:
        _run()
    except SystemExit as end:
        # With code 0 the command has handled the interrupt.
        if _interrupts and end.code not in (0, None):
            _leave_interrupted()
        raise


def _run() -> None:
    try:
        from nics_drl_bridge.commands.cli import main as run

        run()
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001  (_explain raises what it can't explain)
        _explain(error)


def _leave_interrupted() -> NoReturn:
    """Ends the process with the exit code of an interrupt, whatever the pending error.

    Otherwise Python ends by the signal if Ctrl-C came inside `exec` (dataclasses use it), and with
    other exit codes if libraries shut down while their threads still run.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ignore further Ctrl-C
    with contextlib.suppress(Exception):
        atexit._run_exitfuncs()  # sends zero commands, removes files, ends processes
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # the reader is gone
            stream.flush()
    os._exit(EXIT_INTERRUPTED)


def _explain(error: BaseException) -> NoReturn:
    """Exits with a sentence about an error outside of any command, or raises the error."""
    if was_interrupted(error):
        sys.stderr.write("nics: interrupted; nothing was started.\n")
        raise SystemExit(EXIT_INTERRUPTED) from None
    if isinstance(error, ImportError):
        from nics_drl_bridge import extensions

        if (clause := extensions.explain_unmet(error)) is None:
            raise error
        sys.stderr.write(f"nics: {clause}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    if isinstance(error, RuntimeError) and "no locator available" in str(error):
        # numba raises this when kernels are imported.
        reason = "neither the package's folder nor your home can be written to, to keep kernels in"
        sys.stderr.write(f"nics: {reason}; set NUMBA_CACHE_DIR to a folder that can.\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    raise error


if __name__ == "__main__":
    main()
