"""Seeds and options of an env's `reset`: checked, and written where they belong."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.geometry import compute_depths, rotate
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS
from nics_drl_bridge.lidar.shapes import Shape, find_outline
from nics_drl_bridge.seeds import GREATEST_SEED, check_seeds
from nics_drl_bridge.sim.scenes import Scene
from nics_drl_bridge.sim.world import check_place
from nics_drl_bridge.sim.world_set import AnyWorld


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
        write_option(memory[name], name, value)
    if options and "goal" in options:
        check_places("goal", memory["goal"], scenes, world)
    return memory


def write_option(rows: AnyArray, name: str, value: Any) -> None:
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
        member = world.members[scene.member]
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
    apart = (x, y) - body[:2]
    if body[RADIUS] <= 0.0 or np.hypot(*apart) >= radius + body[RADIUS]:
        return False
    corners = find_outline(body, shapes)
    if not len(corners):
        return True
    place = rotate(apart, -body[HEADING])
    return bool(compute_depths(place[None], corners)[0] > -radius)
