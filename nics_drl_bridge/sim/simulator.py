"""FastSimulator: N worlds x M robots of one SimulatorModel in one set of arrays.

`reset` draws the scenes of episodes and puts robots and obstacles in place; `step` moves all worlds
by one control period, see `step_kernels`. Everything that changes is in `FastSimulator.data`, a
`state.State`. The worlds are split into parts, one per thread.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.bake import with_shapes
from nics_drl_bridge.lidar.exact_kernels import SHAPE
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.sensor import Render, SensedWorlds, unread
from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.sim import allocation, step_kernels
from nics_drl_bridge.sim.command_range import CommandRange, warn_caller
from nics_drl_bridge.sim.packing_kernels import pack
from nics_drl_bridge.sim.randomisation import (
    Draws,
    Randomisation,
    Sampler,
    load_randomisation,
)
from nics_drl_bridge.sim.scenes import Scenes, SceneSampler
from nics_drl_bridge.sim.state import POSE, TRUE_TWIST, WorldSetArrays
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.threads import run_parts

Indices = Integers
Result = TypeVar("Result")
# Poses of robots (n, M, 3), or a function that returns them for scenes; None: the scenes' poses
Starts = ArrayLike | Callable[[Scenes], Array | None] | None
# Commands of a part are checked when its first world has made a multiple of so many steps.
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
REBUILT = (
    "_world_set",
    "packed",
    "_renders",
)  # what a copy of a simulator makes for itself


class FastSimulator:
    """The simulator that a SimulatorModel describes, in copies of a world or of those of a set.

    A world is bit-identical in any batch and any number of threads. Its M robots scan and hit each
    other.

    Attributes:
        data: everything that changes, see `state.State`.
        goals: (N, M, 2) of the running episodes [m].
        drawn: numbers that the randomisation drew for the running episodes, by name; (N, M) per
            robot or (N,) per scene.
        readings: (N, M, S) of each further sensor, by its name, see `lidar.sensor`.
        parts: the worlds that each thread steps.
        episodes: draws the episodes of seeds.
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
        tell: Callable[[str], None] = warn_caller,
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
            longest_delay: maximum that `data.delay` may be set to [substeps], by default that of
                the model; raised to the randomisation's.
            longest_age: maximum that `data.age` may be set to [substeps]; raised likewise.
            tell: gets one message for each command of the robot that leaves the range of the fit,
                and never a second one.

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
        allocation.check_robots(robots, world.source)
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
        self._sizes = allocation.Sizes(
            worlds, robots, self.sampler.count, delay, longest_age
        )
        allocation.check_memory(model, self._sizes, world.source)
        self.footprint = footprint_shape(model.robot)
        shapes = (*self.sampler.shapes, self.footprint)
        table = with_shapes(model.lidar, model.table, shapes)
        # Index in the lidar's table of each shape of the sampler, and of the footprint.
        self._in_table = np.array([table.outlines.index_of(shape) for shape in shapes])
        self._scanner = Scanner(model.lidar, table, renderer)
        self.data = allocation.allocate_state(model, self._sizes)
        self.goals: Array = np.zeros((worlds, robots, 2))
        self.drawn: dict[str, NDArray[Any]] = {}
        self.readings = unread(model.sensors, worlds, robots)
        self.parts = allocation.split(worlds, threads)
        self._command_range = CommandRange(model.kinematics, model.robot, tell)

    def reset(
        self,
        seeds: ArrayLike,
        worlds: ArrayLike | None = None,
        starts: Starts = None,
    ) -> Scenes:
        """Begin episodes; threads may call it in parallel for different parts.

        Args:
            seeds: (n,) each fixes scene, start, goal, noise and randomisation of an episode.
            worlds: (n,) indices of the worlds; by default all of them.
            starts: (n, M, 3) poses of the robots, or a function that returns them for the scenes
                that were drawn; by default those of the scenes.

        Returns:
            The scenes, whose obstacles are in the order of `data`. It is the order of `scenes` only
            if they are few or move.

        Raises:
            ConfigError: seeds, worlds, starts or a scene do not fit.
        """
        chosen = self._choose_worlds(worlds)
        scenes, draws = self.episodes.draw(seeds)
        if callable(starts):
            starts = starts(scenes)
        poses = scenes.starts
        if starts is not None:
            poses = np.asarray(starts, dtype=np.float64)
        if len(scenes) != len(chosen) or poses.shape != scenes.starts.shape:
            needed = f"{len(chosen)} worlds with {self.data.pose.shape[1]} robots each."
            raise ConfigError(
                f"{len(scenes)} seeds and starts {poses.shape} do not fit {needed}"
            )
        self._place_scenes(chosen, np.asarray(seeds, dtype=np.int64), scenes, poses)
        if draws is not None:
            self._apply_draws(chosen, draws)
        for part in self.parts:
            of_part = chosen[(chosen >= part.start) & (chosen < part.stop)]
            if len(of_part):
                step_kernels.begin_episodes(self.packed[part.start], of_part)
                self.sense(of_part)
        if self.sampler.count < allocation.STANDING:
            return scenes
        return Scenes(
            self.obstacles_of(chosen), scenes.starts, scenes.goals, scenes.member
        )

    def step(self, commands: ArrayLike) -> None:
        """Move every world by one control period under commands (N, M, C), see `data`."""
        checked = self._check_commands(slice(0, len(self.data.steps)), commands)
        self.run_parts(lambda part: self._step(part, checked[part]))

    def step_part(self, part: slice, commands: ArrayLike) -> None:
        """Move the worlds of one of `parts` under commands (n, M, C), in the calling thread."""
        self._step(part, self._check_commands(part, commands))

    def run_parts(self, function: Callable[[slice], Result]) -> list[Result]:
        """Run a function for each of `parts`, one thread per part; return the results."""
        return run_parts(function, self.parts)

    def sense(self, worlds: Indices) -> None:
        """Render the readings of the further sensors in some worlds (n,)."""
        for name, render in self._renders.items():
            render(self.readings[name], worlds)

    def scenes(self, seeds: ArrayLike) -> Scenes:
        """Return the scenes that `reset` would begin with for seeds (n,)."""
        return self.episodes.draw(seeds)[0]

    @property
    def moves(self) -> bool:
        """True if an obstacle of any world moves; `data` then has them in the order of scenes."""
        return self._world_set.moves

    @property
    def obstacles(self) -> Array:
        """(N, K, 7) the obstacles at their present poses, in the format of `scenes`."""
        return self.obstacles_of(np.arange(len(self.data.steps)))

    def obstacles_of(self, worlds: Indices) -> Array:
        """Return the obstacles (n, K, 7) of some worlds (n,), in the format of `scenes`."""
        bodies = self.data.bodies[worlds, : self.sampler.count]
        of_obstacles = self._in_table[:-1]
        index = np.zeros(int(self._in_table.max()) + 1)
        # Equal shapes share a place in the table; in reverse, because the first of them is meant.
        index[of_obstacles[::-1]] = np.arange(len(of_obstacles))[::-1]
        bodies[..., SHAPE] = index[bodies[..., SHAPE].astype(np.int64)]
        return bodies

    def put_bodies(self, bodies: Array) -> None:
        """Put the obstacles of the first world at (K, 7), in the format of `scenes`.

        Many obstacles that stand are sorted afterwards: row k of `data.bodies` then need not be
        obstacle k, see `moves`.
        """
        obstacles = self.data.bodies[0, : self.sampler.count]
        obstacles[:] = bodies
        obstacles[:, SHAPE] = self._in_table[bodies[:, SHAPE].astype(np.int64)]
        self._sort_first_world()

    def put_robot(self, robot: int, pose: Array, state: Array) -> None:
        """Put a robot of the first world at a pose (3,) with a state (S,); odometry stays.

        Late scans are then of the new pose: it is as if the robot had always stood there.
        """
        self.data.pose[0, robot] = pose
        self.data.state[0, robot] = state
        past = self.data.past[0, robot]
        past[:, POSE : POSE + 3] = pose
        past[:, TRUE_TWIST : TRUE_TWIST + 3] = 0.0
        body = place(pose, self.footprint.radius, self._in_table[-1])
        self.data.bodies[0, self.sampler.count + robot] = body
        self._sort_first_world()

    def sort_bodies(self) -> None:
        """Sort the bodies of all worlds into cells again, after `data` was written from outside."""
        for part in self.parts:
            step_kernels.sort_worlds(self.packed[part.start], part.start, part.stop)

    def take_over(
        self, source: "FastSimulator", robots: Indices, obstacles: Indices
    ) -> None:
        """Continue the episode of another simulator of this model, in its first world.

        The poses of the obstacles are not taken over; `put_bodies` puts them.

        Args:
            source: the other simulator.
            robots: indices of its robots that become the first robots here.
            obstacles: (K,) index of each obstacle there, whose motion continues; -1 if it is new.
        """
        mine = self.data
        theirs = source.data
        poses = mine.pose[0].copy()
        poses[: len(robots)] = theirs.pose[0, robots]
        states = mine.state[0].copy()
        states[: len(robots)] = theirs.state[0, robots]
        for m, (pose, state) in enumerate(zip(poses, states, strict=True)):
            self.put_robot(m, pose, state)
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
        cells = allocation.allocate_cells(self._sizes, self._world_set)
        packed = {}
        for part in self.parts:
            packed[part.start] = pack(
                allocation.allocate_part(
                    self.data,
                    self._world_set,
                    self.model,
                    self._scanner,
                    self._sizes,
                    cells,
                    part,
                )
            )
            step_kernels.sort_worlds(packed[part.start], part.start, part.stop)
        return packed

    @cached_property
    def _world_set(self) -> WorldSetArrays:
        return allocation.stack_members(
            self.world.members,
            self.sampler.motions,
            self._scanner.table.outlines.arguments,
            self._sizes,
            self.data.member,
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

    def _choose_worlds(self, worlds: ArrayLike | None) -> Indices:
        """Return the indices of the worlds to reset; kernels do not check them."""
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

    def _place_scenes(
        self, chosen: Indices, seeds: Indices, scenes: Scenes, starts: Array
    ) -> None:
        """Put the robots at `starts` (n, M, 3) and the obstacles of the scenes, all at rest."""
        data = self.data
        data.pose[chosen] = starts
        data.odom[chosen] = starts
        for name in ("state", "history", "twist", "collided", "steps", "velocity"):
            getattr(data, name)[chosen] = 0
        data.seeds[chosen] = seeds
        data.member[chosen] = scenes.member
        count = self.sampler.count
        shapes = scenes.bodies[..., SHAPE].astype(np.int64)
        data.bodies[chosen, :count] = scenes.bodies
        data.bodies[chosen, :count, SHAPE] = self._in_table[shapes]
        data.bodies[chosen, count:] = place(
            starts, self.footprint.radius, self._in_table[-1]
        )
        self.goals[chosen] = scenes.goals

    def _apply_draws(self, chosen: Indices, draws: Draws) -> None:
        """Give the worlds the numbers that a randomisation drew."""
        data = self.data
        data.coefficient[chosen] = draws.coefficient
        data.noise[chosen] = draws.noise
        data.delay[chosen] = draws.delay
        data.age[chosen] = draws.age
        data.faults[chosen] = draws.faults
        for name, values in draws.named().items():
            if name not in self.drawn:
                shape = (len(data.steps), *values.shape[1:])
                self.drawn[name] = np.zeros(shape, values.dtype)
            self.drawn[name][chosen] = values

    def _sort_first_world(self) -> None:
        step_kernels.sort_worlds(self.packed[0], 0, 1)

    def _check_commands(self, part: slice, commands: ArrayLike) -> Array:
        """Return commands (n, M, C) as an array; report those outside the range of the fit."""
        checked = np.ascontiguousarray(commands, dtype=np.float64)
        robots, _, width = self.data.history.shape[1:]
        expected = (part.stop - part.start, robots, width)
        if checked.shape != expected:
            needed = f"they must be {expected}: worlds, robots, and a robot's commands."
            raise ConfigError(f"commands are {checked.shape}; {needed}")
        if self.data.steps[part.start] % CHECK_INTERVAL == 0:
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


def check_speed(model: TaylorModel, robot: RobotSpec, world: AnyWorld) -> None:
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
            f"the robot {robot.name!r} could drive {longest:.3g} m in a step of {model.dt:g} s, "
            f"across {shortest_side:.3g} m of world; lower the limits of its commands, or generate "
            "its model with a shorter step."
        )
