"""Robots in MuJoCo: one on an infinite floor, or several in a world, like FastSimulator."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.mujoco import scenery
from nics_drl_bridge.extras.mujoco.machines import (
    Machine,
    Physics,
    build_machine,
    load_mujoco,
)
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import Integers
from nics_drl_bridge.lidar.exact_kernels import RADIUS
from nics_drl_bridge.lidar.scanner import Renderer
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.recording.textbook import HOLD_S, ROW_S
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.device import DrivenSimulator
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator, Starts
from nics_drl_bridge.sim.world_set import AnyWorld

# approximate period of encoder readings and of updates of moving obstacles
ENCODER_PERIOD_S = 0.01
LARGEST_TILT_RAD = 0.5
SETTLING_S = 0.5
MOTION = ("pose", "twist", "state")


@dataclass(frozen=True)
class Reading:
    """State of a robot at one time."""

    time: float  # time since the reset [s]
    pose: Array  # (3,) of `base_link`: x [m], y [m], heading [rad]
    twist: Array  # (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`
    state: Array  # (S,) measured by encoders, in the order of the RobotSpec


class Rig:
    """Access to machine `number` in the arrays of a MuJoCo model."""

    def __init__(
        self, spec: RobotSpec, machine: Machine, model: Any, number: int = 0
    ) -> None:
        self.spec = spec
        self.machine = machine
        self._target = textbook(spec).target
        prefix = scenery.make_prefix(number)
        base = model.joint(int(model.body(f"{prefix}base_link").jntadr[0]))
        joints = [model.joint(f"{prefix}{name}") for name in machine.joints]
        self._place = int(base.qposadr[0])
        self._drift = int(base.dofadr[0])
        self._positions = np.array([int(joint.qposadr[0]) for joint in joints])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in joints])
        count = len(machine.controls(self._target(np.zeros(len(spec.command)))))
        self._controls = slice(number * count, (number + 1) * count)

    def put(self, data: Any, rest: Array, pose: ArrayLike) -> None:
        """Places the robot at a pose (3,) on the floor, with its parts at rest (nq,)."""
        x, y, heading = np.asarray(pose, dtype=np.float64)
        positions = data.qpos[self._place : self._place + len(rest)]
        positions[:] = rest
        positions[:2] = x, y
        positions[3:7] = np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)

    def launch(self, data: Any, rest: Array, twist: Array, heading: float) -> None:
        """Gives the body a twist (3,), and its parts no speed relative to the body."""
        speeds = data.qvel[self._drift : self._drift + len(rest) - 1]
        speeds[:] = 0.0
        speeds[:2] = geometry.rotate(twist[:2], heading)
        speeds[5] = twist[2]

    def motion(self, data: Any, rest: Array) -> tuple[Array, Array]:
        """Returns copies of positions (nq,) and speeds (nq - 1,) of the body and all its parts."""
        positions = data.qpos[self._place : self._place + len(rest)]
        return positions.copy(), data.qvel[
            self._drift : self._drift + len(rest) - 1
        ].copy()

    def resume(self, data: Any, motion: tuple[Array, Array]) -> None:
        """Continues with the motion of another rig of this machine."""
        positions, speeds = motion
        data.qpos[self._place : self._place + len(positions)] = positions
        data.qvel[self._drift : self._drift + len(speeds)] = speeds

    def command(self, data: Any, command: ArrayLike) -> None:
        """Sets the motors to a command (C,), clipped to its limits. Raises BackendError for NaN."""
        command = np.asarray(command, dtype=np.float64)
        count = len(self.spec.command)
        if command.shape != (count,) or not np.isfinite(command).all():
            reason = f"must be {count} finite numbers, as robot {self.spec.name!r} takes them."
            raise BackendError(f"command {command.tolist()} {reason}")
        wanted = self._target(
            np.clip(command, self.spec.command_low, self.spec.command_high)
        )
        data.ctrl[self._controls] = self.machine.controls(wanted)

    def read(self, data: Any) -> Reading:
        """Returns the current reading."""
        place = data.qpos[self._place :]
        velocity = data.qvel[self._drift :]
        heading = self.heading(data)
        ahead, aside = geometry.rotate(velocity[:2], -heading)
        return Reading(
            time=float(data.time),
            pose=np.array([place[0], place[1], heading]),
            twist=np.array([ahead, aside, velocity[5]]),
            state=self.machine.state(
                data.qpos[self._positions], data.qvel[self._speeds]
            ),
        )

    def heading(self, data: Any) -> float:
        """Returns the heading [rad]."""
        w, x, y, z = data.qpos[self._place + 3 : self._place + 7]
        return float(
            geometry.wrap_angle(
                np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            )
        )

    def encoders(self, data: Any) -> Array:
        """Returns the positions (J,) of the joints with encoders [rad]."""
        return np.array(data.qpos[self._positions])

    def require_upright(self, data: Any) -> None:
        """Raises BackendError if the robot has fallen over."""
        x, y = data.qpos[self._place + 4 : self._place + 6]
        if not 1.0 - 2.0 * (x * x + y * y) > np.cos(LARGEST_TILT_RAD):
            fix = "lower the acceleration of its Physics, or its command limits."
            when = f"at {data.time:.2f} s"
            raise BackendError(
                f"robot {self.spec.name!r} has fallen over {when}; {fix}"
            )


class MujocoRobot:
    """A robot on an infinite floor, moved by motors and contact; see `build_machine`."""

    def __init__(self, spec: RobotSpec, physics: Physics | None = None) -> None:
        self._mujoco = load_mujoco()
        self.spec = spec
        self.machine: Machine = build_machine(spec, physics)
        self._model = self._mujoco.MjModel.from_xml_string(self.machine.xml)
        self._data = self._mujoco.MjData(self._model)
        self._rig = Rig(spec, self.machine, self._model)
        self.timestep = float(self._model.opt.timestep)
        self._advance(SETTLING_S)
        # (nq,) MuJoCo positions at rest at the origin
        self.rest = self._data.qpos.copy()
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> Reading:
        """Places the robot at a pose (3,), at rest and settled, and restarts the clock."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._rig.put(self._data, self.rest, pose)
        self._mujoco.mj_forward(self._model, self._data)
        return self.read()

    def step(self, command: ArrayLike, duration: float) -> Reading:
        """Drives with a command (C,), clipped, for a duration [s] in whole time steps.

        Raises BackendError.
        """
        self._rig.command(self._data, command)
        self._advance(duration)
        self._rig.require_upright(self._data)
        return self.read()

    def read(self) -> Reading:
        """Returns the current reading."""
        return self._rig.read(self._data)

    def _advance(self, duration: float) -> None:
        self._mujoco.mj_step(
            self._model, self._data, nstep=round(duration / self.timestep)
        )


