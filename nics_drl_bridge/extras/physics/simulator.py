"""Robots of a physics engine: one on an infinite floor, or several in a world."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.physics.driven import DrivenSimulator
from nics_drl_bridge.extras.physics.machines import Machine, Physics, design_machine
from nics_drl_bridge.extras.physics.scenery import Box, Obstacle, cut_world
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.arrays import Integers, Singles
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import HOLD_S, ROW_S
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator, Starts
from nics_drl_bridge.sim.world_set import AnyWorld

# approximate period of encoder readings and of updates of moving obstacles
ENCODER_PERIOD_S = 0.01
LARGEST_TILT_RAD = 0.5


@dataclass(frozen=True)
class Reading:
    """State of a robot at one time."""

    time: float  # time since the reset [s]
    pose: Array  # (3,) of `base_link`: x [m], y [m], heading [rad]
    twist: Array  # (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`
    state: Array  # (S,) measured by encoders, in the order of the RobotSpec


class Rig(ABC):
    """Access to one machine in an engine."""

    def __init__(self, spec: RobotSpec, machine: Machine) -> None:
        self.spec = spec
        self.machine = machine
        self._target = textbook(spec).target

    @abstractmethod
    def put(self, pose: ArrayLike) -> None:
        """Places the robot at a pose (3,) on the floor, with its parts at rest."""

    @abstractmethod
    def launch(self, twist: Array, state: Array) -> None:
        """Gives the body a twist (3,); motors may continue at a state (S,)."""

    @abstractmethod
    def motion(self) -> Any:
        """Returns positions and speeds of the body and all its parts, for `resume`."""

    @abstractmethod
    def resume(self, motion: Any) -> None:
        """Continues with the motion of another rig of this machine."""

    @abstractmethod
    def drive(self, wanted: Array) -> None:
        """Sets the motors to a state (S,)."""

    @abstractmethod
    def read(self) -> Reading:
        """Returns the current reading."""

    @abstractmethod
    def heading(self) -> float:
        """Returns the heading [rad]."""

    @abstractmethod
    def encoders(self) -> Array:
        """Returns the positions (J,) of the joints with encoders [rad]."""

    @abstractmethod
    def cosine_of_tilt(self) -> float:
        """Returns the cosine of the angle between the robot and the vertical."""

    def command(self, command: ArrayLike) -> None:
        """Sets the motors to a command (C,), clipped to its limits. Raises BackendError for NaN."""
        command = np.asarray(command, dtype=np.float64)
        count = len(self.spec.command)
        if command.shape != (count,) or not np.isfinite(command).all():
            reason = f"must be {count} finite numbers, as robot {self.spec.name!r} takes them."
            raise BackendError(f"command {command.tolist()} {reason}")
        clipped = np.clip(command, self.spec.command_low, self.spec.command_high)
        self.drive(self._target(clipped))

    def require_upright(self) -> None:
        """Raises BackendError if the robot has fallen over."""
        if not self.cosine_of_tilt() > np.cos(LARGEST_TILT_RAD):
            fix = "lower the acceleration of its Physics, or its command limits."
            when = f"at {self.read().time:.2f} s"
            raise BackendError(
                f"robot {self.spec.name!r} has fallen over {when}; {fix}"
            )


class ServoRig(Rig):
    """A rig whose motors are speed servos, with new set points before each time step.

    The speeds follow a wanted state with the motors' lags. A differential between driven wheels
    gives each wheel the speed for its turning radius.
    """

    def __init__(self, spec: RobotSpec, machine: Machine, timestep: float) -> None:
        super().__init__(spec, machine)
        self._timestep = timestep
        self._follows = -np.expm1(-timestep / np.array(machine.lags))
        self._stop_motors()

    def _stop_motors(self) -> None:
        self._wanted = np.zeros(len(self.machine.lags))
        self._followed = np.zeros(len(self.machine.lags))

    @abstractmethod
    def set_speeds(self, speeds: Array) -> None:
        """Sets the speeds (J,) of the joints with encoders [rad/s]."""

    def drive(self, wanted: Array) -> None:
        """See `Rig`."""
        self._wanted = wanted

    def turn_wheels(self) -> None:
        """Sets the speeds of the joints for the next time step."""
        missing = self._wanted - self._followed
        self._followed = self._followed + self._follows * missing
        speeds = self.machine.controls(self._followed)
        if self.machine.kind == "ackermann":
            split = self.machine.half_ratio * np.tan(self._followed[1])
            engine, *angles = speeds
            turning = (angles - self.encoders()[2:]) / self._timestep
            wheels = engine * (1.0 - split), engine * (1.0 + split)
            speeds = np.array([*wheels, *turning])
        self.set_speeds(speeds)


class PhysicsRobot(ABC):
    """A robot on an infinite floor, moved by motors and contact."""

    engine: str  # name of the engine
    spec: RobotSpec
    machine: Machine
    timestep: float  # [s]
    rig: Any  # a Rig

    @abstractmethod
    def reset(self, pose: ArrayLike) -> Reading:
        """Places the robot at a pose (3,), at rest and settled, and restarts the clock."""

    @abstractmethod
    def advance(self, steps: int) -> None:
        """Moves by whole time steps."""

    def step(self, command: ArrayLike, duration: float) -> Reading:
        """Drives with a command (C,), clipped, for a duration [s] in whole time steps.

        Raises BackendError.
        """
        self.rig.command(command)
        self.advance(round(duration / self.timestep))
        self.rig.require_upright()
        return self.read()

    def read(self) -> Reading:
        """Returns the current reading."""
        reading: Reading = self.rig.read()
        return reading


class PhysicsSimulator(DrivenSimulator, ABC):
    """One world of robots with motors, wheels and contact, seeded like FastSimulator.

    Commands act on motors with their own lag, so the model's latency is not added. A randomisation
    adds its latency, but its factors on the model's kinematics have no effect. Raises ConfigError
    if textbook kinematics, a parameter of the machine or free space is missing.
    """

    engine: str  # name of the engine
    usual_physics: Physics

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        robots: int = 1,
        renderer: Renderer = defaults.MUJOCO_RENDERER,
        physics: Physics | None = None,
        randomisation: Randomisation | None = None,
    ) -> None:
        physics = physics or self.usual_physics
        self._subperiods, self._steps, timestep = divide(
            model.control_period, physics.timestep
        )
        self._physics = replace(physics, timestep=timestep)
        self._machine = design_machine(model.robot, self._physics, self.engine)
        self._twist = textbook(model.robot).twist
        super().__init__(
            model,
            world,
            robots=robots,
            renderer=renderer,
            randomisation=randomisation,
        )
        self.reset([0])

    @abstractmethod
    def compile(self, bodies: Array) -> list[Any]:
        """Builds the scene with obstacles (K, 7); returns the robots' rigs, not yet placed."""

    def list_walls(self) -> Iterator[Box]:
        """Yields the walls and the map of this episode's world."""
        return cut_world(self.world.members[int(self.data.member[0])])

    def list_obstacles(self, bodies: Array) -> Iterator[Obstacle]:
        """Yields the obstacles that there are among bodies (K, 7)."""
        motions = self.sampler.motions[int(self.data.member[0])]
        for k in np.flatnonzero(bodies[:, RADIUS] > 0.0).tolist():
            shape = self.sampler.shapes[int(bodies[k, SHAPE])]
            yield Obstacle(k, shape, bodies[k, :3], motions[k] is not None)

    def refresh(self) -> None:
        """Updates derived values after the robots were placed."""

    @abstractmethod
    def place_obstacles(self, bodies: Array) -> None:
        """Moves the obstacles to the poses of bodies (K, 7)."""

    @abstractmethod
    def advance(self, steps: int) -> list[int]:
        """Moves by whole time steps; returns the robots that touch something, maybe repeatedly.

        Raises BackendError if the engine diverges.
        """

    def reset(
        self, seeds: ArrayLike, worlds: ArrayLike | None = None, starts: Starts = None
    ) -> Scenes:
        """Starts the episode of a seed (1,) at poses (1, M, 3); see `FastSimulator.reset`."""
        scenes = super().reset(seeds, worlds, starts)
        self._gyro_noise = np.random.default_rng(int(self.data.seeds[0]))
        self._rigs: list[Any] = self.compile(scenes.bodies[0])
        for rig, pose in zip(self._rigs, self.data.pose[0], strict=True):
            rig.put(pose)
        self.refresh()
        return scenes

    def put_bodies(self, bodies: Array) -> None:
        """Puts the obstacles, see `FastSimulator.put_bodies`, and rebuilds the scene."""
        super().put_bodies(bodies)
        motions = [rig.motion() for rig in self._rigs]
        self._rigs = self.compile(bodies)
        self._resume(motions)

    def put_robot(self, robot: int, pose: Array, state: Array) -> None:
        """Places a robot, see `FastSimulator.put_robot`; the motors accelerate its wheels."""
        super().put_robot(robot, pose, state)
        rig = self._rigs[robot]
        rig.put(pose)
        rig.launch(self._twist(state), state)
        self.refresh()

    def take_over(
        self, source: FastSimulator, robots: Integers, obstacles: Integers
    ) -> None:
        """Continues the episode of another simulator; see `FastSimulator.take_over`."""
        super().take_over(source, robots, obstacles)
        if isinstance(source, type(self)):
            self.wheels[: len(robots)] = source.wheels[robots]
            self._resume([source._rigs[r].motion() for r in robots])

    def _resume(self, motions: Sequence[Any]) -> None:
        for rig, motion in zip(self._rigs, motions, strict=False):
            rig.resume(motion)
        self.refresh()

    def step(self, commands: ArrayLike) -> None:
        """Moves by one control period with commands (1, M, C), clipped to their limits.

        Raises ConfigError, BackendError.
        """
        commands = np.asarray(commands, dtype=np.float64)
        shape = (1, len(self._rigs), len(self.model.robot.command))
        if commands.shape != shape:
            raise ConfigError(f"commands are {commands.shape}; they must be {shape}.")
        if not np.isfinite(commands).all():
            needed = f"must be finite numbers, as robot {self.model.robot.name!r} takes them."
            raise BackendError(f"commands {commands.tolist()} {needed}")
        self.begin_period(commands[0])
        self._move()
        for rig, collided in zip(self._rigs, self.data.collided[0], strict=True):
            if not collided:
                rig.require_upright()

    def _move(self) -> None:
        rigs = self._rigs
        part_s = self.model.control_period / self._subperiods
        wheels = self.wheels.copy()
        counted = np.zeros((len(rigs), 3))
        touched = np.zeros(len(rigs), np.bool_)
        before = self._read_joints()
        for part in range(self._subperiods):
            for rig, command in zip(rigs, self.in_force(part * part_s), strict=True):
                rig.command(command)
            self.place_obstacles(self.move_obstacles((part + 1) * part_s))
            touched[self.advance(self._steps)] = True
            now = self._read_joints()
            counted = self._measure_twists(before, now, part_s)
            before = now
            wheels = geometry.compose(wheels, geometry.exp(counted * part_s))
        readings = [rig.read() for rig in rigs]
        self.end_period(
            np.array([reading.pose for reading in readings]),
            np.array([reading.twist for reading in readings]),
            np.array([reading.state for reading in readings]),
            wheels,
            counted,
            touched,
        )

    def _read_joints(self) -> tuple[Array, Array]:
        """Returns the encoders' positions (M, J) and the headings (M,) of all robots."""
        joints = np.array([rig.encoders() for rig in self._rigs])
        return joints, np.array([rig.heading() for rig in self._rigs])

    def _measure_twists(
        self,
        before: tuple[Array, Array],
        now: tuple[Array, Array],
        part_s: float,
    ) -> Array:
        """Returns twists (M, 3) by wheel odometry between two results of `_read_joints`."""
        middles = 0.5 * (before[0] + now[0])
        speeds = (now[0] - before[0]) / part_s
        states = list(map(self._machine.state, middles, speeds))
        twists = self._twist(np.array(states)) * self._machine.calibrated
        if self._machine.gyro:
            rates = geometry.wrap_angle(now[1] - before[1]) / part_s
            noise = self._gyro_noise.standard_normal(len(self._rigs))
            errors = self._physics.gyro_bias + self._physics.gyro_noise * noise
            twists[:, 2] = rates + errors
        return np.asarray(twists)


