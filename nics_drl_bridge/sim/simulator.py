"""FastSimulator: N worlds x M robots of one SimulatorModel in one set of arrays.

`reset` draws the scenes of episodes and puts robots and obstacles in place; `step` moves all worlds
by one control period, see `step_kernels`. Everything that changes is in `FastSimulator.data`, a
`state.State`. The worlds are split into parts, one per thread.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.kernels import bind, pack
from nics_drl_bridge.lidar import scan_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.bake import add_shapes
from nics_drl_bridge.lidar.exact_kernels import SHAPE
from nics_drl_bridge.lidar.maps import GridMap, joined, stack_fixtures
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.sensor import Render, SensedWorlds, unread
from nics_drl_bridge.lidar.shapes import BODY, place
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.kernels import SERIES, allocate_scratch, make_terms
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim import state as records
from nics_drl_bridge.sim import step_kernels
from nics_drl_bridge.sim.collision_kernels import body_cells
from nics_drl_bridge.sim.contact_kernels import SEVERAL
from nics_drl_bridge.sim.randomisation import (
    Draws,
    Randomisation,
    Sampler,
    load_randomisation,
)
from nics_drl_bridge.sim.scenes import Scenes, SceneSampler
from nics_drl_bridge.sim.state import POSE, TRUE_TWIST, WorldSetArrays
from nics_drl_bridge.sim.world import Motion, plan_arrays
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.threads import run_parts

SLICES = 16  # Number of groups of beams in which a skewed scan is rendered
LANES = 256  # Number of robots moved side by side: their arrays stay in the L1 cache
# Minimum number of robot-body pairs for sorting bodies into cells
CROWD = 4096
# Minimum number of robots; with fewer, testing all bodies is faster
FEWEST_OF_A_CROWD = 8
STANDING = 32  # Minimum number of static obstacles for sorting them into cells once
# Limits of a simulation: robots in one world, where each is tested against every other,
# and array elements of all worlds, a few GB.
MOST_ROBOTS = 1_000
MOST_NUMBERS = 2**30
# Array elements per robot or obstacle, apart from beams, history and past
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
        """Return R: the newest period, and one row per period of observation lag."""
        return count_periods(self.longest_age, model) + 1

    def count_history_rows(self, model: SimulatorModel) -> int:
        """Return H: one row for the newest command and one per period of delay."""
        own_delays = make_terms(model.kinematics).extra_delays
        longest = self.longest_delay + int(own_delays.max(initial=0))
        return count_periods(longest, model) + 1


TOLERANCE = 0.05  # tolerated excess over the recorded range, as a fraction of a command's limits


class OutsideValidityWarning(UserWarning):
    """Commands lie outside the range that the model's recording covered."""


def warn_caller(message: str) -> None:
    """Issue an OutsideValidityWarning at the line that steps the simulator."""
    warnings.warn(message, OutsideValidityWarning, stacklevel=5)


class CommandRange:
    """Range of commands that a model was fitted to; warns once for each command.

    Commands whose effect was assumed instead of fitted are not checked.
    """

    def __init__(
        self,
        model: taylor.TaylorModel,
        robot: RobotSpec,
        warn: Callable[[str], None] = warn_caller,
    ) -> None:
        self._warn = warn
        self._names = robot.variable_names[model.state_size :]
        fitted = np.stack([model.low, model.high])[:, model.state_size :]
        # The model's range refers to commands in effect; `check` gets the commands as
        # sent.
        for curve in model.inputs:
            c = self._names.index(curve.command)
            fitted[:, c] = curve.invert(fitted[:, c])
        self._fitted = fitted
        margin = TOLERANCE * (robot.command_high - robot.command_low)
        self._low = fitted[0] - margin
        self._high = fitted[1] + margin
        for _, term in model.assumed:
            powers = taylor.parse_term(term, model.variables)
            assumed = powers[model.state_size :] > 0
            self._low[assumed] = -np.inf
            self._high[assumed] = np.inf
        # A dict, because `pop` is atomic: parts of the worlds are checked by several threads.
        self._unreported = dict.fromkeys(self._names, True)

    def check(self, commands: Array) -> None:
        """Warn about commands (..., C) outside the range, once for each of the C."""
        if not self._unreported:
            return
        flat = commands.reshape(-1, commands.shape[-1])
        outside = (flat < self._low) | (flat > self._high)
        if not outside.any():
            return
        for c in np.flatnonzero(outside.any(axis=0)).tolist():
            name = self._names[c]
            if not self._unreported.pop(name, False):
                continue
            lowest = flat[:, c].min()
            value = lowest if lowest < self._low[c] else flat[:, c].max()
            low, high = self._fitted[:, c]
            self._warn(
                f"{name} is {value:.4g}, but the model was fitted to {low:.4g} to {high:.4g} only: "
                "its motion there is extrapolated; record a drive that covers it."
            )


