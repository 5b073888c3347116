"""FastSimulator: N worlds x M robots of one SimulatorModel in one set of arrays."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.geometry import Array
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
from nics_drl_bridge.sim.scenes import Scenes, SetSampler
from nics_drl_bridge.sim.sensing_kernels import POSE, TWIST
from nics_drl_bridge.sim.state import Members
from nics_drl_bridge.sim.world_set import AnyWorld
from nics_drl_bridge.threads import run_parts

Indices = NDArray[np.int64]
R = TypeVar("R")
# Poses of robots (n, M, 3), or a function that returns them for scenes; None: the scenes' poses
Starts = ArrayLike | Callable[[Scenes], Array | None] | None
# Arrays of the state with a row for each robot.
OF_ROBOT = (
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
# Commands of a part are checked when its first world has made a multiple of so many steps.
CHECK_INTERVAL = 16


def _check_speed(model: TaylorModel, robot: RobotSpec, world: AnyWorld) -> None:
    """Raise ConfigError if a robot could cross a whole world in one step of its kinematics."""
    first = len(robot.state)
    most = np.maximum(np.abs(model.low), np.abs(model.high))
    ends = model.apply_curves([robot.command_low, robot.command_high])
    most[first:] = np.maximum(most[first:], np.abs(ends).max(axis=0))
    products = np.prod(most**model.powers, axis=1)
    step = float((np.abs(model.coefficients[:2]) @ products).max() * model.dt)
    sides = np.array([member.extent for member in world.members]).reshape(-1, 2, 2)
    if not step < (least := float(np.diff(sides, axis=1).min())):
        drives = f"could drive {step:.3g} m in a step of {model.dt:g} s, across {least:.3g} m"
        fix = "lower the limits of its commands, or generate its model with a shorter step."
        raise ConfigError(f"the robot {robot.name!r} {drives} of world; {fix}")


class EpisodeSampler:
    """Draws the scenes of episodes, and the numbers of a randomisation, if any."""

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        robots: int = 1,
        randomisation: Randomisation | None = None,
    ) -> None:
        given = randomisation
        sizes = (1.0,) if given is None else given.sizes
        if given is None or given.obstacles.count is None:
            most = None
        else:
            most = given.obstacles.count[1]
        self.scenes = SetSampler(
            world, model.robot.footprint_radius, robots, sizes, most
        )
        self.draws = None if given is None else Sampler(given, model, robots)

    def draw(self, seeds: ArrayLike) -> tuple[Scenes, Draws | None]:
        """Draw the scenes and the numbers of seeds (n,)."""
        if self.draws is None:
            return self.scenes.draw(seeds), None
        draws = self.draws.draw(seeds)
        return self.scenes.draw(seeds, draws.count, draws.size), draws


class FastSimulator:
    """The simulator that a SimulatorModel describes, in a world, or in those of a set.

    A world is bit-identical in any batch and any number of threads. Its M robots scan and hit each
    other. The renderer is `auto`, `baked` or `exact`, see `lidar.scanner.Scanner`; `threads` parts
    of the worlds are stepped in parallel. The randomisation of each episode may be the name of a
    shipped one, or a YAML file. `longest_delay` and `longest_age` are the maximum values that
    `data.delay` of commands (by default the model's) and `data.age` of scan and odometry may be set
    to [substeps], raised to the randomisation's. `tell` gets one message for each command of the
    robot that leaves the range of the fit, and never a second one.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        worlds: int = 1,
        robots: int = 1,
        renderer: Renderer = "auto",
        threads: int = 1,
        randomisation: str | Randomisation | None = None,
        longest_delay: int | None = None,
        longest_age: int = 0,
        tell: Callable[[str], None] = warn_caller,
    ) -> None:
        delay = model.timing[2] if longest_delay is None else longest_delay
        if (
            min(worlds, robots, threads) < 1
            or delay < model.timing[2]
            or longest_age < 0
        ):
            raise ConfigError(
                f"a simulator needs at least 1 world, robot and thread, not {worlds}, {robots} and "
                f"{threads}; a longest_delay of at least the model's {model.timing[2]} substeps "
                f"and a longest_age of at least 0, not {delay} and {longest_age}."
            )
        allocation.check_robots(robots, world.source)
        if randomisation is not None and not isinstance(randomisation, Randomisation):
            randomisation = load_randomisation(randomisation)
        _check_speed(model.kinematics, model.robot, world)
        self.model = model
        self.world = world
        self.randomisation = randomisation
        self.episodes = EpisodeSampler(model, world, robots, randomisation)
        if (draws := self.episodes.draws) is not None:
            delay = max(delay, draws.longest_delay)
            longest_age = max(longest_age, draws.longest_age)
        self.sampler = self.episodes.scenes
        self._sizes = allocation.Sizes(
            worlds, robots, self.sampler.count, delay, longest_age
        )
        allocation.check_memory(model, self._sizes, world.source)
        self.footprint = footprint_shape(model.robot)
        shapes = (*self.sampler.shapes, self.footprint)
        table = with_shapes(model.lidar, model.table, shapes)
        self._in_table = np.array([table.outlines.index_of(shape) for shape in shapes])
        self._scanner = Scanner(model.lidar, table, renderer)
        self.data = allocation.allocate(model, self._sizes)
        self.goals: Array = np.zeros((worlds, robots, 2))  # of the episodes [m]
        # Draws of the randomisation for the running episodes, (N, M) per robot or (N,) per scene.
        self.drawn: dict[str, NDArray[Any]] = {}
        # Name of a further sensor -> (N, M, S) its readings, see `lidar.sensor`.
        self.readings = unread(model.sensors, worlds, robots)
        # the worlds that each thread steps
        self.parts = allocation.split(worlds, threads)
        self._command_range = CommandRange(model.kinematics, model.robot, tell)

    @cached_property
    def _members(self) -> Members:
        members = self.world.members
        motions = self.sampler.motions
        outlines = self._scanner.table.outlines.arguments
        return allocation.members_of(
            members, motions, outlines, self._sizes, self.data.member
        )

    @property
    def moves(self) -> bool:
        """True if an obstacle of any world moves; `data` then has them in the order of scenes."""
        return self._members.moves

    @cached_property
    def packed(self) -> dict[int, Any]:
        """Packed arguments of the kernels, by the first world of each part."""
        cells = allocation.cells_of(self._sizes, self._members)
        of = (self.data, self._members, self.model, self._scanner, self._sizes, cells)
        parts = {part.start: pack(allocation.part_of(*of, part)) for part in self.parts}
        for part in self.parts:
            step_kernels.sort_worlds(parts[part.start], part.start, part.stop)
        return parts

    def sort_bodies(self) -> None:
        """Sort bodies into cells anew, after obstacles in `data` were put elsewhere."""
        for part in self.parts:
            step_kernels.sort_worlds(self.packed[part.start], part.start, part.stop)

    def put_bodies(self, bodies: Array) -> None:
        """Put the obstacles of the first world at (K, 7), in the format of scenes.

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
        past[:, TWIST : TWIST + 3] = 0.0
        body = place(pose, self.footprint.radius, self._in_table[-1])
        self.data.bodies[0, self.sampler.count + robot] = body
        self._sort_first_world()

    def _sort_first_world(self) -> None:
        step_kernels.sort_worlds(self.packed[0], 0, 1)

    def take_over(
        self, other: "FastSimulator", robots: Indices, obstacles: Indices
    ) -> None:
        """Go on with the episode of another simulator of this model, in its first world.

        `robots` are indices of the other's robots, which become the first ones here, `obstacles`
        (K,) those of its obstacles; -1 is none of them. Obstacles are put by `put_bodies`.
        """
        mine = self.data
        theirs = other.data
        poses = mine.pose[0].copy()
        poses[: len(robots)] = theirs.pose[0, robots]
        states = mine.state[0].copy()
        states[: len(robots)] = theirs.state[0, robots]
        for m, (pose, state) in enumerate(zip(poses, states, strict=True)):
            self.put_robot(m, pose, state)
        for name in OF_ROBOT:
            getattr(mine, name)[0, : len(robots)] = getattr(theirs, name)[0, robots]
        for name in ("steps", "seeds", "member"):
            getattr(mine, name)[0] = getattr(theirs, name)[0]
        kept = obstacles >= 0
        for name in ("velocity", "marks"):
            getattr(mine, name)[0, kept] = getattr(theirs, name)[0, obstacles[kept]]

    def __getstate__(self) -> dict[str, Any]:  # a copy rebuilds the rest
        rebuilt = ("_members", "packed", "_renders")
        return {
            name: value for name, value in vars(self).items() if name not in rebuilt
        }

    @cached_property
    def _renders(self) -> dict[str, Render]:
        around = SensedWorlds(
            self.data,
            self._scanner.table.shapes,
            self.sampler.count,
            self._members.fixtures,
            self._scanner.renderer,
        )
        return {sensor.name: sensor.renderer(around) for sensor in self.model.sensors}

    def sense(self, worlds: Indices) -> None:
        """Render the readings of the further sensors in some worlds (n,)."""
        for name, render in self._renders.items():
            render(self.readings[name], worlds)

    def reset(
        self,
        seeds: ArrayLike,
        worlds: ArrayLike | None = None,
        starts: Starts = None,
    ) -> Scenes:
        """Begin episodes in `worlds` (n,), all by default, at `starts` (n, M, 3) if given.

        They may follow from the scenes that were drawn, by a function.
        A seed (n,) fixes scene, start, goal, noise and randomisation. The obstacles of the scenes
        are in the order of `data`; in that of `scenes` only if they are few or move. Threads may
        call it in parallel for different parts. Raises ConfigError if seeds, starts or a scene do
        not fit.
        """
        chosen = self._choose_worlds(worlds)
        scenes, draws = self.episodes.draw(seeds)
        given = starts(scenes) if callable(starts) else starts
        begin = scenes.starts if given is None else np.asarray(given, dtype=np.float64)
        if len(scenes) != len(chosen) or begin.shape != scenes.starts.shape:
            needed = f"{len(chosen)} worlds with {self.data.pose.shape[1]} robots each."
            raise ConfigError(
                f"{len(scenes)} seeds and starts {begin.shape} must be of {needed}"
            )
        self._place(chosen, np.asarray(seeds, dtype=np.int64), scenes, begin, draws)
        for part in self.parts:
            of_part = chosen[(chosen >= part.start) & (chosen < part.stop)]
            if len(of_part):
                step_kernels.begin(self.packed[part.start], of_part)
                self.sense(of_part)
        if self.sampler.count < allocation.STANDING:
            return scenes
        return Scenes(
            self.obstacles_of(chosen), scenes.starts, scenes.goals, scenes.member
        )

    def _choose_worlds(self, worlds: ArrayLike | None) -> Indices:
        """Return the indices of the worlds to reset; kernels do not check them."""
        count = len(self.data.steps)
        if worlds is None:
            return np.arange(count)
        given = np.asarray(worlds)
        whole = given.size == 0 or given.dtype.kind in "iu"
        if given.ndim == 1 and whole:
            listed = given.tolist()
            inside = all(0 <= n < count for n in listed)
            if inside and len(set(listed)) == len(listed):
                return given.astype(np.int64)
        raise ConfigError(
            f"worlds {np.array2string(given, threshold=10)} must be indices from 0 to {count - 1}, "
            "each at most once."
        )

    def scenes(self, seeds: ArrayLike) -> Scenes:
        """Return the scenes that `reset` would begin with for seeds (n,)."""
        return self.episodes.draw(seeds)[0]

    @property
    def obstacles(self) -> Array:
        """(N, K, 7) the obstacles at their present poses, in the format of `scenes`."""
        return self.obstacles_of(np.arange(len(self.data.steps)))

    def obstacles_of(self, worlds: Indices) -> Array:
        """(n, K, 7) those of some worlds (n,)."""
        bodies = self.data.bodies[worlds, : self.sampler.count]
        of_obstacles = self._in_table[:-1]
        index = np.zeros(int(self._in_table.max()) + 1)
        # Equal shapes share a place in the table; in reverse, because the first of them is meant.
        index[of_obstacles[::-1]] = np.arange(len(of_obstacles))[::-1]
        bodies[..., SHAPE] = index[bodies[..., SHAPE].astype(np.int64)]
        return bodies

    def _place(
        self,
        chosen: Indices,
        seeds: Indices,
        scenes: Scenes,
        starts: Array,
        draws: Draws | None,
    ) -> None:
        data = self.data
        data.pose[chosen] = starts
        data.odom[chosen] = starts
        for name in ("state", "history", "twist", "collided", "steps", "velocity"):
            getattr(data, name)[chosen] = 0
        data.seeds[chosen], data.member[chosen] = seeds, scenes.member
        count = self.sampler.count
        shapes = scenes.bodies[..., SHAPE].astype(np.int64)
        data.bodies[chosen, :count] = scenes.bodies
        data.bodies[chosen, :count, SHAPE] = self._in_table[shapes]
        data.bodies[chosen, count:] = place(
            starts, self.footprint.radius, self._in_table[-1]
        )
        self.goals[chosen] = scenes.goals
        if draws is None:
            return
        data.coefficient[chosen], data.noise[chosen] = draws.coefficient, draws.noise
        data.delay[chosen], data.age[chosen] = draws.delay, draws.age
        data.faults[chosen] = draws.faults
        for name, values in draws.named().items():
            if name not in self.drawn:
                self.drawn[name] = np.zeros(
                    (len(data.steps), *values.shape[1:]), values.dtype
                )
            self.drawn[name][chosen] = values

    def step(self, commands: ArrayLike) -> None:
        """Move every world by one control period under commands (N, M, C), see `data`."""
        checked = self._checked(slice(0, len(self.data.steps)), commands)
        self.run_parts(lambda part: self._step(part, checked[part]))

    def run_parts(self, function: Callable[[slice], R]) -> list[R]:
        """Run a function for each of `parts`, one thread per part; return the results."""
        return run_parts(function, self.parts)

    def step_part(self, part: slice, commands: ArrayLike) -> None:
        """Move the worlds of one of `parts` under commands (n, M, C), in the calling thread."""
        self._step(part, self._checked(part, commands))

    def _step(self, part: slice, commands: Array) -> None:
        step_kernels.step_worlds(self.packed[part.start], commands, part.start)
        if self.readings:
            self.sense(np.arange(part.start, part.stop))

    def _checked(self, part: slice, commands: ArrayLike) -> Array:
        checked = np.ascontiguousarray(commands, dtype=np.float64)
        robots, _, width = self.data.history.shape[1:]
        expected = (part.stop - part.start, robots, width)
        if checked.shape != expected:
            needed = f"they must be {expected}: worlds, robots, and a robot's commands."
            raise ConfigError(f"commands are {checked.shape}; {needed}")
        if self.data.steps[part.start] % CHECK_INTERVAL == 0:
            self._command_range.check(checked)
        return checked
