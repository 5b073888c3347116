"""Drawn scenes: obstacles, and starts and goals in connected free space, per seed."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import ArrayLike
from pydantic import ValidationError

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.kernels import pack
from nics_drl_bridge.lidar.arrays import Array, Integers, Mask, ShortIntegers
from nics_drl_bridge.lidar.maps import OCCUPIED, GridMap
from nics_drl_bridge.lidar.shapes import (
    BODY,
    LARGEST,
    SMALLEST,
    Circle,
    Outlines,
    Shape,
    describe,
)
from nics_drl_bridge.seeds import check_seeds
from nics_drl_bridge.sim import scene_kernels as kernels
from nics_drl_bridge.sim.collision_kernels import body_cells
from nics_drl_bridge.sim.scene_kernels import FreeSpace, ScenePlan, SceneScratch
from nics_drl_bridge.sim.state import NO_FIELD, MapField, Records, allocate_touches
from nics_drl_bridge.sim.world import Goals, Motion, Starts, World, check_places
from nics_drl_bridge.sim.world_set import AnyWorld

CELL = 0.1  # Side of cells without a map [m], scaled with the size of the field
FEWEST_CELLS = 20
MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class Scene:
    """Scene of one seed in a world or a member of a world set."""

    bodies: Array  # (K, 7) obstacles, see `shapes.place`; shapes are of the sampler's `shapes`
    starts: Array  # (M, 3) pose of each robot
    goals: Array  # (M, 2) position of each goal [m]
    member: Any = 0  # index of its world in the world set


class Scenes(Scene):
    """Scenes of n seeds, as arrays (n, ...) of the fields of `Scene`; `scenes[i]` is one scene."""

    member: Integers

    def __len__(self) -> int:
        return len(self.bodies)

    def __getitem__(self, row: int) -> Scene:
        return Scene(
            self.bodies[row], self.starts[row], self.goals[row], int(self.member[row])
        )

    def __iter__(self) -> Iterator[Scene]:
        return (self[row] for row in range(len(self)))


@dataclass(frozen=True)
class Catalogue:
    """Data shared by the worlds of a set. Shapes are listed size by size."""

    shapes: tuple[Shape, ...]
    place: Mapping[Shape, int]  # index of each shape in the first size
    outlines: Outlines  # outlines of the shapes, and of a disc
    spaces: dict[str, FreeSpace]  # shared by worlds that differ only in their obstacles


class MemberSampler:
    """Draws scenes of one world of a set, see `SceneSampler`."""

    def __init__(
        self,
        world: World,
        footprint_radius: float,
        robots: int,
        most: int | None,
        catalogue: Catalogue,
    ) -> None:
        self.world = world = world if most is None else _with_room(world, most)
        self.robots = robots
        slots = [
            g for g, group in enumerate(world.obstacles) for _ in range(group.counts[1])
        ]
        self.count = len(slots)  # K, the maximum number of obstacles
        self.motions: tuple[Motion | None, ...] = tuple(
            world.obstacles[g].motion for g in slots
        )
        self.plan = _plan(world, footprint_radius, slots, catalogue)
        # Maximum number of cells and obstacles; each thread has its own scratch memory.
        self.room = self.plan.space.area.size, len(self.plan.group)
        self.scratches: list[SceneScratch] = []

    @cached_property
    def _packed(self) -> Any:
        return pack(self.plan)

    def __getstate__(self) -> dict[str, Any]:  # a copy rebuilds its packed plan
        return {name: value for name, value in vars(self).items() if name != "_packed"}

    def draw_into(
        self, scenes: Scenes, draws: tuple[Integers, Integers, Integers], rows: slice
    ) -> None:
        """Draw some rows of scenes of at least K obstacles.

        `draws` holds, for all rows, the seed, the number of random obstacles (-1 for
        the world's own number), and the index of their size.
        """
        try:
            scratch = self.scratches.pop()
        except IndexError:
            scratch = _allocate_scratch(*self.room)
        numbers, wanted, sizes = (values[rows] for values in draws)
        into = scenes.bodies[rows], scenes.starts[rows], scenes.goals[rows]
        drawn, why = kernels.draw_scenes(
            self._packed, numbers, wanted, sizes, *into, scratch
        )
        self.scratches.append(scratch)
        if drawn == len(numbers):
            return
        where = self.world.source
        scene = f"in the scene of seed {numbers[drawn]}"
        if why == kernels.NO_OBSTACLES:
            raise ConfigError(
                f"{where}: key 'obstacles': no free place for {self.count} obstacles {scene}; "
                "lower `count` or `gap`, or enlarge the field."
            )
        least, greatest = self.world.goal_distance
        raise ConfigError(
            f"{where}: key 'goal_distance': no free places for {self.robots} start(s) and goal(s) "
            f"of robots of radius {self.plan.footprint:g} m, {least:g} to {greatest:g} m apart "
            f"with a path between them, {self.count} obstacles, {scene}; change `goal_distance`, "
            "lower `clearance` or `obstacles`, or enlarge the field."
        )


def _allocate_scratch(cells: int, count: int) -> SceneScratch:
    """Allocate the memory to draw scenes of at most so many cells and obstacles."""
    return SceneScratch(
        np.zeros(1, kernels.DRAWS),
        np.zeros(cells, np.int64),
        np.zeros(cells, np.int64),
        np.zeros(1, np.int64),
        np.zeros(count, np.bool_),
        np.zeros(count),
        np.zeros(BODY),
        np.zeros(BODY),
        allocate_touches(),
        body_cells(1, count),
    )


class SceneSampler:
    """Draws scenes for M robots of a radius [m] in a world, or in the worlds of a set.

    A seed determines the world and the scene in it. Start and goal have the world's
    clearance and are connected by a path with that clearance among walls, map and
    static obstacles. Obstacles keep their gaps from each other, walls and map. `sizes`
    are factors that may scale them, and `most` is the largest number of random ones
    that may be requested. Raises ConfigError if a world has no free space for such a
    robot.
    """

    def __init__(
        self,
        world: AnyWorld,
        footprint_radius: float,
        robots: int = 1,
        sizes: Sequence[float] = (1.0,),
        most: int | None = None,
    ) -> None:
        shapes = tuple(scaled(shape, size) for size in sizes for shape in world.shapes)
        places = {shape: i for i, shape in enumerate(world.shapes)}
        outlines = Outlines.of((*shapes, Circle(radius=1.0)))
        catalogue = Catalogue(shapes, places, outlines, {})
        self.samplers = [
            MemberSampler(member, footprint_radius, robots, most, catalogue)
            for member in world.members
        ]
        cells, count = np.max([sampler.room for sampler in self.samplers], axis=0)
        for sampler in self.samplers:  # they share their scratch memory
            sampler.room = int(cells), int(count)
            sampler.scratches = self.samplers[0].scratches
        self.robots = robots
        self.count = int(count) + len(world.spare)
        # spare shapes come last
        self.shapes = (*catalogue.shapes, *world.spare)

    @property
    def motions(self) -> list[tuple[Motion | None, ...]]:
        """(P, K) the motions of all obstacles of each member."""
        padded: list[tuple[Motion | None, ...]] = []
        for sampler in self.samplers:
            absent = self.count - len(sampler.motions)
            padded.append((*sampler.motions, *(None,) * absent))
        return padded

    def draw(
        self,
        seeds: ArrayLike,
        count: ArrayLike | None = None,
        size: ArrayLike | None = None,
    ) -> Scenes:
        """Draw the scenes of seeds (n,), identical in every process and batch.

        `count` (n,) is the number of random obstacles: by default, and at most, that of
        the world. `size` (n,) is the index of their size. K is the maximum of all
        worlds. Raises ConfigError if a scene does not fit into a world.
        """
        numbers = check_seeds(seeds)
        n = len(numbers)
        wanted = np.full(n, -1) if count is None else np.maximum(count, 0)
        sizes = np.zeros(n, np.int64) if size is None else np.asarray(size)
        draws = numbers, wanted, sizes
        scenes = Scenes(
            np.zeros((n, self.count, BODY)),
            np.zeros((n, self.robots, 3)),
            np.zeros((n, self.robots, 2)),
            np.zeros(n, np.int64),
        )
        if len(self.samplers) == 1:
            self.samplers[0].draw_into(scenes, draws, slice(0, len(scenes)))
            return scenes
        kernels.choose_members(numbers, len(self.samplers), scenes.member)
        for row, p in enumerate(scenes.member.tolist()):
            self.samplers[p].draw_into(scenes, draws, slice(row, row + 1))
        return scenes


def member_of(world: AnyWorld, seed: int) -> int:
    """Return the index of the world in which the scene of a seed takes place."""
    chosen = np.zeros(1, np.int64)
    kernels.choose_members(check_seeds(seed), len(world.members), chosen)
    return int(chosen[0])


def sample_scene(
    world: AnyWorld, footprint: float, seed: int, robots: int = 1
) -> Scene:
    """Draw the scene of a seed for M robots of a radius [m]; identical in every process."""
    return _sampler(world, footprint, robots).draw([seed])[0]


_sampler = lru_cache(maxsize=16)(SceneSampler)


def scaled(shape: Shape, factor: float) -> Shape:
    """Return a shape scaled by a factor."""
    if factor == 1.0:
        return shape
    lengths = ("radius", "size", "ends", "points")
    larger = {k: (np.array(v) * factor).tolist() for k, v in shape if k in lengths}
    try:
        return type(shape).model_validate(shape.model_dump() | larger)
    except ValidationError:
        raise ConfigError(
            f"the {describe(shape)}, {factor:g} times as large, is beyond {SMALLEST:g} m to "
            f"{LARGEST:g} m; narrow the factors of its size."
        ) from None


def _with_room(world: World, most: int) -> World:
    at_random = [group for group in world.obstacles if not group.at]
    if most and not at_random:
        raise ConfigError(
            f"{world.source}: key 'obstacles': the randomisation draws up to {most}, "
            "but no group has a `count`; add one, or remove `obstacles.count` from "
            "the randomisation."
        )
    total = sum(group.counts[1] for group in at_random)
    if total >= most:
        return world
    groups = []
    for group in world.obstacles:
        share = group.counts[1] / total if total else 1.0 / len(at_random)
        count = group.counts[0], math.ceil(share * most)
        groups.append(group if group.at else group.model_copy(update={"count": count}))
    return world.model_copy(update={"obstacles": tuple(groups)})


def _plan(
    world: World, footprint: float, slots: Sequence[int], catalogue: Catalogue
) -> ScenePlan:
    check_places(world)
    drawn = any(group.count for group in world.obstacles)
    alike = f"{drawn} {world.model_dump_json(exclude={'name', 'obstacles'})}"
    if alike not in catalogue.spaces:
        catalogue.spaces[alike] = _free_space(world, footprint, drawn)
    space = catalogue.spaces[alike]
    groups, choices = _tabulate_groups(world, catalogue)
    poses = np.zeros((len(slots), 3))
    for g, group in enumerate(world.obstacles):
        if group.at:
            poses[np.flatnonzero(np.equal(slots, g))] = group.at
    least, greatest = world.goal_distance
    ring = math.pi * (greatest * greatest - least * least)
    around = world.goals is None and ring < len(space.for_robots) * space.cells.cell**2
    return ScenePlan(
        space,
        catalogue.outlines.arguments,
        catalogue.outlines.radii,
        groups,
        np.array(slots, np.int64),
        choices,
        np.arange(len(catalogue.shapes)).reshape(-1, max(len(catalogue.place), 1)),
        poses,
        _places(world.starts),
        _places(world.goals),
        float(footprint),
        world.clearance,
        least,
        greatest,
        around,
    )


def _tabulate_groups(world: World, catalogue: Catalogue) -> tuple[Records, Integers]:
    """Return the groups (G,) of `kernels.GROUP`, and the shapes of one after the other."""
    groups = np.zeros(len(world.obstacles), kernels.GROUP)
    choices: list[int] = []
    for g, group in enumerate(world.obstacles):
        groups[g] = (
            *group.counts,
            group.gap,
            len(choices),
            len(group.shapes),
            bool(group.at),
            group.motion is not None,
        )
        choices += [catalogue.place[shape] for shape in group.shapes]
    return groups, np.array(choices, np.int64)


def _places(places: Starts | Goals | None) -> Records:
    if places is None:
        return np.zeros(0, kernels.PLACE)
    rows = [(*at[:2], *at[:2], *(at[2:] or (0.0,)) * 2, 0.0) for at in places.at]
    for x1, y1, x2, y2 in places.regions:
        low = min(x1, x2), min(y1, y2)
        rows.append((*low, max(x1, x2), max(y1, y2), -math.pi, math.pi, 0.0))
    array = np.array(rows, kernels.PLACE)
    sizes = (array["x2"] - array["x1"]) * (array["y2"] - array["y1"])
    shares = sizes if sizes.all() else np.ones(len(rows))
    array["share"] = np.cumsum(shares) / shares.sum()
    return array


def _free_space(world: World, footprint: float, drawn: bool) -> FreeSpace:
    grid = NO_FIELD if world.grid is None else _closed(world.grid)
    cells = _cells_of(world) if world.grid is None else grid
    cells = cells._replace(distances=np.array(cells.distances, order="C"))
    walls = world.all_walls()
    kernels.wall_distances(cells, walls)
    bounds = np.array([-np.inf, -np.inf, np.inf, np.inf])
    if world.size is not None or world.bounds is not None:
        bounds = np.array(world.extent)
        cells.distances[~_find_inside(bounds, *_centres(cells))] = 0.0
    # Between two cell centres the path may be closer to a corner than at either end.
    room = math.hypot(footprint + world.clearance, cells.cell / 2.0)
    area = _find_areas(world, footprint, cells, room)
    for key, places in (("starts", world.starts), ("goals", world.goals)):
        _check(world, key, places, area, cells)
    for_robots = anywhere = np.zeros(0, np.int32)
    if world.starts is None or world.goals is None:
        for_robots = np.flatnonzero(area).astype(np.int32)
    if drawn:
        anywhere = np.flatnonzero(cells.distances > 0.0).astype(np.int32)
    return FreeSpace(cells, area, bounds, walls, grid, for_robots, anywhere, room)


def _find_inside(bounds: Array, x: Array, y: Array) -> Mask:
    """Return True for points inside of bounds, not on them."""
    inside = (x > bounds[0]) & (x < bounds[2]) & (y > bounds[1]) & (y < bounds[3])
    return np.asarray(inside)


def _find_areas(
    world: World, footprint: float, cells: MapField, room: float
) -> ShortIntegers:
    """Number the connected cells with a clearance of `room` [m], where goals are far enough.

    Raises ConfigError if there are none.
    """
    robot = f"a robot of radius {footprint:g} m with {world.clearance:g} m around it"
    least = world.goal_distance[0]
    area, _ = scipy.ndimage.label(cells.distances >= room)
    if not area.any():
        raise ConfigError(
            f"{world.source}: key 'clearance': no free space for {robot}; lower `clearance`, "
            "or enlarge the world."
        )
    area = _large_enough(area, cells.cell, least)
    if not area.any():
        raise ConfigError(
            f"{world.source}: key 'goal_distance': {robot} can't reach any goal {least:g} m "
            "away; lower `goal_distance` or `clearance`, or enlarge the world."
        )
    return area


def _closed(grid: GridMap) -> MapField:
    """Return a map with a border; unknown cells and the outside count as occupied."""
    closed = np.pad(grid.cells, 1, constant_values=OCCUPIED)
    x, y = grid.cell_to_world([-1.5, -1.5]).tolist()
    heading = grid.origin[2]
    whole = GridMap(closed, grid.resolution, (x, y, heading), unknown_stops=True)
    distances = whole.distance_field
    cosine = math.cos(heading)
    sine = math.sin(heading)
    return MapField(
        np.ascontiguousarray(distances), x, y, cosine, sine, float(grid.resolution)
    )


def _cells_of(world: World) -> MapField:
    x1, y1, x2, y2 = world.extent
    size = min(CELL, min(x2 - x1, y2 - y1) / FEWEST_CELLS)
    size = max(size, math.sqrt((x2 - x1) * (y2 - y1) / MOST_CELLS))
    shape = max(1, math.ceil((y2 - y1) / size)), max(1, math.ceil((x2 - x1) / size))
    return MapField(np.full(shape, np.inf, np.float32), x1, y1, 1.0, 0.0, size)


def _centres(cells: MapField) -> Array:
    rows, columns = np.indices(cells.distances.shape) + 0.5
    return np.array(kernels.place_in.py_func(rows, columns, cells))  # type: ignore[attr-defined]


def _large_enough(area: ShortIntegers, cell: float, least: float) -> ShortIntegers:
    keep = [0]
    for number, parts in enumerate(scipy.ndimage.find_objects(area), 1):
        span = cell * math.hypot(*(part.stop - part.start for part in parts))
        keep.append(number if span >= least else 0)
    return np.array(keep, np.int32)[area]


def _check(
    world: World,
    key: str,
    places: Starts | Goals | None,
    area: ShortIntegers,
    cells: MapField,
) -> None:
    for place, value, fits in [] if places is None else _judge(places, area, cells):
        if not fits:
            robot = f"a robot with {world.clearance:g} m around it does not fit there, at {value}"
            raise ConfigError(
                f"{world.source}: key '{key}.{place}': {robot}; move it, or lower `clearance`."
            )


def _judge(
    places: Starts | Goals, area: ShortIntegers, cells: MapField
) -> Iterator[tuple[str, list[float], bool]]:
    """Yield the key and value of each region or pose, and whether a robot fits there."""
    x, y = _centres(cells)[:, area > 0]
    for number, (x1, y1, x2, y2) in enumerate(places.regions):
        fits = _is_between(x, x1, x2) & _is_between(y, y1, y2)
        yield f"regions.{number}", [x1, y1, x2, y2], bool(fits.any())
    for number, at in enumerate(places.at):
        i, j, _ = kernels.cell_of(at[0], at[1], cells)
        inside = 0 <= i < area.shape[0] and 0 <= j < area.shape[1]
        yield f"at.{number}", list(at), inside and bool(area[i, j])


def _is_between(values: Array, end: float, other_end: float) -> Mask:
    low = min(end, other_end)
    high = max(end, other_end)
    return np.asarray((values >= low) & (values <= high))
