"""Robots in MuJoCo: one on an infinite floor, or several in a world, like FastSimulator."""

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.extras.mujoco import scenery
from nics_drl_bridge.extras.mujoco.machines import write_mjcf
from nics_drl_bridge.extras.physics.machines import Machine, Physics, design_machine
from nics_drl_bridge.extras.physics.simulator import (
    PhysicsRobot,
    PhysicsSimulator,
    Reading,
    Rig,
)
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.spec import RobotSpec

PHYSICS = Physics()
SETTLING_S = 0.5


class MujocoRig(Rig):
    """Access to machine `number` in the arrays of a MuJoCo model."""

    def __init__(
        self,
        spec: RobotSpec,
        machine: Machine,
        model: Any,
        data: Any,
        rest: Array,
        number: int = 0,
    ) -> None:
        super().__init__(spec, machine)
        self._data = data
        self._rest = rest  # (nq,) positions at rest at the origin
        prefix = scenery.make_prefix(number)
        base = model.joint(int(model.body(f"{prefix}base_link").jntadr[0]))
        joints = [model.joint(f"{prefix}{name}") for name in machine.joints]
        self._place = slice(int(base.qposadr[0]), int(base.qposadr[0]) + len(rest))
        self._drift = slice(int(base.dofadr[0]), int(base.dofadr[0]) + len(rest) - 1)
        self._positions = np.array([int(joint.qposadr[0]) for joint in joints])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in joints])
        count = len(machine.controls(self._target(np.zeros(len(spec.command)))))
        self._controls = slice(number * count, (number + 1) * count)

    def put(self, pose: ArrayLike) -> None:
        """See `Rig`."""
        x, y, heading = np.asarray(pose, dtype=np.float64)
        positions = self._data.qpos[self._place]
        positions[:] = self._rest
        positions[:2] = x, y
        positions[3:7] = scenery.make_quaternion(heading)

    def launch(self, twist: Array, state: Array) -> None:
        """See `Rig`."""
        speeds = self._data.qvel[self._drift]
        speeds[:] = 0.0
        speeds[:2] = geometry.rotate(twist[:2], self.heading())
        speeds[5] = twist[2]

    def motion(self) -> tuple[Array, Array]:
        """See `Rig`."""
        return (
            self._data.qpos[self._place].copy(),
            self._data.qvel[self._drift].copy(),
        )

    def resume(self, motion: tuple[Array, Array]) -> None:
        """See `Rig`."""
        self._data.qpos[self._place], self._data.qvel[self._drift] = motion

    def drive(self, wanted: Array) -> None:
        """See `Rig`."""
        self._data.ctrl[self._controls] = self.machine.controls(wanted)

    def read(self) -> Reading:
        """See `Rig`."""
        x, y = self._data.qpos[self._place][:2]
        velocity = self._data.qvel[self._drift]
        heading = self.heading()
        ahead, aside = geometry.rotate(velocity[:2], -heading)
        return Reading(
            time=float(self._data.time),
            pose=np.array([x, y, heading]),
            twist=np.array([ahead, aside, velocity[5]]),
            state=self.machine.state(
                self._data.qpos[self._positions], self._data.qvel[self._speeds]
            ),
        )

    def heading(self) -> float:
        """See `Rig`."""
        w, x, y, z = self._data.qpos[self._place][3:7]
        return float(
            geometry.wrap_angle(
                np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            )
        )

    def encoders(self) -> Array:
        """See `Rig`."""
        return np.array(self._data.qpos[self._positions])

    def cosine_of_tilt(self) -> float:
        """See `Rig`."""
        x, y = self._data.qpos[self._place][4:6]
        return float(1.0 - 2.0 * (x * x + y * y))


class MujocoRobot(PhysicsRobot):
    """A robot on an infinite floor in MuJoCo."""

    engine = "MuJoCo"

    def __init__(self, spec: RobotSpec, physics: Physics = PHYSICS) -> None:
        self.spec = spec
        self.machine = design_machine(spec, physics, self.engine)
        xml = write_mjcf(self.machine, physics)
        self._model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self._model)
        self.timestep = float(self._model.opt.timestep)
        self.advance(round(SETTLING_S / self.timestep))
        # (nq,) MuJoCo positions at rest at the origin
        self.rest: Array = self._data.qpos.copy()
        self.rig = MujocoRig(spec, self.machine, self._model, self._data, self.rest)
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> Reading:
        """See `PhysicsRobot`."""
        mujoco.mj_resetData(self._model, self._data)
        self.rig.put(pose)
        mujoco.mj_forward(self._model, self._data)
        return self.read()

    def advance(self, steps: int) -> None:
        """See `PhysicsRobot`."""
        mujoco.mj_step(self._model, self._data, nstep=steps)


class MujocoSimulator(PhysicsSimulator):
    """One world of robots in MuJoCo."""

    engine = "MuJoCo"
    usual_physics = PHYSICS

    @cached_property
    def _rest(self) -> Array:
        """Positions (nq,) of one robot at rest at the origin."""
        return MujocoRobot(self.model.robot, self._physics).rest

    def compile(self, bodies: Array) -> list[Any]:
        """See `PhysicsSimulator`."""
        spec = self.model.robot
        robots = self.data.pose.shape[1]
        obstacles = list(self.list_obstacles(bodies))
        compiled = self._simulation = scenery.compile_scene(
            self._machine,
            self._physics,
            footprint_shape(spec),
            robots,
            self.list_walls(),
            obstacles,
        )
        self._data = mujoco.MjData(compiled)
        self._mocap = {}
        for k in (obstacle.number for obstacle in obstacles if obstacle.moves):
            body = compiled.body(f"{scenery.OBSTACLE_NAME}{k}")
            self._mocap[k] = int(body.mocapid[0])
        self._bumper_of = scenery.find_bumpers(compiled, robots)
        parts = self._machine, compiled, self._data, self._rest
        return [MujocoRig(spec, *parts, m) for m in range(robots)]

    def refresh(self) -> None:
        """See `PhysicsSimulator`."""
        mujoco.mj_forward(self._simulation, self._data)

    def place_obstacles(self, bodies: Array) -> None:
        """See `PhysicsSimulator`."""
        for k, mocap in self._mocap.items():
            self._data.mocap_pos[mocap, :2] = bodies[k, :2]
            self._data.mocap_quat[mocap] = scenery.make_quaternion(bodies[k, 2])

    def advance(self, steps: int) -> list[int]:
        """See `PhysicsSimulator`."""
        data = self._data
        mujoco.mj_step(self._simulation, data, nstep=steps)
        if any(warning.number for warning in data.warning):
            what = f"the motion of robot {self.model.robot.name!r} diverges"
            fix = "shorten the timestep of its Physics."
            raise BackendError(f"MuJoCo warns at {data.time:.2f} s that {what}; {fix}")
        bumped = self._bumper_of[data.contact.geom.ravel()]
        return [m for m in bumped.tolist() if m >= 0]
