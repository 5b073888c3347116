"""World files: the field of the episodes, the obstacles, and their motion."""

import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import (
    Field,
    PrivateAttr,
    field_validator,
    model_validator,
)

from nics_drl_bridge.config import Heading, Schema, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.maps import GridMap, load_map
from nics_drl_bridge.lidar.shapes import LARGEST, MOST_SHAPES, Coordinate, Shape
from nics_drl_bridge.sim.collision_kernels import wall_distance
from nics_drl_bridge.sim.state import PATROL, PEDESTRIAN, PLAN, Records

MOST_OBSTACLES = 10_000
MOST_ACROSS_M = 1000.0  # diagonal; observations represent goal distances up to 1000 m
MOST_WALLS = 10_000
MOST_PLACES = 10_000
SMALLEST_FIELD = 0.01  # Minimum side of a field [m]
Distance = Annotated[float, Field(ge=0.0, le=LARGEST)]
Side = Annotated[float, Field(ge=SMALLEST_FIELD, le=LARGEST)]
Pose = tuple[Coordinate, Coordinate, Heading]
Point = tuple[Coordinate, Coordinate]
Region = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
# Maximum speed of an obstacle [m/s]; above it, a control period is too coarse
FASTEST = 10.0
# Upper bound on the parameters of the social force model, each in its unit
STRONGEST = 1e3
Strength = Annotated[float, Field(ge=0.0, le=STRONGEST)]
Range = Annotated[float, Field(ge=1e-3, le=STRONGEST)]


class Patrol(Schema):
    """Moves from waypoint to waypoint and waits while its path is blocked."""

    kind: Literal["patrol"] = "patrol"  # kind of motion
    # x, y in `map` [m]
    waypoints: tuple[Point, ...] = Field(min_length=2, max_length=1000)
    speed: float = Field(gt=0.0, le=FASTEST)  # [m/s]
    # return from the last waypoint to the first; otherwise go back and forth
    loop: bool = True
    # waiting time at each waypoint [s]
    pause: float = Field(default=0.0, ge=0.0, le=1e6)

    @model_validator(mode="after")
    def _check_apart(self) -> "Patrol":
        corners = [*self.waypoints, *self.waypoints[: int(self.loop)]]
        if any(corner == next_corner for corner, next_corner in pairwise(corners)):
            raise ValueError("consecutive waypoints must differ")
        return self


