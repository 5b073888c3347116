"""World files, and the scenes that are drawn from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.config import Schema, find_config, load_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import sha256
from nics_drl_bridge.lidar.maps_grid import GridMap
from nics_drl_bridge.lidar.shapes import Circle, Shape

Array = NDArray[np.float64]
TRIES = 2000
RESTARTS = 50
GREATEST_SEED = 2**63 - 1


class Obstacles(Schema):
    """Round obstacles, placed at random.

    Attributes:
        count: how many.
        radii: each obstacle takes one of them [m].
        gap: free space between two of them [m].
    """

    count: int = Field(ge=0, le=10_000)
    radii: tuple[float, ...] = Field(min_length=1)
    gap: float = Field(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _positive(self) -> Obstacles:
        if min(self.radii) <= 0.0:
            raise ValueError("radii must be greater than 0")
        return self


class World(Schema):
    """Where episodes take place: a walled field around the origin of `map`.

    Attributes:
        name: what users call it.
        size: width along x and depth along y [m].
        walls: further straight walls, x1, y1, x2, y2 [m].
        obstacles: see `Obstacles`.
        clearance: free space around the footprint at start and goal [m].
        goal_distance: least and greatest distance from start to goal [m].
    """

    name: str
    size: tuple[float, float]
    walls: tuple[tuple[float, float, float, float], ...] = ()
    obstacles: Obstacles
    clearance: float = Field(default=0.3, ge=0.0)
    goal_distance: tuple[float, float]

    @model_validator(mode="after")
    def _consistent(self) -> World:
        if min(self.size) <= 0.0:
            raise ValueError("size must be greater than 0")
        if not 0.0 <= self.goal_distance[0] < self.goal_distance[1]:
            raise ValueError("goal_distance must be [least, greatest] in metres")
        return self

    @property
    def fingerprint(self) -> str:
        """Tells two worlds apart: the name, and the first 8 digits of a SHA-256 over all of it."""
        return f"{self.name}-{sha256(self.model_dump_json().encode())[:8]}"

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Every shape that an obstacle may have."""
        return tuple(Circle(radius=radius) for radius in self.obstacles.radii)

    @property
    def grid(self) -> GridMap | None:
        """The static map that stands in the field, if any."""
        return None

    def all_walls(self) -> Array:
        """(W, 4) the four sides of the field, then the further walls [m]."""
        x, y = self.size[0] / 2.0, self.size[1] / 2.0
        sides = [(-x, -y, x, -y), (x, -y, x, y), (x, y, -x, y), (-x, y, -x, -y)]
        return np.array([*sides, *self.walls], dtype=np.float64)


@dataclass(frozen=True)
class Scene:
    """What one seed gives in a world.

    Attributes:
        circles: (K, 3) x, y, radius of each obstacle [m].
        starts: (M, 3) pose of each robot.
        goals: (M, 2) position of each goal [m].
    """

    circles: Array
    starts: Array
    goals: Array


def load_world(name: str) -> World:
    """Loads a shipped world by name (`arena`), or any by the path of its YAML file."""
    return load_yaml(find_config(name, "worlds"), World)


def sample_scene(world: World, footprint: float, seed: int, robots: int = 1) -> Scene:
    """Draws the scene that belongs to a seed; the same in every process.

    Args:
        world: where.
        footprint: radius of a robot [m].
        seed: of the episode.
        robots: M.

    Raises:
        ConfigError: the world has no room for it.
    """
    if not 0 <= seed <= GREATEST_SEED:
        raise ConfigError(f"seed {seed}: must be a whole number from 0 to {GREATEST_SEED}.")
    circles = np.zeros((world.obstacles.count, 3))
    starts, goals = np.zeros((robots, 3)), np.zeros((robots, 2))
    half = np.array(world.size) / 2.0
    space = np.array([footprint, world.clearance, *world.goal_distance, world.obstacles.gap])
    radii = np.array(world.obstacles.radii)
    if not _draw(seed, half, space, radii, world.all_walls(), circles, starts, goals):
        raise ConfigError(
            f"world {world.name!r}: no free place for {world.obstacles.count} obstacles, a start "
            f"and a goal of a robot of radius {footprint} m on {world.size[0]} x {world.size[1]} "
            "m; enlarge `size`, or lower `obstacles.count`, `obstacles.gap` or `clearance`."
        )
    return Scene(circles, starts, goals)


