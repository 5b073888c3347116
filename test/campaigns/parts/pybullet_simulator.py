"""A robot in PyBullet, a physics engine that nobody here wrote, beside MuJoCo and DART.

It is built on the parts that all engines share, as those two are. PyBullet is no requirement of the
package; its wheel is for Python 3.11 alone: `pip install pybullet==3.2.7`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.physics.machines import (
    CASTOR_MASS,
    PIVOT_INERTIA,
    PIVOT_MASS,
    ROLLER_MASS,
    STEERING_TORQUE,
    Machine,
    Physics,
    Roller,
    Wheel,
    place_rollers,
    weigh_chassis,
    weigh_wheel,
)
from nics_drl_bridge.extras.physics.scenery import (
    BUMPER_FRICTION,
    HEIGHT,
    Box,
    Cylinder,
    Solid,
    aim_beams,
    cut_shape,
    make_scan,
)
from nics_drl_bridge.extras.physics.simulator import (
    RayCastingSimulator,
    Reading,
    ServoRig,
)
from nics_drl_bridge.generator import SimulatorModel, footprint_shape
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.world_set import AnyWorld

try:
    import pybullet
except ImportError:
    fix = "with Python 3.11, run pip install pybullet==3.2.7"
    raise ConfigError(f"PyBullet is not installed; {fix}.") from None

PHYSICS = Physics(timestep=0.002)
GRAVITY = 9.81  # [m/s^2]
Y = np.array([0.0, 1.0, 0.0])
Z = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)
BASE = -1  # PyBullet's number of a body's first link
# bits of what may touch what; the first is of PyBullet's rays
RAY = 1
FLOOR = 2
TREAD = 4
BUMPER = 8
OBSTACLE = 16
TOUCHES = {FLOOR: TREAD, TREAD: FLOOR, BUMPER: OBSTACLE, OBSTACLE: BUMPER | RAY}
BUMPER_MASS = 1e-6  # of a link that PyBullet does not let be without one [kg]
FORCE = 9  # index of the normal force in one of PyBullet's contact points
FRACTION = 2  # index of the fraction of a ray in one of PyBullet's results
STANDS_STILL = {"linearDamping": 0.0, "angularDamping": 0.0, "jointDamping": 0.0}


class Engine:
    """PyBullet without a window, with a world of its own; it has all functions of the module."""

    def __init__(self, physics: Physics) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        self.setGravity(0.0, 0.0, -GRAVITY)
        self.setPhysicsEngineParameter(
            fixedTimeStep=physics.timestep,
            deterministicOverlappingPairs=1,
            enableConeFriction=0,
        )

    def __getattr__(self, name: str) -> Any:
        value = getattr(pybullet, name)
        return (
            partial(value, physicsClientId=self._client) if callable(value) else value
        )

    def __del__(self) -> None:
        pybullet.disconnect(self._client)


def let_touch(
    engine: Engine, body: int, link: int, group: int, friction: float
) -> None:
    """Lets a link touch what its group may, with Coulomb friction."""
    engine.setCollisionFilterGroupMask(body, link, group, TOUCHES[group])
    engine.changeDynamics(body, link, lateralFriction=friction, **STANDS_STILL)


def make_shape(engine: Engine, solid: Solid, height: float) -> int:
    """Returns the shape of a solid, which reaches as far up as down from its place."""
    if isinstance(solid, Box):
        half = [0.5 * side for side in (*solid.size, height)]
        return int(engine.createCollisionShape(engine.GEOM_BOX, halfExtents=half))
    if isinstance(solid, Cylinder):
        sizes = {"radius": solid.radius, "height": height}
        return int(engine.createCollisionShape(engine.GEOM_CYLINDER, **sizes))
    corners = [
        [x, y, z] for x, y in solid.corners for z in (-0.5 * height, 0.5 * height)
    ]
    return int(engine.createCollisionShape(engine.GEOM_MESH, vertices=corners))


def find_place(solid: Solid) -> Array:
    """Returns the pose (3,) of a solid's shape in the frame of the solid."""
    if isinstance(solid, Box):
        return np.array([*solid.middle, solid.heading])
    return ORIGIN


def make_quaternion(heading: float) -> list[float]:
    """Returns the quaternion x, y, z, w of a rotation about the vertical [rad]."""
    return [0.0, 0.0, float(np.sin(0.5 * heading)), float(np.cos(0.5 * heading))]