class Pedestrian(Schema):
    """Walks to random goals, by the social force model of Helbing and Molnar (1995).

    Symbols and defaults are from "Social force model for pedestrian dynamics", Phys.
    Rev. E 51, 4282, with two changes: the ellipses of the repulsion depend on the
    relative velocity (Johansson, Helbing, Shukla 2007), and distances are between the
    surfaces of the discs (Helbing, Farkas, Vicsek 2000). The default speeds are the
    paper's 1.34 m/s, plus or minus one standard deviation of 0.26 m/s.
    """

    kind: Literal["pedestrian"] = "pedestrian"  # kind of motion
    # range of the desired speed, drawn per episode; the maximum limits any speed [m/s]
    speed: tuple[float, float] = (1.08, 1.6)
    # tau, relaxation time to the desired velocity [s]
    relaxation: float = Field(default=0.5, ge=0.1, le=10.0)
    repulsion: Strength = 2.1  # V0, for walkers, obstacles and robots [m^2/s^2]
    range: Range = 0.3  # sigma [m]
    wall_repulsion: Strength = 10.0  # U0 [m^2/s^2]
    wall_range: Range = 0.2  # R [m]
    # delta t, the time over which others' motion is extrapolated [s]
    foresight: Strength = 1.0
    # 2 phi, field of view [rad]
    view: float = Field(default=math.radians(200.0), ge=0.0, le=2.0 * math.pi)
    # c, weight of forces from outside the field of view
    behind: float = Field(default=0.5, ge=0.0, le=1.0)
    fluctuation: Strength = 0.1  # standard deviation of a random acceleration [m/s^2]

    @field_validator("speed")
    @classmethod
    def _check_speed(cls, speed: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 < speed[0] <= speed[1] <= FASTEST:
            raise ValueError(
                f"speed must be [minimum, maximum], above 0 and at most {FASTEST:g} m/s"
            )
        return speed


Motion = Annotated[Patrol | Pedestrian, Field(discriminator="kind")]


class Obstacles(Schema):
    """A group of obstacles with common properties."""

    # shapes; each obstacle has one of them, drawn at random
    shapes: tuple[Shape, ...] = Field(min_length=1, max_length=MOST_SHAPES)
    # number of obstacles, or [minimum, maximum] to draw from per episode
    count: int | tuple[int, int] | None = None
    gap: Distance = 0.0  # minimum free space to any other obstacle [m]
    # fixed poses, x, y [m], heading [rad], instead of `count` random ones
    at: tuple[Pose, ...] = ()
    # motion; by default the obstacles are static
    motion: Motion | None = None

    @field_validator("count", mode="before")
    @classmethod
    def _check_numbers(cls, count: object) -> object:
        several = count if isinstance(count, list | tuple) else (count, count)
        whole = len(several) == 2 and all(type(n) is int for n in several)
        if count is not None and not (
            whole and 0 <= several[0] <= several[1] <= MOST_OBSTACLES
        ):
            raise ValueError(
                f"count must be a whole number, or [minimum, maximum], from 0 to {MOST_OBSTACLES}"
            )
        return count

    @model_validator(mode="after")
    def _check_consistent(self) -> "Obstacles":
        if (self.count is None) == (not self.at):
            raise ValueError("a group needs either `count` or `at`")
        return self

    @property
    def counts(self) -> tuple[int, int]:
        """Minimum and maximum number of obstacles."""
        if self.count is None:
            return len(self.at), len(self.at)
        return (self.count, self.count) if isinstance(self.count, int) else self.count


class Places(Schema):
    """Places in regions, x1, y1, x2, y2 of opposite corners [m], or at poses or points."""

    # x1, y1, x2, y2 [m]
    regions: tuple[Region, ...] = Field(default=(), max_length=MOST_PLACES)
    at: tuple[Pose | Point, ...] = Field(default=(), max_length=MOST_PLACES)

    @model_validator(mode="after")
    def _check_one(self) -> "Places":
        if bool(self.regions) == bool(self.at):
            raise ValueError("give either `regions` or `at`")
        return self


class Starts(Places):
    """Places where robots start: any point of the regions, or one of the poses."""

    # x, y [m], heading [rad]
    at: tuple[Pose, ...] = Field(default=(), max_length=MOST_PLACES)


class Goals(Places):
    """Places of goals: any point of the regions, or one of the given points."""

    at: tuple[Point, ...] = Field(default=(), max_length=MOST_PLACES)  # x, y [m]


class World(Schema):
    """World of the episodes; everything is in the frame `map`."""

    name: str  # name by which users refer to the world
    # size along x, y of a walled field around the origin [m]
    size: tuple[Side, Side] | None = None
    bounds: Region | None = None  # or x1, y1, x2, y2 of a field without walls [m]
    # additional straight walls, x1, y1, x2, y2 [m]
    walls: tuple[Region, ...] = Field(default=(), max_length=MOST_WALLS)
    # static map in addition to or instead of a field: a shipped one, or a Nav2 map's
    # YAML file, relative to this file
    map: str | None = None
    obstacles: tuple[Obstacles, ...] = ()  # groups of obstacles, see `Obstacles`
    # free space around the footprint at start, goal, and on a path between them [m]
    clearance: Distance = 0.3
    # minimum and maximum straight distance from start to goal [m]
    goal_distance: tuple[Distance, Distance]
    starts: Starts | None = None  # where robots start; None: anywhere with enough space
    goals: Goals | None = None  # where goals lie; None: anywhere with enough space
    _file: str | None = PrivateAttr(default=None)
    _spare: tuple[Shape, ...] = PrivateAttr(default=())

    @model_validator(mode="after")
    def _check_consistent(self) -> "World":
        if self.size is None and self.bounds is None and self.map is None:
            raise ValueError("a world needs a `size`, `bounds`, or a `map`")
        if self.size is not None and self.bounds is not None:
            raise ValueError(
                "a field has either a `size` (with walls) or `bounds` (without "
                "walls), not both"
            )
        x1, y1, x2, y2 = self.bounds or (0.0, 0.0, 1.0, 1.0)
        if not all(SMALLEST_FIELD <= side <= LARGEST for side in (x2 - x1, y2 - y1)):
            raise ValueError(
                "bounds must be [minimum x, minimum y, maximum x, maximum y] in metres"
            )
        field = self.size or (x2 - x1, y2 - y1)
        across = math.hypot(*field)
        if across > MOST_ACROSS_M:
            fix = f"the maximum is {MOST_ACROSS_M:g} m, as for observed distances"
            raise ValueError(
                f"the field of {field[0]:g} m x {field[1]:g} m is {across:.0f} m across; {fix}"
            )
        if not 0.0 <= self.goal_distance[0] < self.goal_distance[1]:
            raise ValueError("goal_distance must be [minimum, maximum] in metres")
        if sum(group.counts[1] for group in self.obstacles) > MOST_OBSTACLES:
            raise ValueError(
                f"all groups together may have at most {MOST_OBSTACLES} obstacles"
            )
        return self

    @property
    def members(self) -> "tuple[World, ...]":
        """The world itself, like a set of one world."""
        return (self,)

    @property
    def spare(self) -> tuple[Shape, ...]:
        """Shapes of spare bodies, one each, which are in no drawn scene."""
        return self._spare

    def with_spare(self, shapes: tuple[Shape, ...]) -> "World":
        """Return the world with space reserved for additional bodies of some shapes."""
        copy = self.model_copy()
        copy._spare = shapes
        return copy

    @property
    def source(self) -> str:
        """Name of the world in error messages: its file, or its name."""
        return self._file or f"world {self.name!r}"

    @cached_property
    def grid(self) -> GridMap | None:
        """The static map. Raises ConfigError if its file is missing or invalid."""
        return None if self.map is None else load_map(self.map)

    @property
    def fingerprint(self) -> str:
        """The name and 8 digits of a SHA-256 of the content, including a map's."""
        absent = {"bounds"} if self.bounds is None else set()
        content = self.model_dump_json(exclude={"map", *absent}).encode()
        if self.grid is not None:
            about = repr(
                (self.grid.cells.shape, self.grid.resolution, self.grid.origin)
            )
            content += about.encode() + self.grid.cells.tobytes()
        return f"{self.name}-{hash_bytes(content)[:8]}"

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The distinct shapes of the obstacles."""
        return tuple(
            dict.fromkeys(shape for group in self.obstacles for shape in group.shapes)
        )

    @property
    def extent(self) -> Region:
        """Minimum x, y and maximum x, y of the field, or of the map if there is no field [m]."""
        if self.size is not None:
            x = self.size[0] / 2.0
            y = self.size[1] / 2.0
            return -x, -y, x, y
        if self.bounds is not None:
            return self.bounds
        if self.grid is None:
            raise ValueError("a world needs a `size`, `bounds`, or a `map`")
        rows, columns = self.grid.cells.shape
        corners = [(i - 0.5, j - 0.5) for i in (0, rows) for j in (0, columns)]
        points = self.grid.cell_to_world(corners)
        x1, y1 = points.min(axis=0).tolist()
        x2, y2 = points.max(axis=0).tolist()
        return x1, y1, x2, y2

    def all_walls(self) -> Array:
        """Return walls (W, 4) [m]: the sides of a walled field, then the others."""
        sides: list[Region] = []
        if self.size is not None:
            x, y = self.extent[2:]
            sides = [(-x, -y, x, -y), (x, -y, x, y), (x, y, -x, y), (-x, y, -x, -y)]
        return np.array([*sides, *self.walls], np.float64).reshape(-1, 4)


def plan_arrays(
    motions: Sequence[Motion | None],
) -> tuple[Records, Array]:
    """Return the plans (K,) of obstacles with these motions, and patrols' waypoints (Q, 2)."""
    plans = np.zeros(len(motions), PLAN)
    waypoints: list[Point] = []
    for plan, motion in zip(plans, motions, strict=True):
        if motion is None:
            continue
        values = motion.model_dump(exclude={"kind", "speed", "waypoints", "view"})
        plan["slowest"], plan["fastest"] = np.broadcast_to(motion.speed, 2)
        if isinstance(motion, Patrol):
            plan["kind"] = PATROL
            plan["first"] = len(waypoints)
            plan["count"] = len(motion.waypoints)
            waypoints += motion.waypoints
        else:
            plan["kind"] = PEDESTRIAN
            plan["cos_view"] = math.cos(motion.view / 2.0)
        for name, value in values.items():
            plan[name] = value
    return plans, np.reshape(waypoints, (-1, 2))


def load_world(name: str | Path, also: Iterable[str] = ()) -> World:
    """Load a shipped world or a YAML file; errors also suggest names in `also`."""
    path = find_config(name, "worlds", also)
    world = load_yaml(path, World)
    if world.map is not None and Path(world.map).suffix in (".yaml", ".yml"):
        world = world.model_copy(update={"map": str(path.parent / world.map)})
    world._file = str(path)
    _ = world.grid  # fail on an invalid map now, not in the first episode
    check_places(world)
    return world


def check_places(world: World) -> None:
    """Raise ConfigError for obstacles outside the world or waypoints without space."""
    for g, group in enumerate(world.obstacles):
        where = f"{world.source}: key 'obstacles.{g}"
        for n, pose in enumerate(group.at):
            if not _inside(world, *pose[:2]):
                raise ConfigError(
                    f"{where}.at.{n}': {list(pose)} is outside the world; move it."
                )
        radius = max(shape.radius for shape in group.shapes)
        waypoints = group.motion.waypoints if isinstance(group.motion, Patrol) else ()
        for n, point in enumerate(waypoints):
            if measure_clearance(world, *point) < radius:
                raise ConfigError(
                    f"{where}.motion.waypoints.{n}': an obstacle of radius {radius:g} m does not "
                    f"fit there, at {list(point)}; move it."
                )


class OutsideError(ConfigError):
    """A place lies outside the world."""


def check_inside(what: str, world: World, x: float, y: float) -> None:
    """Raise OutsideError for a place outside the world."""
    if not _inside(world, x, y):
        raise OutsideError(_describe_fault(what, world, x, y, "lies outside the world"))


def check_place(
    what: str,
    world: World,
    x: float,
    y: float,
    radius: float = 0.0,
) -> None:
    """Raise ConfigError for a place off the field, or within a radius [m] of a wall."""
    check_inside(what, world, x, y)
    solid = 0.0 if world.grid is None else world.grid.resolution  # in a full cell
    if measure_clearance(world, x, y) <= max(radius, solid):
        raise ConfigError(_describe_fault(what, world, x, y, "is in a wall"))


def _describe_fault(what: str, world: World, x: float, y: float, fault: str) -> str:
    x1, y1, x2, y2 = world.extent
    field = f"the field is {x1:g} to {x2:g} m by {y1:g} to {y2:g} m"
    return f"{what}: ({x:g}, {y:g}) m {fault}; {field}."


def _inside(world: World, x: float, y: float) -> bool:
    x1, y1, x2, y2 = world.extent
    return x1 <= x <= x2 and y1 <= y <= y2


def measure_clearance(world: World, x: float, y: float) -> float:
    """Free space around a point among walls and map [m], negative outside the world."""
    if not _inside(world, x, y):
        return -1.0
    room = wall_distance(x, y, world.all_walls())
    if world.grid is not None:
        i, j = world.grid.world_to_cell([x, y])
        rows, columns = world.grid.cells.shape
        if not (0 <= i < rows and 0 <= j < columns):
            return -1.0
        # Away from a cell's centre, the distance may be larger by at most the offset.
        room = min(room, float(world.grid.distance_field[i, j]) + world.grid.resolution)
    return float(room)
