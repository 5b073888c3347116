"""Allocation of worlds for the kernels: state, surroundings and scratch memory."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.maps import GridMap, joined, stack_fixtures
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import BODY
from nics_drl_bridge.robot.kernels import SERIES, allocate_scratch, make_terms
from nics_drl_bridge.sim import state as records
from nics_drl_bridge.sim.collision_kernels import body_cells
from nics_drl_bridge.sim.contact_kernels import SEVERAL
from nics_drl_bridge.sim.world import Motion, World, plan_arrays

SLICES = 16  # Number of groups of beams in which a skewed scan is rendered
LANES = 256  # Number of robots moved side by side: their arrays stay in the L1 cache
# Minimum number of pairs of a robot and a body for sorting bodies into cells
CROWD = 4096
# Minimum number of robots: for fewer, testing all bodies takes less time
FEWEST_OF_A_CROWD = 8
STANDING = 32  # Minimum number of obstacles for sorting them into cells once, if all of them stand


# Limits of a simulation: robots in one world, each of which is tested against every other, and
# numbers in the arrays of all worlds, some GB.
MOST_ROBOTS = 1_000
MOST_NUMBERS = 2**30
# Numbers of a robot or an obstacle whose count depends on neither beams, history nor past [1]
NUMBERS_PER_BODY = 64


@dataclass(frozen=True)
class Sizes:
    """Dimensions of a simulation."""

    worlds: int  # N
    robots: int  # M in each
    obstacles: int  # K in each
    longest_delay: int  # maximum common latency of commands [substeps]
    longest_age: int  # maximum age of an observation [substeps]

    @property
    def crowded(self) -> bool:
        """True if sorting the bodies of a world into cells pays off."""
        pairs = self.robots * (self.robots + self.obstacles)
        return self.robots >= FEWEST_OF_A_CROWD and pairs >= CROWD

    def count_past_rows(self, model: SimulatorModel) -> int:
        """Return R: a row for the newest period, and one for each that an observation may lag."""
        return count_periods(self.longest_age, model) + 1

    def count_history_rows(self, model: SimulatorModel) -> int:
        """Return H: a row for the newest command, and one for each period it may be delayed."""
        own_delays = make_terms(model.kinematics).late
        longest = self.longest_delay + int(own_delays.max(initial=0))
        return count_periods(longest, model) + 1


def count_periods(substeps: int, model: SimulatorModel) -> int:
    """Return the number of control periods that so many substeps begin."""
    return -(-substeps // model.timing.substeps)


def check_robots(robots: int, source: str) -> None:
    """Raise ConfigError for more robots than a world may have."""
    if robots > MOST_ROBOTS:
        raise ConfigError(
            f"{source} with {robots:.10g} robots: a world may have {MOST_ROBOTS} robots."
        )


def check_memory(model: SimulatorModel, sizes: Sizes, source: str) -> None:
    """Raise ConfigError, before anything is allocated, for more worlds than fit in memory."""
    per_robot = (
        model.lidar.beams
        + NUMBERS_PER_BODY
        + sizes.count_past_rows(model) * records.PAST_COLUMNS
        + sizes.count_history_rows(model) * len(model.robot.command)
    )
    per_world = sizes.robots * per_robot + sizes.obstacles * NUMBERS_PER_BODY
    if sizes.worlds * per_world <= MOST_NUMBERS:
        return
    raise ConfigError(
        f"{sizes.worlds:.10g} copies of {source} with {sizes.robots} robots, {sizes.obstacles} "
        f"obstacles, delays of {sizes.longest_delay} and ages of {sizes.longest_age} substeps: "
        f"{MOST_NUMBERS // per_world} copies of it are the most that fit in memory."
    )


def allocate_state(model: SimulatorModel, sizes: Sizes) -> records.State:
    """Allocate the arrays of worlds before their first reset, with the model's parameters."""
    shape = (sizes.worlds, sizes.robots)
    bodies = sizes.obstacles + sizes.robots
    noise = [*model.noise.odometry, *model.noise.simulated_drift(model.robot)]
    terms = make_terms(model.kinematics)
    history = (*shape, sizes.count_history_rows(model), len(model.robot.command))
    past = (*shape, sizes.count_past_rows(model), records.PAST_COLUMNS)
    return records.State(
        pose=np.zeros((*shape, 3)),
        state=np.zeros((*shape, len(model.robot.state))),
        history=np.zeros(history),
        bodies=np.zeros((sizes.worlds, bodies, BODY)),
        odom=np.zeros((*shape, 3)),
        twist=np.zeros((*shape, 3)),
        ranges=np.full((*shape, model.lidar.beams), np.inf, np.float32),
        collided=np.zeros(shape, np.uint8),
        steps=np.zeros(sizes.worlds, np.int64),
        seeds=np.zeros(sizes.worlds, np.int64),
        member=np.zeros(sizes.worlds, np.int64),
        faults=np.tile(model.lidar.fault_parameters, (*shape, 1)),
        coefficient=np.tile(terms.coefficient, (*shape, 1)),
        delay=np.full(shape, model.timing.delay, np.int64),
        age=np.zeros(shape, np.int64),
        noise=np.tile(noise, (*shape, 1)),
        velocity=np.zeros((sizes.worlds, sizes.obstacles, 3)),
        past=np.zeros(past),
        marks=np.zeros((sizes.worlds, sizes.obstacles), records.MARK),
    )


def split(worlds: int, threads: int) -> tuple[slice, ...]:
    """Split N worlds into contiguous parts of nearly equal size, one per thread."""
    edges = np.arange(min(threads, worlds) + 1) * worlds // min(threads, worlds)
    return tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges))


