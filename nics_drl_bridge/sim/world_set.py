"""World sets: many worlds under one name; every episode draws one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from glob import glob
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy  # its parts load slowly, when used
from pydantic import Field, model_validator

from nics_drl_bridge.arguments import format_value
from nics_drl_bridge.config import Schema, parse_yaml, read_text, share_folder, validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.lidar.arrays import Mask
from nics_drl_bridge.lidar.shapes import Circle, Shape
from nics_drl_bridge.sim.barn import barn_numbers, barn_world
from nics_drl_bridge.sim.world import (
    Goals,
    Obstacles,
    Region,
    Starts,
    World,
    load_world,
)

MOST_CELLS = 10_000
TRIES = 200  # maximum number of fields drawn until one has a path through it
# a cell is filled with at least, and emptied with at most, this many filled neighbours
# (of 8)
FILLED = 5
EMPTIED = 1
FINE = 2  # points per cell side in the search for a path


class Cellular(Schema):
    """Parameters of the worlds; each world draws its fill and smoothing from the given ranges."""

    kind: Literal["cellular"] = "cellular"  # kind of generator
    worlds: int = Field(ge=1, le=10_000)  # number of worlds
    # seed of the generator
    seed: int = Field(default=0, ge=0)
    columns: int = Field(default=30, ge=4)  # number of cells across the field
    rows: int = Field(default=30, ge=4)  # number of cells along the field
    # side of a cell, and diameter of a cylinder [m]
    cell: float = Field(default=0.15, ge=0.01, le=10.0)
    # fraction of cells filled initially
    fill: tuple[float, float] = (0.1, 0.35)
    smoothing: tuple[int, int] = (2, 4)  # passes of the automaton
    # free space in front of and behind the field [m]
    margin: float = Field(default=4.0, ge=0.5, le=100.0)
    # width of the path through the field [m]
    passage: float = Field(default=0.5, ge=0.0, le=100.0)

    @model_validator(mode="after")
    def _check_consistent(self) -> Cellular:
        if self.columns * self.rows > MOST_CELLS:
            raise ValueError(f"columns times rows may be at most {MOST_CELLS}")
        if not 0.0 <= self.fill[0] <= self.fill[1] < 1.0:
            raise ValueError("fill must be [minimum, maximum], from 0 to below 1")
        if self.passage > self.margin:
            raise ValueError(
                "passage may be at most as wide as margin, in whose middle the robot "
                "starts"
            )
        if not 0 <= self.smoothing[0] <= self.smoothing[1] <= 100:
            raise ValueError("smoothing must be [minimum, maximum], from 0 to 100")
        return self


MOST_MEMBERS = 10_000
YAML = (".yaml", ".yml")
GAZEBO = (".world", ".sdf")
IMPORT = "nics world import"
SPECIAL = "*?["
KEYS = ("worlds", "generate")  # only a world set has one of these keys
MAP_KEYS = ("image",)  # keys of a Nav2 map's file, which may be next to its world
BARN = "barn"  # the 250 worlds of a benchmark; one of them is `barn/7`


class SetFile(Schema):
    """Keys of a world set's YAML file."""

    name: str  # used in messages and results
    # names, files, folders and globs; paths are relative to the folder of this file
    worlds: tuple[str, ...] = Field(default=(), max_length=MOST_MEMBERS)
    without: tuple[str, ...] = ()  # worlds to leave out
    generate: Cellular | None = None  # worlds to generate


