"""The guard around an env's methods: whatever ends one by an exception stops the robot."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Halting(Protocol):
    """Anything with a robot that can be told to stop."""

    def halt(self) -> None:
        """Leaves the robot with a zero command."""
        ...


P = ParamSpec("P")
H = TypeVar("H", bound=Halting)
T = TypeVar("T")


def halts_on_error(
    method: Callable[Concatenate[H, P], T],
) -> Callable[Concatenate[H, P], T]:
    """Makes a method halt its object's robot when any exception leaves it, Ctrl-C included.

    An error of `halt` itself is raised with the first one as its context.
    """

    @wraps(method)
    def guarded(self: H, /, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(self, *args, **kwargs)
        except BaseException:
            with uninterrupted():
                self.halt()
            raise

    return guarded


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Lets no Ctrl-C cut short what leaves a robot standing still: it is answered afterwards."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread is interrupted
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
        if came:
            signal.raise_signal(signal.SIGINT)
