"""Robots in DART: one on an infinite floor, or several in a world, like FastSimulator."""

from pathlib import Path
from typing import Any

import dartpy
import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.dart import scenery
from nics_drl_bridge.extras.dart.machines import DartBody, make_body
from nics_drl_bridge.extras.physics.machines import (
    STEERING_TORQUE,
    Machine,
    Physics,
    design_machine,
)
from nics_drl_bridge.extras.physics.scenery import cut_shape
from nics_drl_bridge.extras.physics.simulator import (
    PhysicsRobot,
    RayCastingSimulator,
    Reading,
    ServoRig,
)
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.robot.spec import RobotSpec

PHYSICS = Physics(timestep=0.002)
GRAVITY = 9.81  # [m/s^2]


class DartRig(ServoRig):
    """Access to one robot in a world of DART, and its motors."""

    def __init__(
        self,
        world: Any,
        spec: RobotSpec,
        machine: Machine,
        body: DartBody,
        physics: Physics,
    ) -> None:
        super().__init__(spec, machine, physics.timestep)
        self._world = world
        self._skeleton = body.skeleton
        self._height = body.height
        self._frame = dartpy.dynamics.Frame.World()
        self.base = body.skeleton.getRootBodyNode()
        self._joints = [joint.getIndexInSkeleton(0) for joint in body.joints]
        # enough to make a tyre slide that carries the whole robot
        torque = physics.friction * body.skeleton.getMass() * GRAVITY * machine.radius
        for name, joint in zip(machine.joints, body.joints, strict=True):
            joint.setActuatorType(dartpy.dynamics.ActuatorType.SERVO)
            limit = STEERING_TORQUE if name.startswith("steer") else torque
            joint.setForceLowerLimit(0, -limit)
            joint.setForceUpperLimit(0, limit)

    def put(self, pose: ArrayLike) -> None:
        """See `Rig`."""
        scenery.place_body(self.base, np.asarray(pose), self._height)
        self._stop_motors()

    def launch(self, twist: Array, state: Array) -> None:
        """See `Rig`."""
        speeds = np.zeros(self._skeleton.getNumDofs())
        speeds[2] = twist[2]
        speeds[3:5] = geometry.rotate(twist[:2], self.heading())
        self._skeleton.setVelocities(speeds)
        self._followed = np.array(state)

    def motion(self) -> tuple[Array, ...]:
        """See `Rig`."""
        skeleton = self._skeleton
        moves = skeleton.getPositions(), skeleton.getVelocities()
        return *moves, self._wanted, self._followed

    def resume(self, motion: tuple[Array, ...]) -> None:
        """See `Rig`."""
        positions, speeds, self._wanted, self._followed = motion
        self._skeleton.setPositions(positions)
        self._skeleton.setVelocities(speeds)

    def set_speeds(self, speeds: Array) -> None:
        """See `ServoRig`."""
        self._skeleton.setCommands(self._joints, speeds)

    def read(self) -> Reading:
        """See `Rig`."""
        place = self.base.getTransform().translation()
        velocity = self.base.getLinearVelocity(self._frame, self.base)
        turning = self.base.getAngularVelocity(self._frame, self.base)
        return Reading(
            time=float(self._world.getTime()),
            pose=np.array([place[0], place[1], self.heading()]),
            twist=np.array([velocity[0], velocity[1], turning[2]]),
            state=self.machine.state(
                self.encoders(), self._skeleton.getVelocities(self._joints)
            ),
        )

    def heading(self) -> float:
        """See `Rig`."""
        rotation = self.base.getTransform().rotation()
        return float(np.arctan2(rotation[1, 0], rotation[0, 0]))

    def encoders(self) -> Array:
        """See `Rig`."""
        return np.array(self._skeleton.getPositions(self._joints))

    def cosine_of_tilt(self) -> float:
        """See `Rig`."""
        return float(self.base.getTransform().rotation()[2, 2])


