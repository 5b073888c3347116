"""Scenes drawn from worlds: obstacles, starts and goals of each seed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.shapes import (
    BODY,
    LARGEST,
    SMALLEST,
    Circle,
    Outlines,
    Polygon,
    Rectangle,
    Segment,
    Shape,
    describe,
)
from nics_drl_bridge.seeds import checked_seeds
from nics_drl_bridge.sim import scene_kernels as kernels
from nics_drl_bridge.sim.free_space import Areas, areas_of
from nics_drl_bridge.sim.obstacles import Motion
from nics_drl_bridge.sim.world import Goals, Starts, World

__all__ = ["Scene", "SceneSampler", "Scenes", "sample_scene", "scaled"]

Array = NDArray[np.float64]
Search = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class Scene:
    """Scene of one seed in a world.

    Attributes:
        bodies: (K, 7) obstacles as in `lidar.shapes.BODY`; the index of the shape is that in
            `SceneSampler.shapes`, the radius is 0 for an absent obstacle.
        starts: (M, 3) pose of each robot.
        goals: (M, 2) position of each goal [m].
    """

    bodies: Array
    starts: Array
    goals: Array


@dataclass(frozen=True)
class Scenes:
    """Scenes of n seeds in a world; `scenes[i]` is the Scene of one.

    Attributes:
        bodies: (n, K, 7) see `Scene`.
        starts: (n, M, 3).
        goals: (n, M, 2).
    """

    bodies: Array
    starts: Array
    goals: Array

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.bodies)

    def __getitem__(self, row: int) -> Scene:
        """Returns one scene."""
        return Scene(self.bodies[row], self.starts[row], self.goals[row])

    def __iter__(self) -> Iterator[Scene]:
        """Iterates over the scenes."""
        return (self[row] for row in range(len(self)))


class SceneSampler:
    """Draws scenes of a world.

    A start and its goal are free, with the clearance of the world around the robot, and a robot
    that keeps this clearance can move from one to the other among walls, map and all static
    obstacles. Obstacles overlap neither each other nor walls nor map, and keep their gaps.

    Args:
        world: the field, its map and its obstacles.
        footprint_radius: of a robot [m].
        robots: M.
        sizes: factors by which obstacles may be scaled.
        most: greatest number of random obstacles that may be requested from `draw`, if more than
            the world has.

    Attributes:
        shapes: every shape that can occur: those of the world in the first size, then in the next.
        count: K, the greatest number of obstacles.
        motions: (K) motion of each obstacle, None if it stands still; obstacle k belongs to the
            same group in every scene.

    Raises:
        ConfigError: the world has no free space for such a robot.
    """

    def __init__(
        self,
        world: World,
        footprint_radius: float,
        robots: int = 1,
        sizes: Sequence[float] = (1.0,),
        most: int | None = None,
    ) -> None:
        world = world if most is None else _with_room(world, most)
        self.world, self.robots = world, robots
        self.shapes = tuple(scaled(shape, size) for size in sizes for shape in world.shapes)
        self._sizes = len(sizes)
        slots = [g for g, group in enumerate(world.obstacles) for _ in range(group.counts[1])]
        self.count = len(slots)
        self.motions: tuple[Motion | None, ...] = tuple(world.obstacles[g].motion for g in slots)
        outlines = Outlines.of((*self.shapes, Circle(radius=1.0)))
        self._outlines = (*outlines.arguments, outlines.radii)
        areas = areas_of(world, footprint_radius)
        self._static = areas.static
        self._rules = _rules(world, footprint_radius, areas)
        self._where = (
            _places(world.starts), _places(world.goals), areas.for_robots, areas.for_anything,
        )  # fmt: skip
        self._plan = _plan(world, slots, len(sizes))
        self._footprint = footprint_radius
        self._searches: list[Search] = []

    def draw(
        self,
        seeds: ArrayLike,
        count: ArrayLike | None = None,
        size: ArrayLike | None = None,
    ) -> Scenes:
        """Draws the scenes of seeds; identical in every process and batch.

        Args:
            seeds: (n,).
            count: (n,) number of random obstacles of each scene, at most as many as the world
                allows; by default that of the world.
            size: (n,) index of the size of all obstacles of a scene; the first by default.

        Raises:
            ConfigError: a seed is out of range, or the world has no room for a scene.
        """
        numbers = checked_seeds(seeds)
        n = len(numbers)
        wanted = np.full(n, -1) if count is None else np.maximum(np.asarray(count), 0)
        sizes = np.zeros(n, np.int64) if size is None else np.asarray(size, dtype=np.int64)
        if wanted.shape != (n,) or sizes.shape != (n,):
            raise ConfigError(f"count {wanted.shape} and size {sizes.shape} must be ({n},).")
        if n and not 0 <= sizes.min() <= sizes.max() < self._sizes:
            raise ConfigError(f"size must be from 0 to {self._sizes - 1}.")
        scenes = Scenes(
            np.zeros((n, self.count, BODY)),
            np.zeros((n, self.robots, 3)),
            np.zeros((n, self.robots, 2)),
        )
        search = self._search()
        row, why = kernels.draw_scenes(
            numbers, wanted.astype(np.int64), sizes, self._plan, self._static, self._outlines,
            self._rules, self._where, scenes.bodies, scenes.starts, scenes.goals, search,
        )  # fmt: skip
        self._searches.append(search)
        if row < n:
            raise ConfigError(self._no_room(int(numbers[row]), why))
        return scenes

    def _search(self) -> Search:
        """Returns scratch memory for one call; threads may draw at the same time."""
        try:
            return self._searches.pop()
        except IndexError:
            cells = self._static[1].size
            return (
                np.zeros(cells, np.int64), np.zeros((2, cells), np.int64), np.zeros(1, np.int64),
            )  # fmt: skip

    def _no_room(self, seed: int, why: int) -> str:
        world = self.world
        if why == kernels.NO_OBSTACLES:
            return (
                f"{world.source}: key 'obstacles': no free place for {self.count} obstacles in "
                f"the scene of seed {seed}; lower `count` or `gap`, or enlarge `size`."
            )
        others = f" among {self.count} obstacles" if self.count else ""
        return (
            f"{world.source}: key 'goal_distance': no free places for {self.robots} start(s) and "
            f"goal(s) of robots of radius {self._footprint:g} m, {world.goal_distance[0]:g} to "
            f"{world.goal_distance[1]:g} m apart with a way between{others}, in the scene of seed "
            f"{seed}; change `goal_distance`, lower `clearance` or `obstacles`, or enlarge `size`."
        )


def sample_scene(world: World, footprint: float, seed: int, robots: int = 1) -> Scene:
    """Draws the scene of a seed; identical in every process.

    Args:
        world: the field, its map and its obstacles.
        footprint: radius of a robot [m].
        seed: of the episode.
        robots: M.

    Raises:
        ConfigError: the world has no room for it.
    """
    return _sampler(world, footprint, robots).draw([seed])[0]


@lru_cache(maxsize=16)
def _sampler(world: World, footprint: float, robots: int) -> SceneSampler:
    return SceneSampler(world, footprint, robots)


def scaled(shape: Shape, factor: float) -> Shape:
    """Returns a shape scaled by a factor."""
    if factor == 1.0:
        return shape
    try:
        return _scaled(shape, factor)
    except ValidationError:
        raise ConfigError(
            f"the {describe(shape)}, {factor:g} times as large, is beyond {SMALLEST:g} m to "
            f"{LARGEST:g} m; narrow the factors of its size."
        ) from None


def _scaled(shape: Shape, factor: float) -> Shape:
    if isinstance(shape, Circle):
        return Circle(radius=shape.radius * factor)
    if isinstance(shape, Rectangle):
        return Rectangle(size=(shape.size[0] * factor, shape.size[1] * factor))
    if isinstance(shape, Segment):
        (x1, y1), (x2, y2) = shape.ends
        return Segment(ends=((x1 * factor, y1 * factor), (x2 * factor, y2 * factor)))
    return Polygon(points=tuple((x * factor, y * factor) for x, y in shape.points))


def _with_room(world: World, most: int) -> World:
    """Returns the world with `most` random obstacles, distributed over groups as in the world."""
    at_random = [group for group in world.obstacles if not group.at]
    if most and not at_random:
        raise ConfigError(
            f"{world.source}: key 'obstacles': the randomisation draws up to {most}, but no group "
            "has a `count`; add one, or leave `obstacles.count` out of the randomisation."
        )
    total = sum(group.counts[1] for group in at_random)
    if total >= most:
        return world
    groups = list(world.obstacles)
    for g, group in enumerate(groups):
        if not group.at:
            share = group.counts[1] / total if total else 1.0 / len(at_random)
            count = group.counts[0], math.ceil(share * most)
            groups[g] = group.model_copy(update={"count": count})
    return world.model_copy(update={"obstacles": tuple(groups)})


def _rules(world: World, footprint: float, areas: Areas) -> tuple[float, ...]:
    """Returns the argument `rules` of `scene_kernels.draw_scenes`."""
    least, greatest = world.goal_distance
    cell = areas.static[2][4]
    ring = math.pi * (greatest * greatest - least * least)
    around = world.goals is None and ring < len(areas.for_robots) * cell * cell
    return footprint, world.clearance, least, greatest, areas.room, float(around)


def _places(places: Starts | Goals | None) -> Array:
    """Returns the places (P, 7), see `scene_kernels.draw_scenes`."""
    if places is None:
        return np.zeros((0, 7))
    rows = np.zeros((len(places.at) + len(places.regions), 7))
    for row, at in zip(rows, places.at, strict=False):
        row[:2], row[2:4], row[4:6] = at[:2], at[:2], at[2] if len(at) > 2 else 0.0
    for row, (x1, y1, x2, y2) in zip(rows, places.regions, strict=False):
        row[:6] = min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2), -math.pi, math.pi
    sizes = (rows[:, 2] - rows[:, 0]) * (rows[:, 3] - rows[:, 1])
    shares = sizes if sizes.all() else np.ones(len(rows))
    rows[:, 6] = np.cumsum(shares) / shares.sum()
    return rows


def _plan(world: World, slots: Sequence[int], sizes: int) -> tuple[Any, ...]:
    """Returns the argument `plan` of `scene_kernels.draw_scenes`."""
    groups = np.zeros((len(world.obstacles), 7))
    base: list[int] = []
    poses = np.zeros((len(slots), 3))
    for g, group in enumerate(world.obstacles):
        fixed, moving = float(bool(group.at)), float(group.motion is not None)
        groups[g] = *group.counts, group.gap, len(base), len(group.shapes), fixed, moving
        base += [world.shapes.index(shape) for shape in group.shapes]
        if group.at:
            poses[np.flatnonzero(np.equal(slots, g))] = group.at
    index = np.arange(sizes * len(world.shapes)).reshape(sizes, -1)
    slot, taken = np.array(slots, dtype=np.int64), np.array(base, dtype=np.int64)
    return groups, slot, taken, index, poses
