"""MujocoSimulator: robots in MuJoCo in a world, with the interface of FastSimulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.mujoco import scenery
from nics_drl_bridge.extras.mujoco.machine import Physics, load_mujoco
from nics_drl_bridge.extras.mujoco.rig import MujocoRobot, Rig
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.sim.device import Driven, DrivenSimulator
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.state import State
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]

ENCODER_PERIOD_S = 0.01
"""Approximate period of encoder readings and of updates of moving obstacles."""


class MujocoSimulator:
    """One world of robots in MuJoCo, with motors, wheels and contact.

    Scenes, moving obstacles, lidar and odometry noise are those of the FastSimulator for the same
    seed; only the robots move differently. Whatever their footprint touches blocks them. Odometry
    integrates the turns of the wheels, so it drifts if they slip. A command acts at once, on motors
    with their own lag: the model's latency is not added.

    Args:
        model: the robot, whose textbook kinematics select the machine; lidar, noise and control
            period. The fitted kinematics are not used.
        world: the field and its obstacles.
        robots: M. They see and touch each other.
        renderer: of the lidar, see `FastSimulator`.
        physics: parameters that the RobotSpec does not have; the time step is shortened so that a
            control period is a whole number of steps.

    Attributes:
        model: as given.
        world: as given.

    Raises:
        ConfigError: MuJoCo is not installed, the robot names no textbook kinematics or lacks a
            parameter of its machine, or the world has no free space left.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        robots: int = 1,
        renderer: Renderer = "auto",
        physics: Physics | None = None,
    ) -> None:
        self._mujoco = load_mujoco()
        self.model, self.world = model, world
        physics = physics or Physics()
        self._parts, self._steps, timestep = divide(model.control_period, physics.timestep)
        self._physics = replace(physics, timestep=timestep)
        alone = MujocoRobot(model.robot, self._physics)
        self._machine, self._rest = alone.machine, alone.rest
        self._twist = textbook(model.robot).twist
        self._driven = DrivenSimulator(model, world, robots, renderer)
        self.reset([0])

    @property
    def data(self) -> State:
        """All state; `pose`, `twist` and others are (1, M, ...), see `State`."""
        return self._driven.fast.data

    @property
    def goals(self) -> Array:
        """(1, M, 2) goals of the episode [m]."""
        return self._driven.fast.goals

    @property
    def obstacles(self) -> Array:
        """(1, K, 7) current obstacles, see `FastSimulator.obstacles`."""
        return self._driven.fast.obstacles

    def scenes(self, seeds: ArrayLike) -> Scenes:
        """Scenes that `reset` would start with for seeds (n,)."""
        return self._driven.fast.scenes(seeds)

    def reset(self, seeds: ArrayLike, starts: ArrayLike | None = None) -> Scenes:
        """Begins an episode, the same one as in a FastSimulator of this model and world.

        Args:
            seeds: (1,).
            starts: (1, M, 3) start poses instead of the scene's.

        Raises:
            ConfigError: see `FastSimulator.reset`.
        """
        scenes = self._driven.reset(seeds, starts)
        sampler = self._driven.fast.sampler
        moving = np.array([motion is not None for motion in sampler.motions], np.bool_)
        bodies = scenes.bodies[0]
        place = scenery.Scenery(
            self.world.all_walls(), self.world.grid, sampler.shapes, bodies, moving
        )
        robots = self.data.pose.shape[1]
        footprint = footprint_shape(self.model.robot)
        self._simulation = scenery.compile_scene(
            self._mujoco, self._machine, footprint, robots, place, self._physics
        )
        self._data = self._mujoco.MjData(self._simulation)
        self._find_parts(robots, moving & (bodies[:, 5] > 0.0))
        for rig, pose in zip(self._rigs, self.data.pose[0], strict=True):
            rig.put(self._data, self._rest, pose)
        self._mujoco.mj_forward(self._simulation, self._data)
        return scenes

    def _find_parts(self, robots: int, moving: NDArray[np.bool_]) -> None:
        """Looks up robots, bumpers and moving obstacles in the compiled scene."""
        compiled = self._simulation
        self._rigs = [
            Rig(self.model.robot, self._machine, compiled, scenery.prefix_of(m), m)
            for m in range(robots)
        ]
        self._mocap = [
            (k, int(compiled.body(scenery.obstacle_name(k)).mocapid[0]))
            for k in np.flatnonzero(moving).tolist()
        ]
        self._bumper_of = scenery.bumpers(compiled, robots)

    def step(self, commands: ArrayLike) -> None:
        """Moves the world by one control period; the results are in `data`.

        Args:
            commands: (1, M, C) in the units and the order of the RobotSpec; clipped to its limits.

        Raises:
            ConfigError: the commands have a wrong shape.
            BackendError: a command is NaN, or a robot has fallen over.
        """
        commands = np.asarray(commands, dtype=np.float64)
        shape = (1, self.data.pose.shape[1], len(self.model.robot.command))
        if commands.shape != shape:
            raise ConfigError(f"commands are {commands.shape}; they must be {shape}.")
        for rig, command in zip(self._rigs, commands[0], strict=True):
            rig.command(self._data, command)
        self._driven.begin_period()
        self._driven.end_period(self._move())
        self._require_sane()

    def _move(self) -> Driven:
        """Runs MuJoCo for one control period."""
        rigs, data, part_s = self._rigs, self._data, self.model.control_period / self._parts
        wheels, counted = self._driven.wheels.copy(), np.zeros((len(rigs), 3))
        touched = np.zeros(len(rigs), np.bool_)
        turned = [rig.encoders(data) for rig in rigs]
        for part in range(self._parts):
            self._place_obstacles((part + 1) * part_s)
            self._mujoco.mj_step(self._simulation, data, nstep=self._steps)
            touched[self._touching()] = True
            before, turned = turned, [rig.encoders(data) for rig in rigs]
            means = [
                rig.mean_state(first, last, part_s)
                for rig, first, last in zip(rigs, before, turned, strict=True)
            ]
            counted = self._twist(np.array(means))
            wheels = geometry.compose(wheels, geometry.exp(counted * part_s))
        readings = [rig.read(data) for rig in rigs]
        pose, twist, state = (
            np.array([getattr(reading, name) for reading in readings])
            for name in ("pose", "twist", "state")
        )
        return Driven(pose, twist, state, wheels, counted, touched)

    def _place_obstacles(self, time: float) -> None:
        bodies = self._driven.move_obstacles(time)
        for k, mocap in self._mocap:
            self._data.mocap_pos[mocap, :2] = bodies[k, :2]
            self._data.mocap_quat[mocap] = scenery.quaternion(bodies[k, 2])

    def _touching(self) -> NDArray[np.int64]:
        """Indices of the robots whose bumpers touch something now."""
        found = self._bumper_of[self._data.contact.geom.ravel()]
        return np.asarray(found[found >= 0])

    def _require_sane(self) -> None:
        """Raises BackendError for a robot that fell over without a collision, or for divergence."""
        for rig, collided in zip(self._rigs, self.data.collided[0], strict=True):
            if not collided:
                rig.require_upright(self._data)
        if any(warning.number for warning in self._data.warning):
            raise BackendError(
                f"MuJoCo warns at {self._data.time:.2f} s that the motion of robot "
                f"{self.model.robot.name!r} diverges; shorten the timestep of its Physics."
            )


def divide(period: float, longest: float) -> tuple[int, int, float]:
    """Divides a control period into time steps.

    Args:
        period: control period [s].
        longest: maximum time step of MuJoCo [s].

    Returns:
        Number of parts of about `ENCODER_PERIOD_S`, time steps per part, and the time step [s].
    """
    parts = max(1, round(period / ENCODER_PERIOD_S))
    steps = max(1, math.ceil(period / parts / longest - 1e-6))
    return parts, steps, period / parts / steps