class RayCastingSimulator(PhysicsSimulator):
    """A PhysicsSimulator whose engine also casts the lidar's rays.

    Late or skewed scans are those of the FastSimulator, because they depend on past poses.
    """

    @abstractmethod
    def cast_scan(self, robot: int) -> Singles:
        """Returns the scan (B,) of a robot from its present pose [m], without noise."""

    def step(self, commands: ArrayLike) -> None:
        """See `PhysicsSimulator`."""
        super().step(commands)
        self._scan()

    def reset(
        self, seeds: ArrayLike, worlds: ArrayLike | None = None, starts: Starts = None
    ) -> Scenes:
        """Starts the episode of a seed (1,) at poses (1, M, 3); see `FastSimulator.reset`."""
        scenes = super().reset(seeds, worlds, starts)
        self._scan()
        return scenes

    def _scan(self) -> None:
        data = self.data
        lidar = self.model.lidar
        limits = lidar.range_min, lidar.range_max
        robots = data.ranges.shape[1]
        for m in range(robots):
            faults = data.faults[0, m]
            if data.age[0, m] > 0 or faults[fault_kernels.SKEW] != 0.0:
                continue
            scan = self.cast_scan(m)
            counter = int(data.steps[0]) * robots + m
            fault_kernels.distort(scan, limits, faults, int(data.seeds[0]), counter)
            data.ranges[0, m] = scan


