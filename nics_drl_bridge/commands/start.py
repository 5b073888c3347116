"""Entry point of `nics`: one sentence, not a traceback, where a library is missing or too old."""

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
_interrupts: list[int] = []  # the times [ns] at which Ctrl-C came


def take_signals() -> None:
    """Lets SIGINT and SIGTERM end the command, unless somebody wants them ignored."""
    if threading.current_thread() is not threading.main_thread():
        return  # Python sets handlers in the main thread only
    for number, usual in ENDING.items():
        if signal.getsignal(number) is usual:
            signal.signal(number, _note_and_end)


def was_interrupted(error: BaseException | None) -> bool:
    """True if an error came of Ctrl-C, whatever the library that it went through made of it.

    A compiled function makes a SystemError of it, a prompt an Abort, and an interrupt between two
    statements of a library leaves an error of its own behind.
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
    if (
        frame is not None
    ):  # llvmlite's callback, out of which no exception comes: a little later
        threading.Timer(0.01, signal.raise_signal, (number,)).start()
    elif number == signal.SIGINT:
        raise KeyboardInterrupt
    else:
        raise SystemExit(128 + number)


def main() -> None:
    """Runs a command, which imports what it needs as it runs."""
    _interrupts.clear()
    take_signals()
    try:
        _run()
    except SystemExit as end:
        if _interrupts and end.code not in (
            0,
            None,
        ):  # unless the command has dealt with it
            _leave_interrupted()
        raise


def _run() -> None:
    try:
        from nics_drl_bridge.commands.cli import main as run

        run()
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001  (what it can't explain it raises)
        _explain(error)


def _leave_interrupted() -> NoReturn:
    """Ends the process with the code of an interrupt, whatever became of that on its way.

    Python would end it by the signal instead, where Ctrl-C came while the text of a function was
    run (as dataclasses make them), and with other codes where libraries end beside their threads.
    """
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a second one changes nothing any more
    with contextlib.suppress(Exception):
        atexit._run_exitfuncs()  # zero commands, files and processes of the command
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # whoever read it has gone
            stream.flush()
    os._exit(EXIT_INTERRUPTED)


def _explain(error: BaseException) -> NoReturn:
    """Ends the process by a sentence about an error outside of a command, or raises it."""
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
        # It is numba's, as kernels are imported.
        reason = "neither the package's folder nor your home can be written to, to keep kernels in"
        sys.stderr.write(f"nics: {reason}; set NUMBA_CACHE_DIR to a folder that can.\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    raise error


if __name__ == "__main__":
    main()
