"""FastSimulator: N worlds x M robots of one SimulatorModel in one set of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kinematics.kernels import SERIES, scratch, term_arrays
from nics_drl_bridge.lidar.baking import with_shapes
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.shapes import BODY, SHAPE, Circle, place
from nics_drl_bridge.sim import kernels, sensing_kernels
from nics_drl_bridge.sim.scenes import Scenes, SceneSampler
from nics_drl_bridge.sim.validity import CommandBox, OutsideValidityWarning
from nics_drl_bridge.sim.world import World

__all__ = ["FastSimulator", "OutsideValidityWarning", "Worlds"]

Array = NDArray[np.float64]
SLICES = 16
"""A skewed scan is rendered in so many groups of beams."""
LANES = 256
"""So many robots move side by side: their arrays stay in the fastest cache."""


@dataclass(frozen=True)
class Worlds:
    """All that changes in a simulation; the order is that of `kernels.step_worlds`.

    Attributes:
        pose: (N, M, 3) true pose of `base_link` in `map`.
        state: (N, M, S) true state.
        history: (N, M, H, C) commands, newest first.
        bodies: (N, K + M, 7) obstacles, then robots, see `lidar.shapes.BODY`.
        odom: (N, M, 3) pose by odometry, which drifts; it begins at the start pose.
        twist: (N, M, 3) measured body twist.
        ranges: (N, M, B) scan, float32, REP-117.
        collided: (N, M) 1 once a robot has touched something.
        steps: (N,) control periods since the reset.
        seeds: (N,) of the episode.
        faults: (N, M, P) faults of each robot's lidar, columns as in `lidar.fault_kernels`; those
            of the model unless written to, as domain randomisation does. A reset keeps them.
    """

    pose: Array
    state: Array
    history: Array
    bodies: Array
    odom: Array
    twist: Array
    ranges: NDArray[np.float32]
    collided: NDArray[np.uint8]
    steps: NDArray[np.int64]
    seeds: NDArray[np.int64]
    faults: Array


class FastSimulator:
    """The simulator that a SimulatorModel describes, in a world.

    Args:
        model: the robot: motion, lidar, noise.
        world: the field and its obstacles.
        worlds: N.
        robots: M in each world. They see and touch each other.
        renderer: `auto`, `baked` or `exact`, see `lidar.scanner.Scanner`.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        worlds: int = 1,
        robots: int = 1,
        renderer: Renderer = "auto",
    ) -> None:
        if worlds < 1 or robots < 1:
            raise ConfigError(
                f"a simulator needs at least 1 world and 1 robot, not {worlds} and {robots}."
            )
        self.model, self.world = model, world
        self.goals: Array = np.zeros((worlds, robots, 2))
        self._footprint = Circle(radius=model.robot.footprint_radius)
        self.sampler = SceneSampler(world, self._footprint.radius, robots)
        shapes = (*self.sampler.shapes, self._footprint)
        table = with_shapes(model.lidar, model.table, shapes)
        self._in_table = np.array([table.outlines.index_of(shape) for shape in shapes])
        self._scanner = Scanner(model.lidar, table, renderer)
        self._walls = world.all_walls()
        drift = model.noise.simulated_drift(model.robot)
        self._noise = np.array([*model.noise.odometry, *drift])
        self._sensor = self._scanner.arguments
        self._motion = (term_arrays(model.kinematics), SERIES, model.timing)
        bodies = self.sampler.count + robots
        self._rooms = (
            (*scratch(model.kinematics), np.zeros((robots, 2))),
            self._scanner.room(bodies),
            self._make_sweep(worlds, robots),
        )
        self._lanes = self._make_lanes(worlds, robots)
        self._box = CommandBox(model.kinematics, model.robot)
        self.data = self._allocate(worlds, robots)
        self._fields: tuple[Any, ...] = tuple(vars(self.data).values())

    def _make_sweep(self, worlds: int, robots: int) -> tuple[Any, ...]:
        """What skewed scans need, see `sensing_kernels.sense`."""
        lidar, shape = self.model.lidar, (worlds, robots, 3)
        slices = 0 if lidar.faults.skew == "none" else SLICES
        part = (worlds, robots, lidar.beams if slices else 0)
        twists, poses = np.zeros(shape), np.zeros(shape)
        return lidar.sweep_time, twists, poses, np.zeros((slices, 3)), np.zeros(part, np.float32)

    def _make_lanes(self, worlds: int, robots: int) -> tuple[Array, Array, Array]:
        """Room for the robots that move side by side: pose (6, L), x (V + 1, L), dq (D, L)."""
        lanes = robots * min(worlds, max(1, LANES // robots))
        kinematics = self.model.kinematics
        x = np.ones((len(kinematics.variables) + 1, lanes))
        return np.zeros((6, lanes)), x, np.zeros((len(kinematics.dofs), lanes))

    def _allocate(self, worlds: int, robots: int) -> Worlds:
        size, width = len(self.model.robot.state), len(self.model.robot.command)
        _, substeps, delay = self.model.timing
        periods = -(-delay // substeps) + 1
        bodies = self.sampler.count + robots
        shape = (worlds, robots)
        return Worlds(
            pose=np.zeros((*shape, 3)),
            state=np.zeros((*shape, size)),
            history=np.zeros((*shape, periods, width)),
            bodies=np.zeros((worlds, bodies, BODY)),
            odom=np.zeros((*shape, 3)),
            twist=np.zeros((*shape, 3)),
            ranges=np.full((*shape, self.model.lidar.beams), np.inf, np.float32),
            collided=np.zeros(shape, np.uint8),
            steps=np.zeros(worlds, np.int64),
            seeds=np.zeros(worlds, np.int64),
            faults=np.tile(self.model.lidar.fault_parameters, (*shape, 1)),
        )

    def reset(
        self,
        seeds: Sequence[int],
        worlds: Sequence[int] | None = None,
        starts: ArrayLike | None = None,
    ) -> Scenes:
        """Begins episodes.

        Args:
            seeds: of each episode (n,); a seed fixes scene, start, goal and noise.
            worlds: which worlds begin anew (n,), all by default.
            starts: (n, M, 3) poses to begin at instead of the scenes'.

        Returns:
            The scene of each.

        Raises:
            ConfigError: the seeds or starts do not fit, or the world has no room for a scene.
        """
        chosen = np.arange(len(self.data.steps)) if worlds is None else np.asarray(worlds, np.int64)
        scenes = self.sampler.draw(seeds)
        begin = scenes.starts if starts is None else np.asarray(starts, dtype=np.float64)
        if len(scenes) != len(chosen) or begin.shape != scenes.starts.shape:
            raise ConfigError(
                f"{len(scenes)} seeds and starts {begin.shape} must be of {len(chosen)} worlds "
                f"with {self.data.pose.shape[1]} robots each."
            )
        self._place(chosen, np.asarray(seeds, dtype=np.int64), scenes, begin)
        self._box.begin()
        _, room, sweep = self._rooms
        sweep[1][chosen] = 0.0
        sensing_kernels.sense(self._fields, chosen, self._walls, self._sensor, room, sweep)
        return scenes

    def _place(
        self, chosen: NDArray[np.int64], seeds: NDArray[np.int64], scenes: Scenes, starts: Array
    ) -> None:
        data = self.data
        data.pose[chosen], data.odom[chosen] = starts, starts
        for zeroed in (data.state, data.history, data.twist, data.collided, data.steps):
            zeroed[chosen] = 0
        data.seeds[chosen] = seeds
        bodies = scenes.bodies.copy()
        bodies[..., SHAPE] = self._in_table[bodies[..., SHAPE].astype(np.int64)]
        footprints = place(starts, self._footprint.radius, self._in_table[-1])
        data.bodies[chosen] = np.concatenate([bodies, footprints], axis=1)
        self.goals[chosen] = scenes.goals

    def step(self, commands: ArrayLike) -> None:
        """Moves every world by one control period; the results are in `data`.

        Args:
            commands: (N, M, C) in the units and the order of the RobotSpec.
        """
        commands = np.ascontiguousarray(commands, dtype=np.float64)
        self._box.check(commands)
        kernels.step_worlds(
            self._fields, commands, self._walls, self.model.robot.footprint_radius,
            self._noise, self._sensor, self._lanes, self._motion, self._rooms,
        )  # fmt: skip