Result = TypeVar("Result")
# Poses of robots (n, M, 3), or a function that returns them for scenes; None: the scenes' poses
Starts = ArrayLike | Callable[[Scenes], Array | None] | None
# The commands of a part are checked once per this many steps of its first world.
CHECK_INTERVAL = 16
# Arrays of the state with a row for each robot.
ROBOT_ARRAYS = (
    "pose",
    "state",
    "history",
    "odom",
    "twist",
    "ranges",
    "collided",
    "faults",
    "coefficient",
    "delay",
    "age",
    "noise",
    "past",
)
# Arrays of the state that a reset sets to 0.
CLEARED = ("state", "history", "twist", "collided", "steps", "velocity", "marks")
REBUILT = ("_world_set", "packed", "_renders")  # by each copy of a simulator


class FastSimulator:
    """Simulator of a SimulatorModel, in N copies of a world or of the worlds of a set.

    The results of a world are bit-identical in any batch and with any number of
    threads. Its M robots appear in each other's scans and can collide with each other.

    Attributes:
        data: everything that changes, see `state.State`.
        goals: (N, M, 2) of the running episodes [m].
        drawn: numbers that the randomisation drew for the running episodes, by name; (N, M) per
            robot or (N,) per scene.
        readings: (N, M, S) of each additional sensor, by name, see `lidar.sensor`.
        parts: the worlds that each thread steps.
        episodes: draws the episode of each seed.
        sampler: draws the scenes of `episodes`.
        footprint: shape of the robots.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        worlds: int = 1,
        robots: int = 1,
        renderer: Renderer = defaults.RENDERER,
        threads: int = 1,
        randomisation: str | Randomisation | None = None,
        longest_delay: int | None = None,
        longest_age: int = 0,
        warn: Callable[[str], None] = warn_caller,
    ) -> None:
        """Allocate the worlds; `reset` begins their first episodes.

        Args:
            model: robot, kinematics, lidar and noise.
            world: the world, or a set; each episode draws one of its worlds.
            worlds: N.
            robots: M in each world.
            renderer: `auto`, `baked` or `exact`, see `lidar.scanner.Scanner`.
            threads: number of parts of the worlds that `step` steps in parallel.
            randomisation: of each episode; also the name of a shipped one, or of a YAML file.
            longest_delay: upper limit of `data.delay` [substeps]; by default the
                model's delay, or the maximum of the randomisation if that is longer.
            longest_age: upper limit of `data.age` [substeps]; raised to the
                randomisation's maximum in the same way.
            warn: called with a message when a command leaves the fitted range, once per
                command.

        Raises:
            ConfigError: the sizes are wrong or too large, or the robot is too fast for the world.
        """
        delay = model.timing.delay if longest_delay is None else longest_delay
        if (
            min(worlds, robots, threads) < 1
            or delay < model.timing.delay
            or longest_age < 0
        ):
            raise ConfigError(
                f"a simulator needs at least 1 world, robot and thread, not {worlds}, {robots} and "
                f"{threads}; a longest_delay of at least the model's {model.timing.delay} substeps "
                f"and a longest_age of at least 0, not {delay} and {longest_age}."
            )
        if robots > MOST_ROBOTS:
            raise ConfigError(
                f"{world.source} with {robots:.10g} robots: a world may have at most "
                f"{MOST_ROBOTS}."
            )
        if randomisation is not None and not isinstance(randomisation, Randomisation):
            randomisation = load_randomisation(randomisation)
        check_speed(model.kinematics, model.robot, world)
        self.model = model
        self.world = world
        self.randomisation = randomisation
        self.episodes = EpisodeSampler(model, world, robots, randomisation)
        if self.episodes.draws is not None:
            delay = max(delay, self.episodes.draws.longest_delay)
            longest_age = max(longest_age, self.episodes.draws.longest_age)
        self.sampler = self.episodes.scenes
        self._sizes = Sizes(worlds, robots, self.sampler.count, delay, longest_age)
        check_memory(model, self._sizes, world.source)
        self.footprint = footprint_shape(model.robot)
        shapes = (*self.sampler.shapes, self.footprint)
        table = add_shapes(model.lidar, model.table, shapes)
        # Index in the lidar's table of each shape of the sampler, and of the footprint.
        self._in_table = np.array([table.outlines.index_of(shape) for shape in shapes])
        self._scanner = Scanner(model.lidar, table, renderer)
        self.data = allocate_state(model, self._sizes)
        self.goals = np.zeros((worlds, robots, 2))
        self.drawn: dict[str, NDArray[Any]] = {}
        self.readings = unread(model.sensors, worlds, robots)
        edges = np.arange(min(threads, worlds) + 1) * worlds // min(threads, worlds)
        self.parts = tuple(slice(*ends) for ends in itertools.pairwise(edges.tolist()))
        self._command_shape = (robots, len(model.robot.command))
        self._command_range = CommandRange(model.kinematics, model.robot, warn)

    def reset(
        self,
        seeds: ArrayLike,
        worlds: ArrayLike | None = None,
        starts: Starts = None,
    ) -> Scenes:
        """Begin episodes. Threads may call this in parallel for different parts.

        Args:
            seeds: (n,) each determines scene, start, goal, noise and randomisation of
                an episode.
            worlds: (n,) indices of the worlds; by default all of them.
            starts: (n, M, 3) poses of the robots, or a function that returns them for the scenes
                that were drawn; by default those of the scenes.

        Returns:
            The scenes, with obstacles in the order of `data`. This differs from the
            order of `scenes` if there are many static obstacles.

        Raises:
            ConfigError: seeds, worlds, starts or a scene do not fit.
        """
        chosen = self._choose_worlds(worlds)
        scenes, draws = self.episodes.draw(seeds)
        if callable(starts):
            starts = starts(scenes)
        poses = scenes.starts
        if starts is not None:
            poses = np.asarray(starts, np.float64)
        if len(scenes) != len(chosen) or poses.shape != scenes.starts.shape:
            raise ConfigError(
                f"{len(scenes)} seeds and starts {poses.shape} do not fit {len(chosen)} worlds "
                f"with {self.data.pose.shape[1]} robots each."
            )
        data = self.data
        data.pose[chosen] = poses
        data.odom[chosen] = poses
        for name in CLEARED:
            getattr(data, name)[chosen] = 0
        data.seeds[chosen] = np.asarray(seeds, np.int64)
        data.member[chosen] = scenes.member
        count = self.sampler.count
        shapes = scenes.bodies[..., SHAPE].astype(np.int64)
        data.bodies[chosen, :count] = scenes.bodies
        data.bodies[chosen, :count, SHAPE] = self._in_table[shapes]
        data.bodies[chosen, count:] = place(
            poses, self.footprint.radius, self._in_table[-1]
        )
        self.goals[chosen] = scenes.goals
        if draws is not None:
            self._put_draws(draws, chosen)
        for part in self.parts:
            of_part = chosen[(chosen >= part.start) & (chosen < part.stop)]
            if len(of_part):
                step_kernels.begin_episodes(self.packed[part.start], of_part)
                self.sense(of_part)
        if count < STANDING:
            return scenes
        return Scenes(
            self.obstacles_of(chosen), scenes.starts, scenes.goals, scenes.member
        )

    def _put_draws(self, draws: Draws, chosen: Integers) -> None:
        """Give some worlds (n,) the numbers that were drawn for them."""
        for name in ("coefficient", "noise", "delay", "age", "faults"):
            getattr(self.data, name)[chosen] = getattr(draws, name)
        for name, values in draws.named().items():
            if name not in self.drawn:
                shape = (len(self.data.steps), *values.shape[1:])
                self.drawn[name] = np.zeros(shape, values.dtype)
            self.drawn[name][chosen] = values

    def step(self, commands: ArrayLike) -> None:
        """Advance every world by one control period under commands (N, M, C)."""
        if len(self.parts) == 1:
            part = self.parts[0]
            self._step(part, self._check_commands(part, commands))
        else:
            checked = self._check_commands(slice(0, len(self.data.steps)), commands)
            self.run_parts(lambda part: self._step(part, checked[part]))

    def step_part(self, part: slice, commands: ArrayLike) -> None:
        """Advance the worlds of one part, in the calling thread: commands (n, M, C)."""
        self._step(part, self._check_commands(part, commands))

    def bind_step(self, commands: Array) -> Callable[[], None]:
        """Return a fast `step` for commands that are updated in place."""
        step_worlds = bind(step_kernels.step_worlds, self.packed[0], commands, 0)
        steps = self.data.steps

        def step() -> None:
            if steps.item(0) % CHECK_INTERVAL == 0:
                self._command_range.check(commands)
            step_worlds()

        return step

    def run_parts(self, function: Callable[[slice], Result]) -> list[Result]:
        """Run a function for each of `parts`, one thread per part; return the results."""
        return run_parts(function, self.parts)

    def sense(self, worlds: Integers) -> None:
        """Render the readings of the additional sensors in some worlds (n,)."""
        for name, render in self._renders.items():
            render(self.readings[name], worlds)

    def scenes(self, seeds: ArrayLike) -> Scenes:
        """Return the scenes that `reset` would draw for seeds (n,)."""
        return self.episodes.draw(seeds)[0]

    @property
    def moves(self) -> bool:
        """True if any obstacle moves; `data` then keeps the order of the scenes."""
        return self._world_set.moves

    @property
    def obstacles(self) -> Array:
        """(N, K, 7) the obstacles at their current poses, in the format of `scenes`."""
        return self.obstacles_of(np.arange(len(self.data.steps)))

    def obstacles_of(self, worlds: Integers) -> Array:
        """Return the obstacles (n, K, 7) of some worlds (n,), in the format of `scenes`."""
        bodies = self.data.bodies[worlds, : self.sampler.count]
        of_obstacles = self._in_table[:-1]
        index = np.zeros(int(self._in_table.max()) + 1)
        # Equal shapes share a row of the table; reversed, so that the first of them is
        # used.
        index[of_obstacles[::-1]] = np.arange(len(of_obstacles))[::-1]
        bodies[..., SHAPE] = index[bodies[..., SHAPE].astype(np.int64)]
        return bodies

    def put_bodies(self, bodies: Array) -> None:
        """Put the obstacles of the first world at (K, 7), in the format of `scenes`.

        Many static obstacles are then sorted, so row k of `data.bodies` may not be
        obstacle k, see `moves`.
        """
        obstacles = self.data.bodies[0, : self.sampler.count]
        obstacles[:] = bodies
        obstacles[:, SHAPE] = self._in_table[bodies[:, SHAPE].astype(np.int64)]
        step_kernels.sort_worlds(self.packed[0], 0, 1)

    def put_robot(self, robot: int, pose: Array, state: Array) -> None:
        """Put a robot of the first world at a pose (3,) with a state (S,).

        Its odometry is kept. Delayed scans are then taken from the new pose, as if the
        robot had always been there.
        """
        self.data.pose[0, robot] = pose
        self.data.state[0, robot] = state
        past = self.data.past[0, robot]
        past[:, POSE : POSE + 3] = pose
        past[:, TRUE_TWIST : TRUE_TWIST + 3] = 0.0
        body = place(pose, self.footprint.radius, self._in_table[-1])
        self.data.bodies[0, self.sampler.count + robot] = body
        step_kernels.sort_worlds(self.packed[0], 0, 1)

    def sort_bodies(self) -> None:
        """Sort the bodies of all worlds into cells again, after `data` was written from outside."""
        for part in self.parts:
            step_kernels.sort_worlds(self.packed[part.start], part.start, part.stop)

    def take_over(
        self, source: "FastSimulator", robots: Integers, obstacles: Integers
    ) -> None:
        """Continue the episode of another simulator of this model, in its first world.

        The poses of the obstacles are not copied; set them by `put_bodies`.

        Args:
            source: the other simulator.
            robots: indices of its robots that become the first robots here.
            obstacles: (K,) index in `source` of the obstacle whose motion each one
                continues; -1 for a new obstacle.
        """
        mine = self.data
        theirs = source.data
        for m, robot in enumerate(robots):
            self.put_robot(m, theirs.pose[0, robot], theirs.state[0, robot])
        for name in ROBOT_ARRAYS:
            getattr(mine, name)[0, : len(robots)] = getattr(theirs, name)[0, robots]
        for name in ("steps", "seeds", "member"):
            getattr(mine, name)[0] = getattr(theirs, name)[0]
        kept = obstacles >= 0
        for name in ("velocity", "marks"):
            getattr(mine, name)[0, kept] = getattr(theirs, name)[0, obstacles[kept]]

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: value for name, value in vars(self).items() if name not in REBUILT
        }

    @cached_property
    def packed(self) -> dict[int, Any]:
        """The kernels' argument for each part, by the part's first world."""
        world_set = self._world_set
        sizes = self._sizes
        timing = self.model.timing
        motion = records.Dynamics(
            make_terms(self.model.kinematics),
            SERIES,
            float(timing.dt),
            int(timing.substeps),
        )
        # Without cells, all bodies are tested, which is faster for few bodies.
        sorted_worlds = sizes.worlds if world_set.crowded or world_set.standing else 0
        cells = body_cells(
            sorted_worlds, sizes.robots + sizes.obstacles, world_set.standing
        )
        packed = {}
        for part in self.parts:
            scratch = _allocate_scratch(
                self.model, sizes, cells, part.stop - part.start
            )
            packed[part.start] = pack(
                records.Part(
                    self.data, world_set, self._scanner.arguments, motion, *scratch
                )
            )
            step_kernels.sort_worlds(packed[part.start], part.start, part.stop)
        return packed

    @cached_property
    def _world_set(self) -> WorldSetArrays:
        """Stacked surroundings of the members of the world set."""
        members = self.world.members
        grids = _share_equal_maps([world.grid for world in members])
        distances, places = joined([map_field(grid).distances for grid in grids])
        plans, waypoints = _stack_plans(self.sampler.motions)
        moves = plans.size > 0
        crowded = self._sizes.crowded
        walls = [world.all_walls() for world in members]
        return WorldSetArrays(
            fixtures=stack_fixtures(walls, grids, self.data.member),
            distances=distances,
            map_places=places,
            outlines=self._scanner.table.outlines.arguments,
            crowded=crowded,
            standing=not (crowded or moves) and self.sampler.count >= STANDING,
            moves=moves,
            plans=plans,
            waypoints=waypoints,
            bounds=np.array([world.extent for world in members]),
        )

    @cached_property
    def _renders(self) -> dict[str, Render]:
        sensed = SensedWorlds(
            self.data,
            self._scanner.table.shapes,
            self.sampler.count,
            self._world_set.fixtures,
            self._scanner.renderer,
        )
        return {sensor.name: sensor.renderer(sensed) for sensor in self.model.sensors}

    def _choose_worlds(self, worlds: ArrayLike | None) -> Integers:
        """Return the indices of the worlds to reset, which kernels do not check."""
        count = len(self.data.steps)
        if worlds is None:
            return np.arange(count)
        indices = np.asarray(worlds)
        whole = indices.size == 0 or indices.dtype.kind in "iu"
        if indices.ndim == 1 and whole:
            listed = indices.tolist()
            inside = all(0 <= n < count for n in listed)
            if inside and len(set(listed)) == len(listed):
                return indices.astype(np.int64)
        raise ConfigError(
            f"worlds {np.array2string(indices, threshold=10)} must be indices from 0 to "
            f"{count - 1}, each at most once."
        )

    def _check_commands(self, part: slice, commands: ArrayLike) -> Array:
        """Return commands (n, M, C) as an array; report those outside the range of the fit."""
        checked = np.ascontiguousarray(commands, dtype=np.float64)
        expected = (part.stop - part.start, *self._command_shape)
        if checked.shape != expected:
            needed = f"they must be {expected}: worlds, robots, and a robot's commands."
            raise ConfigError(f"commands are {checked.shape}; {needed}")
        if self.data.steps.item(part.start) % CHECK_INTERVAL == 0:
            self._command_range.check(checked)
        return checked

    def _step(self, part: slice, commands: Array) -> None:
        step_kernels.step_worlds(self.packed[part.start], commands, part.start)
        if self.readings:
            self.sense(np.arange(part.start, part.stop))


class EpisodeSampler:
    """Draws the scenes of episodes, and the numbers of a randomisation, if any."""

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        robots: int = 1,
        randomisation: Randomisation | None = None,
    ) -> None:
        sizes: tuple[float, ...] = (1.0,)
        most_obstacles = None
        if randomisation is not None:
            sizes = randomisation.sizes
            if randomisation.obstacles.count is not None:
                most_obstacles = randomisation.obstacles.count[1]
        self.scenes = SceneSampler(
            world, model.robot.footprint_radius, robots, sizes, most_obstacles
        )
        self.draws = None
        if randomisation is not None:
            self.draws = Sampler(randomisation, model, robots)

    def draw(self, seeds: ArrayLike) -> tuple[Scenes, Draws | None]:
        """Draw the scenes and the numbers of seeds (n,)."""
        if self.draws is None:
            return self.scenes.draw(seeds), None
        draws = self.draws.draw(seeds)
        return self.scenes.draw(seeds, draws.count, draws.size), draws


def check_speed(model: taylor.TaylorModel, robot: RobotSpec, world: AnyWorld) -> None:
    """Raise ConfigError if a robot could cross a whole world in one step of its kinematics."""
    # the greatest absolute value of each variable: states of the fit, commands within their limits
    largest = np.maximum(np.abs(model.low), np.abs(model.high))
    effects = model.apply_curves([robot.command_low, robot.command_high])
    commands = largest[model.state_size :]
    commands[:] = np.maximum(commands, np.abs(effects).max(axis=0))
    terms = np.prod(largest**model.powers, axis=1)
    longest = float((np.abs(model.coefficients[:2]) @ terms).max() * model.dt)
    corners = np.array([member.extent for member in world.members]).reshape(-1, 2, 2)
    shortest_side = float(np.diff(corners, axis=1).min())
    if not longest < shortest_side:
        raise ConfigError(
            f"the robot {robot.name!r} could drive {longest:.3g} m in a step of "
            f"{model.dt:g} s, across a world of {shortest_side:.3g} m; lower the "
            "limits of its commands, or generate its model with a shorter step."
        )


def count_periods(substeps: int, model: SimulatorModel) -> int:
    """Convert substeps to control periods, rounded up."""
    return -(-substeps // model.timing.substeps)


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
        f"{sizes.worlds:.10g} copies of {source} with {sizes.robots} robots, "
        f"{sizes.obstacles} obstacles, delays of {sizes.longest_delay} and ages of "
        f"{sizes.longest_age} substeps: at most {MOST_NUMBERS // per_world} copies of "
        "it fit in memory."
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


def _share_equal_maps(grids: Sequence[GridMap | None]) -> list[GridMap | None]:
    """Return one object for all equal maps, so that it is baked and stored once."""
    distinct: dict[Any, GridMap | None] = {}
    shared = []
    for grid in grids:
        content = grid and (
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


def _stack_plans(
    motions: Sequence[Sequence[Motion | None]],
) -> tuple[records.Records, Array]:
    """Return the plans (P, K) and waypoints (Q, 2) of the motions (P, K) of all members.

    If nothing moves, there are no plans (P, 0).
    """
    waypoints = np.zeros((0, 2))
    if all(motion is None for group in motions for motion in group):
        return np.zeros((len(motions), 0), records.PLAN), waypoints
    plans = np.zeros((len(motions), max(map(len, motions))), records.PLAN)
    for plan, motions_of_member in zip(plans, motions, strict=True):
        plan[: len(motions_of_member)], more = plan_arrays(motions_of_member)
        plan["first"] += len(waypoints)
        waypoints = np.concatenate([waypoints, more])
    return plans, waypoints


def _allocate_scratch(
    model: SimulatorModel, sizes: Sizes, cells: records.BodyCells, worlds: int
) -> tuple[
    records.Lanes,
    records.Single,
    records.ContactScratch,
    records.BodyCells,
    records.Scans,
]:
    """Allocate the memory of a thread that steps a number of worlds."""
    kinematics = model.kinematics
    robots = sizes.robots
    obstacles = sizes.obstacles
    bodies = obstacles + robots
    blocks = -(-worlds * robots // LANES)
    lanes = robots * min(worlds, -(-worlds // blocks))
    commands = len(kinematics.variables) - kinematics.state_size
    return (
        records.Lanes(
            pose=np.zeros((records.LANE_ROWS, lanes)),
            x=np.ones((len(kinematics.variables) + 1, lanes)),
            dq=np.zeros((len(kinematics.dofs), lanes)),
            change=np.zeros((commands, lanes), np.int64),
            coefficient=np.zeros((np.count_nonzero(kinematics.coefficients), lanes)),
        ),
        records.Single(*allocate_scratch(kinematics)),
        records.ContactScratch(
            motions=np.zeros(robots, records.MOTION),
            listed=records.allocate_touches(),
            start=np.zeros((obstacles, 3)),
            stops=np.zeros(obstacles),
            fastest=np.zeros(1),
            near=np.zeros((robots, 1 + SEVERAL), np.int64),
            may_touch=np.zeros(robots, np.int64),
            reach=np.zeros(bodies),
            speeds=np.zeros((robots, 2)),
        ),
        cells._replace(
            then=cells.then.copy() if cells.ordered else cells.then,
            found=cells.found.copy(),
        ),
        records.Scans(
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