@dataclass(frozen=True)
class Link:
    """A part of a robot, fixed to its parent where it has no axis."""

    parent: int  # 0: the base; k: the k-th link, from 1
    place: tuple[float, ...]  # in its parent (3,) [m]
    mass: float  # [kg]
    moment: ArrayLike  # of inertia (3,) [kg m^2]
    shape: int = -1
    axis: Array | None = None
    heading: float = 0.0  # in its parent [rad]


@dataclass
class Assembly:
    """The parts of a machine, before PyBullet makes a robot of them."""

    engine: Engine
    machine: Machine
    physics: Physics
    links: list[Link] = field(default_factory=list)
    friction: dict[int, float] = field(
        default_factory=dict
    )  # of what touches the floor
    joints: dict[str, int] = field(default_factory=dict)
    bumpers: list[int] = field(default_factory=list)

    def build(self, spec: RobotSpec) -> PybulletRig:
        """Returns the robot, with bumpers of its footprint."""
        for wheel in self.machine.wheels:
            self._add_wheel(wheel)
        if self.machine.castor is not None:
            self._add_castor(*self.machine.castor)
        for solid in cut_shape(footprint_shape(spec)):
            x, y, heading = find_place(solid)
            shape = make_shape(self.engine, solid, self.machine.radius)
            moment = np.full(3, BUMPER_MASS)
            link = Link(0, (x, y, 0.0), BUMPER_MASS, moment, shape, heading=heading)
            self.bumpers.append(self._add(link))
        body = self._make_body()
        for number, friction in self.friction.items():
            let_touch(self.engine, body, number - 1, TREAD, friction)
        for number in self.bumpers:
            let_touch(self.engine, body, number - 1, BUMPER, BUMPER_FRICTION)
        return PybulletRig(self, spec, body)

    def _add(self, link: Link) -> int:
        self.links.append(link)
        return len(self.links)

    def _add_castor(self, behind: float, radius: float) -> None:
        # The ball slides instead of rolling, without friction.
        ball = self.engine.createCollisionShape(self.engine.GEOM_SPHERE, radius=radius)
        moment = np.full(3, 0.4 * CASTOR_MASS * radius**2)
        place = (behind, 0.0, radius - self.machine.radius)
        self.friction[self._add(Link(0, place, CASTOR_MASS, moment, ball))] = 0.0

    def _add_wheel(self, wheel: Wheel) -> None:
        radius = self.machine.radius
        parent = 0
        place = (*wheel.place, 0.0)
        if wheel.steering:
            moment = np.full(3, PIVOT_INERTIA)
            parent = self._add(Link(0, place, PIVOT_MASS, moment, axis=Z))
            self.joints[wheel.steering] = parent
            place = (0.0, 0.0, 0.0)
        mass, moment = weigh_wheel(wheel, self.machine, self.physics)
        tyre = -1
        if not wheel.lean:
            tyre = self.engine.createCollisionShape(
                self.engine.GEOM_SPHERE, radius=radius
            )
        if self.machine.kind == "skid_steer":
            # PyBullet weighs the directions of friction by the inertia that is felt along each. A
            # wheel whose motor holds its speed is felt as the robot; a light one would not skid.
            moment[1] = self.physics.mass * radius**2
        number = self._add(Link(parent, place, mass, moment, tyre, Y))
        self.joints[wheel.name] = number
        if not wheel.lean:
            self.friction[number] = self.physics.friction
            return
        for roller in place_rollers(radius, self.physics.rollers, wheel.lean):
            self._add_roller(number, roller)

    def _add_roller(self, wheel: int, roller: Roller) -> None:
        axle = np.array(roller.axle) / np.linalg.norm(roller.axle)
        radii, along = roller.spheres
        spheres = self.engine.createCollisionShapeArray(
            shapeTypes=[self.engine.GEOM_SPHERE] * len(radii),
            radii=radii.tolist(),
            collisionFramePositions=np.outer(along, axle).tolist(),
        )
        x, z = roller.place
        moment = np.full(3, roller.inertia)
        link = Link(wheel, (x, 0.0, z), ROLLER_MASS, moment, spheres, axle)
        self.friction[self._add(link)] = self.physics.friction

    def _make_body(self) -> int:
        engine = self.engine
        machine = self.machine
        mass = self.physics.mass
        turning = {True: engine.JOINT_REVOLUTE, False: engine.JOINT_FIXED}
        still = [0.0, 0.0, 0.0, 1.0]
        links = self.links
        body = engine.createMultiBody(
            baseMass=mass,
            baseInertialFramePosition=machine.centre,
            linkMasses=[link.mass for link in links],
            linkCollisionShapeIndices=[link.shape for link in links],
            linkVisualShapeIndices=[-1 for _ in links],
            linkPositions=[link.place for link in links],
            linkOrientations=[make_quaternion(link.heading) for link in links],
            linkInertialFramePositions=[[0.0, 0.0, 0.0] for _ in links],
            linkInertialFrameOrientations=[still for _ in links],
            linkParentIndices=[link.parent for link in links],
            linkJointTypes=[turning[link.axis is not None] for link in links],
            linkJointAxis=[Z if link.axis is None else link.axis for link in links],
        )
        moments = [
            weigh_chassis(machine, self.physics),
            *(link.moment for link in links),
        ]
        for number, one in enumerate(moments, BASE):
            inertia = np.asarray(one).tolist()
            engine.changeDynamics(
                body, number, localInertiaDiagonal=inertia, **STANDS_STILL
            )
            if number != BASE:  # a joint is braked until it is told otherwise
                engine.setJointMotorControl2(
                    body, number, engine.VELOCITY_CONTROL, force=0.0
                )
        return int(body)