@dataclass(frozen=True, eq=False)
class WorldSet:
    """Several worlds; the seed of an episode draws one, with equal probability."""

    name: str
    members: tuple[World, ...]
    spare: tuple[Shape, ...] = ()  # see `World.spare`

    def with_spare(self, shapes: tuple[Shape, ...]) -> WorldSet:
        """Return the set with space reserved for additional bodies of some shapes."""
        return replace(self, spare=shapes)

    @property
    def source(self) -> str:
        """Name in error messages."""
        return f"world set {self.name!r}"

    @cached_property
    def fingerprint(self) -> str:
        """The name and 8 digits of a SHA-256 of the content of all members."""
        content = "\n".join(world.fingerprint for world in self.members)
        return f"{self.name}-{hash_bytes(content.encode())[:8]}"

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The distinct shapes of all obstacles."""
        return tuple(
            dict.fromkeys(shape for world in self.members for shape in world.shapes)
        )

    @cached_property
    def extent(self) -> Region:
        """Minimum x, minimum y, maximum x, maximum y of all members [m]."""
        extents = np.array([world.extent for world in self.members])
        low = extents[:, :2].min(axis=0).tolist()
        high = extents[:, 2:].max(axis=0).tolist()
        return low[0], low[1], high[0], high[1]


AnyWorld: TypeAlias = World | WorldSet


def load_worlds(name: AnyWorld | str | Path | Sequence[str | Path]) -> AnyWorld:
    """Load a world or a world set; return one that is already loaded.

    A world is given by the name of a shipped one (`arena`, `barn/7`) or the path of a YAML file; a
    set by the name of a shipped one (`cellular`; `barn`, see `sim.barn`), a list of worlds,
    a folder, a glob (`worlds/*.yaml`), or a YAML file with the key `worlds` or `generate`. Raises
    ConfigError for a missing or wrong file and names the failed member.
    """
    if isinstance(name, AnyWorld):
        return name
    if not isinstance(name, str | Path):
        several = isinstance(name, list | tuple)
        if not several or not all(isinstance(member, str | Path) for member in name):
            raise ConfigError(
                f"world={format_value(name)}: must be a name, the path of a YAML file or a "
                "folder, a World, or a list of names."
            )
        return _set_of("worlds", _members([str(member) for member in name], Path()))
    text = str(name)
    sets = share_folder() / "config" / "world_sets"
    shipped = sets / f"{name}.yaml"
    path = shipped if shipped.is_file() else Path(name)
    content = _content(path, KEYS)
    if content is not None:
        return _read_set(path, validate(content, SetFile, text))
    if (text and path.is_dir()) or any(sign in text for sign in SPECIAL):
        return _set_of(path.name if path.is_dir() else text, _members([text], Path()))
    if text == BARN:
        return _set_of(text, [barn_world(number) for number in barn_numbers()])
    number = text.removeprefix(f"{BARN}/")
    if number.isdecimal() and number != text:
        return barn_world(int(number))
    if text.endswith((*YAML, *GAZEBO)):
        return _member(path)
    return load_world(text, (BARN, *(file.stem for file in sets.glob("*.yaml"))))


def _content(path: Path, keys: tuple[str, ...]) -> dict[str, Any] | None:
    """Content of a YAML file with one of these keys; None for any other."""
    if path.suffix not in YAML or not path.is_file():
        return None
    text = read_text(path)
    if not any(f"{key}:" in text for key in keys):
        return None
    content = parse_yaml(text, str(path))
    if isinstance(content, dict) and any(key in content for key in keys):
        return content
    return None


def _read_set(path: Path, file: SetFile) -> WorldSet:
    try:
        without = {world.source for world in _members(file.without, path.parent)}
        chosen = [
            member
            for member in _members(file.worlds, path.parent)
            if member.source not in without
        ]
        generated = file.generate
        if generated is not None:
            chosen += [grow(generated, number) for number in range(generated.worlds)]
    except ConfigError as error:
        error.reword(f"{path}: {error}")
        raise
    return _set_of(file.name, chosen, str(path))


def _set_of(name: str, members: Sequence[World], source: str = "") -> WorldSet:
    source = source or f"world set {name!r}"
    if not members:
        raise ConfigError(f"{source}: contains no world; name at least one.")
    if len(members) > MOST_MEMBERS:
        raise ConfigError(
            f"{source}: contains {len(members)} worlds; the maximum is {MOST_MEMBERS}."
        )
    return WorldSet(name, tuple(members))


def _members(names: Sequence[str], base: Path) -> list[World]:
    members: list[World] = []
    for name in names:
        special = any(sign in name for sign in SPECIAL)
        path = base / name
        if special or (name and path.is_dir()):
            pattern = str(path) if special else f"{path}/*"
            every = [
                Path(file) for file in sorted(glob(pattern)) if file.endswith(YAML)
            ]
            files = [file for file in every if _content(file, MAP_KEYS) is None]
            if not files:
                raise ConfigError(
                    f"{pattern}: no world file (.yaml) there; check the path, or "
                    f"convert Gazebo worlds and maps by `{IMPORT}`."
                )
            members += map(_member, files)
        elif name.endswith((*YAML, *GAZEBO)):
            members.append(_member(path))
        else:
            members += load_worlds(name).members
    return members


def _member(path: Path) -> World:
    if _content(path, KEYS) is not None:
        raise ConfigError(
            f"{path}: is a world set, which can't be a member of a set; name its "
            "worlds."
        )
    if path.suffix in GAZEBO or _content(path, MAP_KEYS) is not None:
        kind = "a Gazebo world" if path.suffix in GAZEBO else "a map"
        raise ConfigError(f"{path}: is {kind}; convert it by `{IMPORT} {path}`.")
    return load_world(path)


@lru_cache(2048)  # training opens each of them several times
def grow(parameters: Cellular, number: int) -> World:
    """Generate the world of a number. Raises ConfigError if no field has a path.

    The robot starts in front of the field, between two walls; its goal is behind it.
    """
    rng = np.random.default_rng([parameters.seed, number])
    for _ in range(TRIES):
        filled = _field(parameters, rng)
        if _has_way(filled, parameters):
            return _world(filled, parameters, number)
    raise ConfigError(
        f"key 'generate': none of {TRIES} fields drawn for world {number} has a path of "
        f"{parameters.passage:g} m; lower `fill` or `passage`."
    )


def _field(parameters: Cellular, rng: np.random.Generator) -> Mask:
    share = rng.uniform(*parameters.fill)
    filled = rng.random((parameters.rows, parameters.columns)) < share
    around = np.zeros((parameters.rows + 2, parameters.columns + 2), np.uint8)
    around[1:-1] = 1  # the walls on both sides
    for _ in range(rng.integers(parameters.smoothing[0], parameters.smoothing[1] + 1)):
        around[1:-1, 1:-1] = filled
        three = around[:-2] + around[1:-1] + around[2:]
        neighbours = three[:, :-2] + three[:, 1:-1] + three[:, 2:] - filled
        filled = (neighbours >= FILLED) | (filled & (neighbours > EMPTIED))
    return filled


def _has_way(filled: Mask, parameters: Cellular) -> bool:
    """True if a disc as wide as the passage can cross the field."""
    # outside the field, everything is free
    ahead = FINE * (1 + math.ceil(parameters.passage / 2.0 / parameters.cell))
    free = np.ones(
        (FINE * parameters.rows + 2 * ahead, FINE * parameters.columns + 2), np.bool_
    )
    free[:, [0, -1]] = False  # the walls on both sides
    free[ahead:-ahead, 1:-1] = ~np.repeat(np.repeat(filled, FINE, axis=0), FINE, axis=1)
    away = scipy.ndimage.distance_transform_edt(free) * parameters.cell / FINE
    areas, _ = scipy.ndimage.label(away > parameters.passage / 2.0)
    start, goal = areas[[0, -1], areas.shape[1] // 2].tolist()
    return bool(start > 0 and start == goal)


def _world(filled: Mask, parameters: Cellular, number: int) -> World:
    cell = parameters.cell
    margin = parameters.margin
    wide = parameters.columns * cell
    deep = parameters.rows * cell
    long = deep + 2.0 * margin
    rows, columns = np.nonzero(filled)
    places = np.stack([(columns + 0.5) * cell, margin + (rows + 0.5) * cell], axis=1)
    poses = tuple((x, y, 0.0) for x, y in np.round(places, 6).tolist())
    obstacles: tuple[Obstacles, ...] = ()
    if poses:
        obstacles = (Obstacles(shapes=(Circle(radius=cell / 2.0),), at=poses),)
    return World(
        name=f"cellular_{parameters.seed}_{number}",
        bounds=(0.0, 0.0, wide, long),
        clearance=0.0,
        walls=(
            (0.0, 0.0, 0.0, margin + deep),
            (wide, 0.0, wide, margin + deep),
            (0.0, 0.0, wide, 0.0),
        ),
        obstacles=obstacles,
        goal_distance=(0.0, 2.0 * long),
        starts=Starts(at=((wide / 2.0, margin / 2.0, math.pi / 2.0),)),
        goals=Goals(at=((wide / 2.0, long - margin / 2.0),)),
    )
