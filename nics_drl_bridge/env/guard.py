"""The guard around an env's methods: whatever ends one by an exception stops the robot.

Seeds and options that a reset can't use, told before anything begins.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np

from nics_drl_bridge.errors import ConfigError, nearest


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


SEEDS = 2**63
"""A seed is below it: it is a signed 64-bit integer over ROS 2 and in the kernels."""
START = "start"
"""The option that any task takes, beside the names of its memory."""


def check_reset(seed: Any, options: Any, worlds: int = 1) -> None:
    """Refuses what can be refused before the task is asked.

    Gymnasium itself refuses a seed that is negative.

    Args:
        seed: of the first world, or one for each; those of the next worlds count on.
        options: as given to `reset`.
        worlds: how many.

    Raises:
        ConfigError: a seed that is no integer or too great, or options that are no dict.
    """
    last = SEEDS - worlds if isinstance(seed, int | np.integer) else SEEDS - 1
    for one in seed if isinstance(seed, list | tuple | np.ndarray) else [seed]:
        if not (one is None or isinstance(one, int | np.integer)):
            raise ConfigError(f"seed of type {type(one).__name__}: must be an integer, or None.")
        if one is not None and one > last:
            raise ConfigError(f"seed {_shown(int(one))}: must be at most 2**63 - {SEEDS - last}.")
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(
            f"reset options of type {type(options).__name__}: must be a dict, as {{'start': "
            "(x, y, heading)}, or None."
        )


def _shown(seed: int) -> str:
    """A number as long as a line can hold it."""
    return str(seed) if seed < SEEDS**2 else f"of {seed.bit_length()} bits"


def check_options(
    options: Mapping[str, Any] | None, memory: Iterable[str], more: tuple[str, ...] = ()
) -> None:
    """Raises ConfigError for a reset option that nothing takes.

    Args:
        options: as given to `reset`.
        memory: names of what the task remembers.
        more: further names that the env takes.
    """
    valid = {START, *memory, *more}
    for name in options or ():
        if name not in valid:
            raise ConfigError(f"unknown reset option {name!r}; {nearest(str(name), valid)}")