def divide(period: float, longest: float) -> tuple[int, int, float]:
    """Divides a period: returns parts of about `ENCODER_PERIOD_S`, steps per part, step [s]."""
    parts = max(1, round(period / ENCODER_PERIOD_S))
    steps = max(1, math.ceil(period / parts / longest - 1e-6))
    return parts, steps, period / parts / steps


def record(
    robot: PhysicsRobot,
    rng: np.random.Generator,
    duration: float = defaults.DRIVE_S,
    dt: float = ROW_S,
    hold: float = HOLD_S,
) -> Recording:
    """Drives at random, with a new command every `hold` [s], and records every `dt` [s].

    Raises BackendError.
    """
    spec = robot.spec
    per_hold = round(hold / dt)
    holds = int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    commands = np.repeat(held, per_hold, axis=0)
    reading = robot.reset(np.zeros(3))
    poses = []
    states = []
    for command in commands:
        poses.append(reading.pose)
        states.append(reading.state)
        reading = robot.step(command, dt)
    t = np.asarray(np.arange(len(commands)) * dt, dtype=np.float64)
    drive = Stream(t, commands), Stream(t, np.array(poses)), Stream(t, np.array(states))
    return Recording(
        *drive,
        source=f"{robot.engine} {spec.name}",
        variables=spec.variable_names,
        measured_by="truth",
    )