class PybulletRig(ServoRig):
    """Access to the robot in PyBullet, which places a body by its centre of mass."""

    def __init__(self, assembly: Assembly, spec: RobotSpec, body: int) -> None:
        machine = assembly.machine
        physics = assembly.physics
        self._engine = assembly.engine
        self._body = body
        self._bumpers = [number - 1 for number in assembly.bumpers]
        self._joints = [assembly.joints[name] - 1 for name in machine.joints]
        self._turning = [
            k for k, link in enumerate(assembly.links) if link.axis is not None
        ]
        self._centre = np.array(machine.centre)
        self._time = 0.0
        mass = physics.mass + sum(link.mass for link in assembly.links)
        # enough to let one tyre slide that carries all
        torque = physics.friction * mass * GRAVITY * machine.radius
        self._torques = [
            STEERING_TORQUE if name.startswith("steer") else torque
            for name in machine.joints
        ]
        super().__init__(spec, machine, physics.timestep)

    def put(self, pose: ArrayLike) -> None:
        """See `Rig`."""
        x, y, heading = np.asarray(pose, dtype=np.float64)
        ahead, left, up = self._centre
        middle = np.array([x, y]) + geometry.rotate([ahead, left], heading)
        place = [*middle, self.machine.radius + up]
        turned = make_quaternion(heading)
        self._engine.resetBasePositionAndOrientation(self._body, place, turned)
        self._engine.resetBaseVelocity(self._body, [0.0] * 3, [0.0] * 3)
        for joint in self._turning:
            self._engine.resetJointState(self._body, joint, 0.0, 0.0)
        self._stop_motors()

    def launch(self, twist: Array, state: Array) -> None:
        """See `Rig`."""
        turning = np.array([0.0, 0.0, twist[2]])
        speed = np.append(geometry.rotate(twist[:2], self.heading()), 0.0)
        speed = speed + np.cross(turning, self._rotation() @ self._centre)
        self._engine.resetBaseVelocity(self._body, speed.tolist(), turning.tolist())
        self._followed = np.array(state)

    def motion(self) -> tuple[Any, ...]:
        """See `Rig`."""
        place = self._engine.getBasePositionAndOrientation(self._body)
        speed = self._engine.getBaseVelocity(self._body)
        joints = self._engine.getJointStates(self._body, self._turning)
        return place, speed, joints, self._wanted, self._followed

    def resume(self, motion: tuple[Any, ...]) -> None:
        """See `Rig`."""
        place, speed, joints, self._wanted, self._followed = motion
        self._engine.resetBasePositionAndOrientation(self._body, *place)
        self._engine.resetBaseVelocity(self._body, *speed)
        for joint, (angle, turning, *_) in zip(self._turning, joints, strict=True):
            self._engine.resetJointState(self._body, joint, angle, turning)

    def set_speeds(self, speeds: Array) -> None:
        """See `ServoRig`."""
        self._time += self._timestep
        self._engine.setJointMotorControlArray(
            self._body,
            self._joints,
            self._engine.VELOCITY_CONTROL,
            targetVelocities=speeds.tolist(),
            forces=self._torques,
        )

    def read(self) -> Reading:
        """See `Rig`."""
        place, _ = self._engine.getBasePositionAndOrientation(self._body)
        speed, turning = self._engine.getBaseVelocity(self._body)
        centre = self._rotation() @ self._centre
        x, y, _ = place - centre
        heading = self.heading()
        velocity = speed - np.cross(turning, centre)
        return Reading(
            time=self._time,
            pose=np.array([x, y, heading]),
            twist=np.append(geometry.rotate(velocity[:2], -heading), turning[2]),
            state=self.machine.state(self.encoders(), self._read_joints(1)),
        )

    def heading(self) -> float:
        """See `Rig`."""
        rotation = self._rotation()
        return float(np.arctan2(rotation[1, 0], rotation[0, 0]))

    def encoders(self) -> Array:
        """See `Rig`."""
        return self._read_joints(0)

    def cosine_of_tilt(self) -> float:
        """See `Rig`."""
        return float(self._rotation()[2, 2])

    def is_touching(self) -> bool:
        """Returns whether something presses against a bumper."""
        return any(
            point[FORCE] > 0.0
            for link in self._bumpers
            for point in self._engine.getContactPoints(self._body, linkIndexA=link)
        )

    def _read_joints(self, field_number: int) -> Array:
        states = self._engine.getJointStates(self._body, self._joints)
        return np.array([state[field_number] for state in states])

    def _rotation(self) -> Array:
        _, turned = self._engine.getBasePositionAndOrientation(self._body)
        return np.reshape(self._engine.getMatrixFromQuaternion(turned), (3, 3))


