"""Guards around an env's methods: any exception stops the robot; actions are checked."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import gymnasium
import numpy as np

from nics_drl_bridge.env import kernels
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.arrays import AnyArray

P = ParamSpec("P")
T = TypeVar("T")


def stop_on_error(
    method: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Makes a method `halt` its robot if it raises any exception, including KeyboardInterrupt."""

    @wraps(method)
    def call_guarded(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(self, *args, **kwargs)
        except BaseException:
            with delay_interrupts():
                self.halt()
            raise

    return call_guarded


class ClosedEnvError(ConfigError, gymnasium.error.ClosedEnvironmentError):
    """A method was called after `close`."""


def refuse_after_close(
    method: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Makes a method of an env raise ClosedEnvError once `_closed` is True."""

    @wraps(method)
    def call_guarded(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        if self._closed:
            call = f"{method.__name__}() after close()"
            raise ClosedEnvError(f"{call}: the env is closed; make a new one.")
        return method(self, *args, **kwargs)

    return call_guarded


def guard_call(
    method: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Combines `refuse_after_close` and `stop_on_error`."""
    return refuse_after_close(stop_on_error(method))


@contextlib.contextmanager
def delay_interrupts() -> Iterator[None]:
    """Defers Ctrl-C to the end of the block, so that it can't interrupt stopping a robot."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Ctrl-C never interrupts other threads
        return
    came: list[int] = []

    def remember(number: int, _: Any) -> None:
        came.append(number)

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        if before is None:
            before = signal.SIG_DFL
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


def check_action(action: Any, space: gymnasium.Space[Any], name: str) -> AnyArray:
    """Returns an action as an array of its space's shape. Raises Gymnasium's InvalidAction."""
    try:
        array = np.asarray(action)
    except ValueError as error:  # a ragged list
        raise gymnasium.error.InvalidAction(f"{name}: {error}") from None
    if array.dtype.kind not in "fiub":
        raise gymnasium.error.InvalidAction(
            f"{name} of {array.dtype}: must be real numbers."
        )
    if array.shape != space.shape:
        raise gymnasium.error.InvalidAction(
            f"{name} of shape {array.shape}: must be of shape {space.shape}."
        )
    if isinstance(space, gymnasium.spaces.Box) and space.dtype == np.float32:
        if array.dtype.char not in "fd":
            # The kernels are compiled only for float32 and float64.
            array = array.astype(np.float64)
        if not kernels.is_finite(array.reshape(1, -1)):
            raise gymnasium.error.InvalidAction(
                f"{name} {array!r}: contains NaN or inf."
            )
    elif not space.contains(array):
        raise gymnasium.error.InvalidAction(f"{name} {array!r}: is not in {space}.")
    return array
