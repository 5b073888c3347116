"""Lets SIGINT and SIGTERM end a command, and remembers whether Ctrl-C interrupted it."""

import signal
import threading
from types import FrameType

ENDING = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
_interrupts: list[int] = []  # each SIGINT that was received


def take_signals() -> None:
    """Lets SIGINT and SIGTERM end the command, unless they are ignored or handled already."""
    _interrupts.clear()
    if threading.current_thread() is not threading.main_thread():
        return  # Python can set handlers only in the main thread
    for number, usual in ENDING.items():
        if signal.getsignal(number) is usual:
            signal.signal(number, _end)


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


def _end(number: int, frame: FrameType | None) -> None:
    """Handles SIGINT or SIGTERM: remembers Ctrl-C, and raises an exception as soon as possible."""
    if number == signal.SIGINT:
        _interrupts.append(number)
    while frame is not None and not frame.f_code.co_name.startswith(
        "_raw_object_cache"
    ):
        frame = frame.f_back
    # No exception can leave this callback of llvmlite: try again later, in the main thread, where
    # the signal also ends a system call that waits.
    if frame is not None:
        main = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, (main, number)).start()
    elif number == signal.SIGINT:
        raise KeyboardInterrupt
    else:
        raise SystemExit(128 + number)


def has_heard_ctrl_c() -> bool:
    """Returns True if SIGINT has come since `take_signals`."""
    return bool(_interrupts)