class PybulletSimulator(RayCastingSimulator):
    """One world with one robot in PyBullet."""

    engine = "PyBullet"

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        physics: Physics = PHYSICS,
        randomisation: Randomisation | None = None,
    ) -> None:
        super().__init__(model, world, physics=physics, randomisation=randomisation)

    def compile(self, bodies: Array) -> list[PybulletRig]:
        """See `PhysicsSimulator`."""
        engine = self._engine = Engine(self._physics)
        floor = engine.createMultiBody(
            0.0, engine.createCollisionShape(engine.GEOM_PLANE)
        )
        let_touch(engine, floor, BASE, FLOOR, 1.0)
        for wall in self.list_walls():
            self._place(self._add_obstacle(wall), wall, ORIGIN)
        self._moving: list[tuple[int, int, Solid]] = []
        for obstacle in self.list_obstacles(bodies):
            for solid in cut_shape(obstacle.shape):
                body = self._add_obstacle(solid)
                self._place(body, solid, obstacle.pose)
                if obstacle.moves:
                    self._moving.append((obstacle.number, body, solid))
        assembly = Assembly(engine, self._machine, self._physics)
        return [assembly.build(self.model.robot)]

    def _add_obstacle(self, solid: Solid) -> int:
        engine = self._engine
        body = int(engine.createMultiBody(0.0, make_shape(engine, solid, HEIGHT)))
        let_touch(engine, body, BASE, OBSTACLE, BUMPER_FRICTION)
        return body

    def _place(self, body: int, solid: Solid, pose: Array) -> None:
        x, y, heading = geometry.compose(pose, find_place(solid))
        place = [x, y, self._machine.radius]
        turned = make_quaternion(heading)
        self._engine.resetBasePositionAndOrientation(body, place, turned)

    def refresh(self) -> None:
        """See `PhysicsSimulator`."""
        self._engine.performCollisionDetection()

    def place_obstacles(self, bodies: Array) -> None:
        """See `PhysicsSimulator`."""
        for k, body, solid in self._moving:
            self._place(body, solid, bodies[k, :3])

    def advance(self, steps: int) -> list[int]:
        """See `PhysicsSimulator`."""
        (rig,) = self._rigs
        bumped = []
        for _ in range(steps):
            rig.turn_wheels()
            self._engine.stepSimulation()
            if rig.is_touching():
                bumped.append(0)
        return bumped

    def cast_scan(self, robot: int) -> Singles:
        """See `RayCastingSimulator`."""
        lidar = self.model.lidar
        pose = self.data.pose[0, robot]
        start, ends = aim_beams(lidar, pose, self._machine.radius)
        rays = self._engine.rayTestBatch(
            [start.tolist()] * lidar.beams,
            ends.tolist(),
            collisionFilterMask=OBSTACLE,
        )
        hits = np.array([(ray[0], ray[FRACTION]) for ray in rays])
        return make_scan(lidar, np.where(hits[:, 0] >= 0.0, hits[:, 1], np.inf))
