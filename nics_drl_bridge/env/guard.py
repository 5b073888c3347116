"""Guards around an env's methods: any exception stops the robot, and arguments are checked."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env import kernels
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.lidar.exact_kernels import COS, RADIUS, SHAPE, SIN
from nics_drl_bridge.lidar.shapes import Shape
from nics_drl_bridge.seeds import GREATEST_SEED, check_seeds
from nics_drl_bridge.sim.collision_kernels import Outline, outline_point
from nics_drl_bridge.sim.scenes import Scene
from nics_drl_bridge.sim.world import check_place
from nics_drl_bridge.sim.world_set import AnyWorld

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


def _make_closed_error(method: Callable[..., Any]) -> ClosedEnvError:
    call = f"{method.__name__}() after close()"
    return ClosedEnvError(f"{call}: the env is closed; make a new one.")


def refuse_after_close(
    method: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Makes a method of an env raise ClosedEnvError once `_closed` is True."""

    @wraps(method)
    def call_guarded(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        if self._closed:
            raise _make_closed_error(method)
        return method(self, *args, **kwargs)

    return call_guarded


def guard_call(
    method: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Combines `refuse_after_close` and `stop_on_error` in one call, which saves time."""

    @wraps(method)
    def call_guarded(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        if self._closed:
            raise _make_closed_error(method)
        try:
            return method(self, *args, **kwargs)
        except BaseException:
            with delay_interrupts():
                self.halt()
            raise

    return call_guarded


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


def check_reset(seed: Any, options: Any, worlds: int = 1) -> None:
    """Raises ConfigError for wrong options or seeds (one for all worlds, or one each)."""
    several = isinstance(seed, list | tuple | np.ndarray)
    named = seed if several else [seed]
    seeds = [one for one in named if one is not None]
    check_seeds(seeds, GREATEST_SEED if several else GREATEST_SEED + 1 - worlds)
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(
            f"reset options of type {type(options).__name__}: must be a dict such as {{'start': "
            "(x, y, heading)}, or None."
        )


def begin_task(
    task: Any,
    episodes: Any,
    options: Mapping[str, Any] | None,
    scenes: Iterable[Scene],
    world: AnyWorld,
    *of_env: str,
) -> dict[str, AnyArray]:
    """Returns a Task's memory for starting Episodes, with values of `reset(options=...)`.

    Each value is written into all rows of the array of its name. Options in `of_env`
    belong to the env, even if the task's memory has an entry of that name.
    """
    memory: dict[str, AnyArray] = task.start_episodes(episodes)
    for name, value in (options or {}).items():
        if name in of_env:
            continue
        if name not in memory:
            hint = suggest(str(name), {*memory, *of_env})
            raise ConfigError(f"unknown reset option {name!r}; {hint}")
        give(memory[name], name, value)
    if options and "goal" in options:
        check_places("goal", memory["goal"], scenes, world)
    return memory


def give(rows: AnyArray, name: str, value: Any) -> None:
    """Writes a value of `reset(options=...)` into rows (n, ...). Raises ConfigError."""
    try:
        numbers = np.asarray(value)
    except ValueError:  # a ragged list
        numbers = np.asarray(None)
    option = f"reset option {name!r}, {value!r}"
    shapes = [rows.shape[k:] for k in range(max(2, rows.ndim))]
    fits = numbers.shape in shapes
    if not fits or numbers.dtype.kind not in "fiub":
        raise ConfigError(
            f"{option}: must be numbers of shape {rows.shape[1:]}, or its last dimensions."
        )
    rows[...] = numbers
    if not np.isfinite(rows).all():
        raise ConfigError(f"{option}: must be finite.")


def check_places(
    option: str,
    places: NDArray[np.float64],
    scenes: Iterable[Scene],
    world: AnyWorld,
    radius: float = 0.0,
) -> None:
    """Raises ConfigError for starts or goals (n, ..., 2 or 3) off the field or in a wall.

    Starts (`radius` > 0) may not overlap an obstacle in every one of the n scenes either.
    """
    is_free_somewhere = not radius
    for scene, rows in zip(scenes, places, strict=True):
        member = world.members[int(np.asarray(scene.member))]
        at = rows.reshape(-1, rows.shape[-1])
        for x, y in at[:, :2].tolist():
            check_place(f"reset option {option!r}", member, x, y, radius)
        shapes = world.shapes
        is_free_somewhere = is_free_somewhere or not any(
            _is_on(x, y, radius, body, shapes)
            for x, y in at[:, :2].tolist()
            for body in scene.bodies
        )
    if not is_free_somewhere and len(places):
        raise ConfigError(
            f"reset option {option!r}: {at.tolist()} is on an obstacle; move "
            "it, or use another seed."
        )


def _is_on(
    x: float, y: float, radius: float, body: AnyArray, shapes: Sequence[Shape]
) -> bool:
    """Returns True if a disc overlaps a body."""
    dx, dy = (x, y) - body[:2]
    c, s = body[[COS, SIN]]
    reach = body[RADIUS]
    if reach <= 0.0 or np.hypot(dx, dy) >= radius + reach:
        return False
    # Each shape may occur in several sizes.
    shape = shapes[int(body[SHAPE]) % len(shapes)]
    corners = shape.outline * (reach / shape.radius)
    if not len(corners):
        return True
    outline = Outline(corners, 0, len(corners))
    gap = outline_point(c * dx + s * dy, c * dy - s * dx, outline)
    return bool(gap < radius)


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


def check_command(command: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Returns a task's command as an array. Raises ConfigError unless finite, of this shape."""
    made = np.asarray(command, np.float64)
    if made.shape != shape or not kernels.is_finite(made.reshape(1, -1)):
        raise ConfigError(
            f"the task's command {made!r:.80}: must be finite and of shape "
            f"{shape}; check its `command`."
        )
    return made