class MujocoSimulator(DrivenSimulator):
    """One world of robots in MuJoCo with motors, wheels and contact, seeded like FastSimulator.

    Commands act on motors with their own lag, so the model's latency is not added. A randomisation
    adds its latency, but its factors on the model's kinematics have no effect. Raises ConfigError
    if MuJoCo, textbook kinematics, a parameter of the machine or free space is missing.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        robots: int = 1,
        renderer: Renderer = defaults.MUJOCO_RENDERER,
        physics: Physics | None = None,
        randomisation: Randomisation | None = None,
    ) -> None:
        self._mujoco = load_mujoco()
        physics = physics or Physics()
        self._subperiods, self._steps, timestep = divide(
            model.control_period, physics.timestep
        )
        self._physics = replace(physics, timestep=timestep)
        alone = MujocoRobot(model.robot, self._physics)
        self._machine = alone.machine
        self._rest = alone.rest
        self._twist = textbook(model.robot).twist
        drawn: Any = {"renderer": renderer, "randomisation": randomisation}
        super().__init__(model, world, robots=robots, **drawn)
        self.reset([0])

    def reset(
        self, seeds: ArrayLike, worlds: ArrayLike | None = None, starts: Starts = None
    ) -> Scenes:
        """Starts the episode of a seed (1,) at poses (1, M, 3); see `FastSimulator.reset`."""
        scenes = super().reset(seeds, worlds, starts)
        self._compile(scenes.bodies[0])
        for rig, pose in zip(self._rigs, self.data.pose[0], strict=True):
            rig.put(self._data, self._rest, pose)
        self._mujoco.mj_forward(self._simulation, self._data)
        return scenes

    def put_bodies(self, bodies: Array) -> None:
        """Puts the obstacles, see `FastSimulator.put_bodies`, and recompiles the scene."""
        super().put_bodies(bodies)
        motions = [rig.motion(self._data, self._rest) for rig in self._rigs]
        self._compile(bodies)
        self._resume(motions)

    def put_robot(self, robot: int, pose: Array, state: Array) -> None:
        """Puts a robot, see `FastSimulator.put_robot`; the motors bring its wheels up to speed."""
        super().put_robot(robot, pose, state)
        rig = self._rigs[robot]
        rig.put(self._data, self._rest, pose)
        rig.launch(self._data, self._rest, self._twist(state), pose[2])
        self._mujoco.mj_forward(self._simulation, self._data)

    def take_over(
        self, source: FastSimulator, robots: Integers, obstacles: Integers
    ) -> None:
        """Continues the episode of another simulator; see `FastSimulator.take_over`."""
        super().take_over(source, robots, obstacles)
        if isinstance(source, MujocoSimulator):
            self.wheels[: len(robots)] = source.wheels[robots]
            self._resume(
                [source._rigs[r].motion(source._data, self._rest) for r in robots]
            )

    def _resume(self, motions: Sequence[tuple[Array, Array]]) -> None:
        for rig, motion in zip(self._rigs, motions, strict=False):
            rig.resume(self._data, motion)
        self._mujoco.mj_forward(self._simulation, self._data)

    def _compile(self, bodies: Array) -> None:
        """Compiles the scene with obstacles (K, 7); the robots must be placed afterwards."""
        spec = self.model.robot
        robots = self.data.pose.shape[1]
        member = int(self.data.member[0])
        compiled = self._simulation = scenery.compile_scene(
            self._mujoco,
            self._machine,
            self._physics,
            footprint_shape(spec),
            robots,
            self.world.members[member],
            self.sampler.motions[member],
            self.sampler.shapes,
            bodies,
        )
        self._data = self._mujoco.MjData(compiled)
        self._rigs = [Rig(spec, self._machine, compiled, m) for m in range(robots)]
        there = np.flatnonzero(bodies[:, RADIUS] > 0.0).tolist()
        ids = [
            int(compiled.body(f"{scenery.OBSTACLE_NAME}{k}").mocapid[0]) for k in there
        ]
        self._mocap = [(k, one) for k, one in zip(there, ids, strict=True) if one >= 0]
        self._bumper_of = scenery.find_bumpers(compiled, robots)

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
                rig.require_upright(self._data)
        if any(warning.number for warning in self._data.warning):
            what = f"the motion of robot {self.model.robot.name!r} diverges"
            fix = "shorten the timestep of its Physics."
            raise BackendError(
                f"MuJoCo warns at {self._data.time:.2f} s that {what}; {fix}"
            )

    def _move(self) -> None:
        rigs = self._rigs
        data = self._data
        part_s = self.model.control_period / self._subperiods
        wheels = self.wheels.copy()
        counted = np.zeros((len(rigs), 3))
        touched = np.zeros(len(rigs), np.bool_)
        turned = [rig.encoders(data) for rig in rigs]
        facing = [rig.heading(data) for rig in rigs]
        for part in range(self._subperiods):
            for rig, command in zip(rigs, self.in_force(part * part_s), strict=True):
                rig.command(data, command)
            bodies = self.move_obstacles((part + 1) * part_s)
            for k, mocap in self._mocap:
                data.mocap_pos[mocap, :2] = bodies[k, :2]
                data.mocap_quat[mocap] = scenery.make_quaternion(bodies[k, 2])
            self._mujoco.mj_step(self._simulation, data, nstep=self._steps)
            bumped = self._bumper_of[data.contact.geom.ravel()]
            touched[bumped[bumped >= 0]] = True
            before = turned
            turned = [rig.encoders(data) for rig in rigs]
            faced = facing
            facing = [rig.heading(data) for rig in rigs]
            pairs = zip(before, turned, strict=True)
            mean = self._machine.state
            means = [
                mean(0.5 * (first + last), (last - first) / part_s)
                for first, last in pairs
            ]
            counted = self._twist(np.array(means)) * self._machine.calibrated
            if self._machine.gyro:
                counted[:, 2] = geometry.wrap_angle(np.subtract(facing, faced)) / part_s
            wheels = geometry.compose(wheels, geometry.exp(counted * part_s))
        readings = [rig.read(data) for rig in rigs]
        pose, twist, state = (
            np.array([getattr(r, n) for r in readings]) for n in MOTION
        )
        self.end_period(pose, twist, state, wheels, counted, touched)


def divide(period: float, longest: float) -> tuple[int, int, float]:
    """Divides a period: returns parts of about `ENCODER_PERIOD_S`, steps per part, step [s]."""
    parts = max(1, round(period / ENCODER_PERIOD_S))
    steps = max(1, math.ceil(period / parts / longest - 1e-6))
    return parts, steps, period / parts / steps


def record(
    robot: MujocoRobot,
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
        source=f"MuJoCo {spec.name}",
        variables=spec.variable_names,
        measured_by="truth",
    )