class DartRobot(PhysicsRobot):
    """A robot on an infinite floor in DART: built by its spec, or from a URDF or SDF file."""

    engine = "DART"

    def __init__(
        self, spec: RobotSpec, physics: Physics = PHYSICS, file: Path | None = None
    ) -> None:
        self.spec = spec
        self._file = file
        self.machine = design_machine(spec, physics, self.engine)
        self._physics = physics
        self.timestep = physics.timestep
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> Reading:
        """See `PhysicsRobot`."""
        self._world = scenery.make_world(self._physics)
        body = make_body(self.machine, self._physics, self._file)
        self._world.addSkeleton(body.skeleton)
        self.rig = DartRig(self._world, self.spec, self.machine, body, self._physics)
        self.rig.put(pose)
        return self.read()

    def advance(self, steps: int) -> None:
        """See `PhysicsRobot`."""
        for _ in range(steps):
            self.rig.turn_wheels()
            self._world.step()


class DartSimulator(RayCastingSimulator):
    """One world of robots in DART; for `file` see DartRobot."""

    engine = "DART"
    usual_physics = PHYSICS

    def __init__(self, *given: Any, file: Path | None = None, **options: Any) -> None:
        self._file = file
        super().__init__(*given, **options)

    def compile(self, bodies: Array) -> list[DartRig]:
        """See `PhysicsSimulator`."""
        self._engine = scenery.make_world(self._physics)
        fixed = scenery.add_fixed_body(self._engine, "scenery")
        level = self._machine.radius
        seen = [scenery.add_solid(fixed, wall, level) for wall in self.list_walls()]
        self._moving = {}
        for obstacle in self.list_obstacles(bodies):
            pose = obstacle.pose
            body = fixed
            if obstacle.moves:
                name = f"obstacle_{obstacle.number}"
                body = scenery.add_fixed_body(self._engine, name)
                scenery.place_body(body, pose)
                self._moving[obstacle.number] = body
                pose = scenery.ORIGIN
            for solid in cut_shape(obstacle.shape):
                seen.append(scenery.add_solid(body, solid, level, pose=pose))
        return self._add_robots(seen, [fixed, *self._moving.values()])

    def _add_robots(self, seen: list[Any], obstacles: list[Any]) -> list[DartRig]:
        """Adds the robots, whose bumpers alone touch obstacles, and what their lidars see."""
        added = [self._add_robot(m) for m in range(self.data.pose.shape[1])]
        rigs = [rig for rig, _ in added]
        bumpers = [bumper for _, bumper in added]
        bases = [rig.base for rig in rigs]
        for rig in rigs:
            wheels = rig.base.getSkeleton().getBodyNodes()[1:]
            scenery.forbid_contact(self._engine, wheels, obstacles + bases)
        if self._file is None:  # a file's base may have a castor of its own
            floor = self._engine.getSkeleton("floor").getBodyNode(0)
            scenery.forbid_contact(self._engine, bases, [floor])
        self._groups = []
        for bumper in bumpers:
            others = [other for other in bumpers if other is not bumper]
            self._groups.append(scenery.make_group(sum(others, seen)))
        return rigs

    def _add_robot(self, m: int) -> tuple[DartRig, list[Any]]:
        """Adds a robot; returns its rig, and the shapes of its bumper."""
        spec = self.model.robot
        height = self._machine.radius
        body = make_body(self._machine, self._physics, self._file)
        body.skeleton.setName(f"robot_{m}")
        base = body.skeleton.getRootBodyNode()
        bumper = [
            scenery.add_solid(base, solid, height - body.height, height)
            for solid in cut_shape(footprint_shape(spec))
        ]
        self._engine.addSkeleton(body.skeleton)
        return DartRig(self._engine, spec, self._machine, body, self._physics), bumper

    def place_obstacles(self, bodies: Array) -> None:
        """See `PhysicsSimulator`."""
        for k, body in self._moving.items():
            scenery.place_body(body, bodies[k, :3])

    def advance(self, steps: int) -> list[int]:
        """See `PhysicsSimulator`."""
        bumped = []
        for _ in range(steps):
            for rig in self._rigs:
                rig.turn_wheels()
            self._engine.step()
            contacts = self._engine.getLastCollisionResult()
            bumped += [
                m for m, rig in enumerate(self._rigs) if contacts.inCollision(rig.base)
            ]
        return bumped

    def cast_scan(self, robot: int) -> Singles:
        """See `RayCastingSimulator`."""
        pose = self.data.pose[0, robot]
        group = self._groups[robot]
        height = self._machine.radius
        return scenery.cast_scan(group, self.model.lidar, pose, height)