def stack_members(
    worlds: Sequence[World],
    motions: Sequence[Sequence[Motion | None]],
    outlines: OutlineArrays,
    sizes: Sizes,
    member: Integers,
) -> records.WorldSetArrays:
    """Stack the surroundings of the members of a world set.

    Args:
        worlds: the P members.
        motions: (P, K) of their obstacles.
        outlines: of all shapes.
        sizes: of the simulation.
        member: (N,) the member that each world is a copy of; it changes as episodes begin.
    """
    grids = _share_equal_maps([world.grid for world in worlds])
    distances, map_places = joined([map_field(grid).distances for grid in grids])
    moves = any(motion is not None for group in motions for motion in group)
    standing = not (sizes.crowded or moves) and sizes.obstacles >= STANDING
    plans, waypoints = _stack_plans(motions if moves else [() for _ in worlds])
    bounds = np.array([world.extent for world in worlds])
    return records.WorldSetArrays(
        stack_fixtures([world.all_walls() for world in worlds], grids, member),
        distances,
        map_places,
        outlines,
        sizes.crowded,
        standing,
        moves,
        plans,
        waypoints,
        bounds,
    )


def _share_equal_maps(grids: Sequence[GridMap | None]) -> list[GridMap | None]:
    """Return one object for all maps of equal content, which is then baked and stored once."""
    distinct: dict[Any, GridMap] = {}
    shared: list[GridMap | None] = []
    for grid in grids:
        if grid is None:
            shared.append(None)
            continue
        content = (
            grid.cells.shape,
            grid.resolution,
            grid.origin,
            hash_bytes(grid.cells.tobytes()),
        )
        shared.append(distinct.setdefault(content, grid))
    return shared


def map_field(grid: GridMap | None) -> records.MapField:
    """Return a static map for the kernels."""
    if grid is None:
        return records.NO_FIELD
    return records.MapField(
        np.ascontiguousarray(grid.distance_field), *grid.arrays.frame.tolist()
    )


def allocate_cells(
    sizes: Sizes, world_set: records.WorldSetArrays
) -> records.BodyCells:
    """Allocate the cells of all worlds, none if testing all bodies takes less time."""
    worlds = sizes.worlds if world_set.crowded or world_set.standing else 0
    return body_cells(worlds, sizes.robots + sizes.obstacles, world_set.standing)


def _stack_plans(
    motions: Sequence[Sequence[Motion | None]],
) -> tuple[records.Records, Array]:
    """Return the plans (P, K) and waypoints (Q, 2) of the motions (P, K) of all members."""
    plans = np.zeros((len(motions), max(map(len, motions))), records.PLAN)
    waypoints = np.zeros((0, 2))
    for plan, motions_of_member in zip(plans, motions, strict=True):
        plan[: len(motions_of_member)], more = plan_arrays(motions_of_member)
        plan["first"] += len(waypoints)
        waypoints = np.concatenate([waypoints, more])
    return plans, waypoints


def allocate_part(
    data: records.State,
    world_set: records.WorldSetArrays,
    model: SimulatorModel,
    scanner: Scanner,
    sizes: Sizes,
    cells: records.BodyCells,
    part: slice,
) -> records.Part:
    """Return the kernels' arguments for one part of the worlds, with its own scratch memory."""
    timing = model.timing
    motion = records.Dynamics(
        make_terms(model.kinematics), SERIES, float(timing.dt), int(timing.substeps)
    )
    scratch = _allocate_scratch(model, scanner, sizes, cells, part.stop - part.start)
    return records.Part(data, world_set, scanner.arguments, motion, scratch)


def _allocate_scratch(
    model: SimulatorModel,
    scanner: Scanner,
    sizes: Sizes,
    cells: records.BodyCells,
    worlds: int,
) -> records.Scratch:
    """Allocate the memory of a thread that steps so many worlds."""
    kinematics = model.kinematics
    robots = sizes.robots
    obstacles = sizes.obstacles
    bodies = obstacles + robots
    blocks = -(-worlds * robots // LANES)
    lanes = robots * min(worlds, -(-worlds // blocks))
    x, dq = allocate_scratch(kinematics)
    commands = len(kinematics.variables) - kinematics.state_size
    return records.Scratch(
        lanes=records.Lanes(
            pose=np.zeros((records.LANE_ROWS, lanes)),
            x=np.ones((len(kinematics.variables) + 1, lanes)),
            dq=np.zeros((len(kinematics.dofs), lanes)),
            change=np.zeros((commands, lanes), np.int64),
            coefficient=np.zeros((np.count_nonzero(kinematics.coefficients), lanes)),
        ),
        single=records.Single(x, dq),
        tight=records.Tight(
            motions=np.zeros(robots, records.MOTION),
            listed=records.allocate_touches(),
            start=np.zeros((obstacles, 3)),
            stops=np.zeros(obstacles),
            fastest=np.zeros(1),
        ),
        nearby=records.Nearby(
            near=np.zeros((robots, 1 + SEVERAL), np.int64),
            meets=np.zeros(robots, np.int64),
            path=np.zeros(robots),
            reach=np.zeros(bodies),
            speeds=np.zeros((robots, 2)),
        ),
        cells=cells._replace(
            then=cells.then.copy() if cells.ordered else cells.then,
            found=cells.found.copy(),
        ),
        scans=records.Scans(
            start_poses=np.zeros((lanes, 3)),
            waiting=np.zeros(worlds, np.int64),
            bodies=np.zeros((bodies + 1, BODY)),
            pose=np.zeros(3),
            slice_poses=np.zeros((SLICES, 3)),
            slice_ranges=np.zeros(model.lidar.beams, np.float32),
            twist=np.zeros(3),
            everybody=np.arange(bodies + 1, dtype=np.int32),
            scratch=scan_kernels.scan_scratch(model.lidar.beams),
        ),
    )