@njit(cache=True)
def wall_distance(x, y, walls):  # type: ignore[no-untyped-def]
    """Distance from a point to the nearest straight wall (W, 4); inf when there is none."""
    least = np.inf
    for w in range(walls.shape[0]):
        ax, ay = walls[w, 0], walls[w, 1]
        ex, ey = walls[w, 2] - ax, walls[w, 3] - ay
        length2 = ex * ex + ey * ey
        share = 0.0
        if length2 > 0.0:
            share = min(max(((x - ax) * ex + (y - ay) * ey) / length2, 0.0), 1.0)
        least = min(least, np.hypot(x - ax - share * ex, y - ay - share * ey))
    return least


@njit(cache=True)
def _free(x, y, room, circles, count, walls):  # type: ignore[no-untyped-def]
    """Whether a disc of radius `room` at (x, y) touches no wall and none of `count` circles."""
    if wall_distance(x, y, walls) < room:
        return False
    for k in range(count):
        if np.hypot(x - circles[k, 0], y - circles[k, 1]) < room + circles[k, 2]:
            return False
    return True


@njit(cache=True)
def _draw(seed, half, space, radii, walls, circles, starts, goals):  # type: ignore[no-untyped-def]
    """Fills a scene, starting anew when it got stuck; False when the world is too full."""
    counter = 0
    for _ in range(RESTARTS):
        counter, placed = _place_circles(seed, counter, half, space, radii, walls, circles)
        if placed:
            counter, placed = _place_robots(
                seed, counter, half, space, walls, circles, starts, goals
            )
        if placed:
            return True
    return False


@njit(cache=True)
def _point(seed, counter, half):  # type: ignore[no-untyped-def]
    x = (2.0 * random.uniform(seed, random.SCENE_STREAM, counter) - 1.0) * half[0]
    y = (2.0 * random.uniform(seed, random.SCENE_STREAM, counter + 1) - 1.0) * half[1]
    return x, y


@njit(cache=True)
def _place_circles(seed, counter, half, space, radii, walls, circles):  # type: ignore[no-untyped-def]
    for k in range(circles.shape[0]):
        placed = False
        for _ in range(TRIES):
            x, y = _point(seed, counter, half)
            radius = radii[int(random.uniform(seed, random.SCENE_STREAM, counter + 2) * len(radii))]
            counter += 3
            if wall_distance(x, y, walls) > radius and _free(
                x, y, radius + space[4], circles, k, walls[:0]
            ):
                circles[k] = x, y, radius
                placed = True
                break
        if not placed:
            return counter, False
    return counter, True


@njit(cache=True)
def _place_robots(seed, counter, half, space, walls, circles, starts, goals):  # type: ignore[no-untyped-def]
    room = space[0] + space[1]
    count = circles.shape[0]
    for m in range(starts.shape[0]):
        placed = False
        for _ in range(TRIES):
            x, y = _point(seed, counter, half)
            gx, gy = _point(seed, counter + 2, half)
            heading = (2.0 * random.uniform(seed, random.SCENE_STREAM, counter + 4) - 1.0) * np.pi
            counter += 5
            distance = np.hypot(gx - x, gy - y)
            if not space[2] <= distance <= space[3]:
                continue
            if not (
                _free(x, y, room, circles, count, walls)
                and _free(gx, gy, room, circles, count, walls)
            ):
                continue
            apart = True
            for other in range(m):
                near_start = np.hypot(x - starts[other, 0], y - starts[other, 1])
                near_goal = np.hypot(gx - goals[other, 0], gy - goals[other, 1])
                apart = apart and min(near_start, near_goal) > 2.0 * space[0] + space[1]
            if apart:
                starts[m] = x, y, heading
                goals[m] = gx, gy
                placed = True
                break
        if not placed:
            return counter, False
    return counter, True
