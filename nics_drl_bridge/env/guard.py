"""Guard around an env's methods: any exception that leaves one stops the robot.

Checks of the seeds and options of a reset, before anything begins.
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
    """Anything with a robot that can be stopped."""

    def halt(self) -> None:
        """Stops the robot with a zero command."""
        ...


P = ParamSpec("P")
H = TypeVar("H", bound=Halting)
T = TypeVar("T")


def halts_on_error(
    method: Callable[Concatenate[H, P], T],
) -> Callable[Concatenate[H, P], T]:
    """Makes a method halt its object's robot if any exception leaves it, including Ctrl-C.

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
    """Defers Ctrl-C to the end of the block, so that stopping a robot is not interrupted."""
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
"""Exclusive upper bound of seeds: signed 64-bit integers over ROS 2 and in the kernels."""
START = "start"
"""The option that every task takes in addition to the names of its memory."""


def check_reset(seed: Any, options: Any, worlds: int = 1) -> None:
    """Checks what can be checked without the task.

    Gymnasium itself refuses negative seeds.

    Args:
        seed: of the first world, from which the others count up, or one for each.
        options: as given to `reset`.
        worlds: number of worlds.

    Raises:
        ConfigError: a seed is not an integer or too large, or the options are not a dict.
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
    """A seed as text; of an overlong one its number of bits."""
    return str(seed) if seed < SEEDS**2 else f"of {seed.bit_length()} bits"


def check_options(
    options: Mapping[str, Any] | None, memory: Iterable[str], more: tuple[str, ...] = ()
) -> None:
    """Raises ConfigError for an unknown reset option.

    Args:
        options: as given to `reset`.
        memory: names of the task's memory.
        more: further names that the env takes.
    """
    valid = {START, *memory, *more}
    for name in options or ():
        if name not in valid:
            raise ConfigError(f"unknown reset option {name!r}; {nearest(str(name), valid)}")
