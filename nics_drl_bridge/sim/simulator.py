"""FastSimulator: N worlds x M robots of one SimulatorModel in one set of arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.lidar.baking import with_shapes
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.sim import kernels
from nics_drl_bridge.sim.validity import CommandBox, OutsideValidityWarning
from nics_drl_bridge.sim.world import Scene, World, sample_scene
from nics_drl_bridge.sim.worlds import SLICES, Sizes, Worlds, allocate, arguments, split
from nics_drl_bridge.threads import Crew

__all__ = ["SLICES", "FastSimulator", "OutsideValidityWarning", "Worlds"]

Array = NDArray[np.float64]
R = TypeVar("R")


class FastSimulator:
    """The simulator that a SimulatorModel describes, in a world.

    A world comes to the same bits in a batch of any size and with any number of threads.

    Args:
        model: the robot: motion, lidar, noise.
        world: the field and its obstacles.
        worlds: N.
        robots: M in each world. They see and touch each other.
        renderer: `auto`, `baked` or `exact`, see `lidar.scanner.Scanner`.
        threads: so many parts of the worlds are moved at the same time.
        longest_delay: greatest latency of commands that `data.delay` may be given [substeps]; the
            model's by default.
        longest_age: greatest age of scan and odometry that `data.age` may be given [substeps].

    Attributes:
        data: all that changes, see `Worlds`.
        goals: (N, M, 2) of the episodes [m].
        parts: the worlds that each thread moves.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        worlds: int = 1,
        robots: int = 1,
        renderer: Renderer = "auto",
        threads: int = 1,
        longest_delay: int | None = None,
        longest_age: int = 0,
    ) -> None:
        if worlds < 1 or robots < 1:
            raise ConfigError(
                f"a simulator needs at least 1 world and 1 robot, not {worlds} and {robots}."
            )
        delay = model.timing[2] if longest_delay is None else longest_delay
        if threads < 1 or delay < model.timing[2] or longest_age < 0:
            raise ConfigError(
                f"a simulator needs at least 1 thread, a longest_delay of at least the model's "
                f"{model.timing[2]} substeps and a longest_age of at least 0, not {threads}, "
                f"{delay} and {longest_age}."
            )
        self.model, self.world = model, world
        self.goals: Array = np.zeros((worlds, robots, 2))
        self._footprint = footprint_shape(model.robot)
        table = with_shapes(model.lidar, model.table, (*world.shapes, self._footprint))
        self._scanner = Scanner(model.lidar, table, renderer, world.grid)
        self._sizes = Sizes(worlds, robots, world.obstacles.count, delay, longest_age)
        self.data = allocate(model, self._sizes)
        self.parts = split(worlds, threads)
        self._boxes = {part.start: CommandBox(model.kinematics, model.robot) for part in self.parts}
        self._crew = Crew(len(self.parts))

    @cached_property
    def _packed(self) -> dict[int, Any]:
        """What the kernels take, by the first world of each part."""
        walls = self.world.all_walls()
        of = (self.data, self.model, self._scanner, walls, self._sizes)
        return {part.start: kernels.pack(arguments(*of, part)) for part in self.parts}

    def __getstate__(self) -> dict[str, Any]:
        """All but what a copy has to make anew."""
        return {name: value for name, value in vars(self).items() if name != "_packed"}

    def reset(
        self,
        seeds: Sequence[int],
        worlds: Sequence[int] | None = None,
        starts: ArrayLike | None = None,
    ) -> list[Scene]:
        """Begins episodes.

        Args:
            seeds: of each episode (n,); a seed fixes scene, start, goal and noise.
            worlds: which worlds begin anew (n,), all by default.
            starts: (n, M, 3) poses to begin at instead of the scene's.

        Returns:
            The scene of each.
        """
        chosen = np.arange(len(self.data.steps)) if worlds is None else np.asarray(worlds, np.int64)
        scenes = []
        for row, (n, seed) in enumerate(zip(chosen, seeds, strict=True)):
            scene = sample_scene(
                self.world, self.model.robot.footprint_radius, int(seed), self.data.pose.shape[1]
            )
            start = scene.starts if starts is None else np.asarray(starts, dtype=np.float64)[row]
            self._place(int(n), int(seed), scene, start)
            scenes.append(scene)
        for box in self._boxes.values():
            box.begin()
        kernels.look(self._packed[0], chosen)
        return scenes

    def _place(self, n: int, seed: int, scene: Scene, start: Array) -> None:
        data, robots = self.data, self.data.pose.shape[1]
        data.pose[n], data.odom[n] = start, start
        for zeroed in (data.state, data.history, data.twist, data.collided, data.steps):
            zeroed[n] = 0
        data.seeds[n] = seed
        discs = [Circle(radius=float(radius)) for radius in scene.circles[:, 2]]
        still = np.concatenate([scene.circles[:, :2], np.zeros((len(discs), 1))], axis=1)
        data.bodies[n, :-robots] = self._scanner.place(discs, still)
        data.bodies[n, -robots:] = self._scanner.place([self._footprint] * robots, start)
        self.goals[n] = scene.goals

    def step(self, commands: ArrayLike) -> None:
        """Moves every world by one control period; the results are in `data`.

        Args:
            commands: (N, M, C) in the units and the order of the RobotSpec.
        """
        commands = np.ascontiguousarray(commands, dtype=np.float64)
        self._check_shape(commands, len(self.data.steps))
        self._boxes[0].check(commands)
        if len(self.parts) == 1:
            kernels.step_worlds(self._packed[0], commands, 0)
        else:
            self.run_parts(
                lambda part: kernels.step_worlds(
                    self._packed[part.start], commands[part], part.start
                )
            )

    def run_parts(self, function: Callable[[slice], R]) -> list[R]:
        """What a function gives for each of `parts`, each run by a thread of its own."""
        return self._crew.run(function, self.parts)

    def step_part(self, part: slice, commands: ArrayLike) -> None:
        """Moves the worlds of one part by one control period, in the thread that calls.

        Args:
            part: one of `parts`; different ones may be moved at the same time.
            commands: (n, M, C) of the worlds of the part.
        """
        commands = np.ascontiguousarray(commands, dtype=np.float64)
        self._check_shape(commands, part.stop - part.start)
        self._boxes[part.start].check(commands)
        kernels.step_worlds(self._packed[part.start], commands, part.start)

    def _check_shape(self, commands: Array, worlds: int) -> None:
        """Raises ConfigError where the kernels would read beyond the commands."""
        robots, _, width = self.data.history.shape[1:]
        if commands.shape != (worlds, robots, width):
            raise ConfigError(
                f"commands are {commands.shape}; they must be {(worlds, robots, width)}: worlds, "
                "robots, and a robot's commands."
            )
