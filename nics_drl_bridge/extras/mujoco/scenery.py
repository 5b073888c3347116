"""A MuJoCo scene: robots with bumpers, walls, map and obstacles."""

from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.extras.mujoco.machines import write_mjcf
from nics_drl_bridge.extras.physics.machines import Machine, Physics
from nics_drl_bridge.extras.physics.scenery import (
    BUMPER_FRICTION,
    HEIGHT,
    Box,
    Cylinder,
    Obstacle,
    Solid,
    cut_shape,
    split_convex,
)
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.shapes import Circle, Shape

BUMPER = 4  # bit for bumper contacts in MuJoCo's `contype` and `conaffinity`
BUMPER_NAME = "bumper_"
OBSTACLE_NAME = "obstacle_"


def make_prefix(robot: int) -> str:
    """Returns the prefix of the names of a robot's parts."""
    return f"robot_{robot}/" if robot else ""


def compile_scene(
    machine: Machine,
    physics: Physics,
    footprint: Shape,
    robots: int,
    walls: Iterable[Box],
    obstacles: Iterable[Obstacle],
) -> Any:
    """Compiles robots of one kind among walls and obstacles; moving ones are mocap bodies."""
    xml = write_mjcf(machine, physics)
    scene = mujoco.MjSpec.from_string(xml)
    builder = _Builder(scene, physics)
    builder.add_bumper(footprint)
    for m in range(1, robots):
        another = mujoco.MjSpec.from_string(xml)
        another.delete(another.geom("floor"))
        _Builder(another, physics).add_bumper(footprint)
        scene.attach(another, prefix=make_prefix(m), frame=scene.worldbody.add_frame())
    for wall in walls:
        builder.add_solid(scene.worldbody, wall)
    for obstacle in obstacles:
        builder.add_obstacle(obstacle)
    return scene.compile()


def find_bumpers(model: Any, robots: int) -> NDArray[np.int64]:
    """Returns (geoms,) the robot whose bumper each geom of a scene belongs to; -1 if none."""
    names = [model.geom(i).name for i in range(model.ngeom)]
    owners = np.full(len(names), -1, np.int64)
    for m in range(robots):
        head = f"{make_prefix(m)}{BUMPER_NAME}"
        owners[[name.startswith(head) for name in names]] = m
    return owners


class _Builder:
    """Adds solids to the specification of a scene."""

    def __init__(self, scene: Any, physics: Physics) -> None:
        self._scene = scene
        self._solref = [physics.softness, 1.0]

    def add_bumper(self, footprint: Shape) -> None:
        """Adds a robot's bumper, which has no mass: the chassis has it."""
        base = self._scene.body("base_link")
        half = 0.5 * float(base.pos[2])
        contact = {"contype": BUMPER, "mass": 0.0}
        if isinstance(footprint, Circle):
            # The round edge touches a wall in one point, at the height of the axles.
            size = [footprint.radius, footprint.radius, half]
            kind = mujoco.mjtGeom.mjGEOM_ELLIPSOID
            self._add(base, type=kind, size=size, name=f"{BUMPER_NAME}0", **contact)
            return
        for i, part in enumerate(split_convex(footprint.outline)):
            name = f"{BUMPER_NAME}{i}"
            self._add_prism(base, part, (-half, half), name=name, **contact)

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Adds an obstacle as a body of its own."""
        x, y, heading = obstacle.pose
        body = self._scene.worldbody.add_body(
            name=f"{OBSTACLE_NAME}{obstacle.number}",
            pos=[x, y, 0.0],
            quat=make_quaternion(heading),
            mocap=obstacle.moves,
        )
        for solid in cut_shape(obstacle.shape):
            self.add_solid(body, solid)

    def add_solid(self, body: Any, solid: Solid) -> None:
        """Adds a solid that stands on the floor to a body."""
        half = 0.5 * HEIGHT
        if isinstance(solid, Cylinder):
            kind = mujoco.mjtGeom.mjGEOM_CYLINDER
            size = [solid.radius, half, 0.0]
            self._add(body, type=kind, size=size, pos=[0, 0, half])
        elif isinstance(solid, Box):
            kind = mujoco.mjtGeom.mjGEOM_BOX
            size = [*(0.5 * side for side in solid.size), half]
            pos = [*solid.middle, half]
            quat = make_quaternion(solid.heading)
            self._add(body, type=kind, size=size, pos=pos, quat=quat)
        else:
            self._add_prism(body, solid.corners, (0.0, HEIGHT))

    def _add_prism(
        self, body: Any, corners: Array, z: tuple[float, float], **others: Any
    ) -> None:
        mesh = self._scene.add_mesh(name=f"prism_{len(self._scene.meshes)}")
        ends = [np.insert(corners, 2, height, axis=1) for height in z]
        mesh.uservert = np.concatenate(ends).ravel()
        kind = mujoco.mjtGeom.mjGEOM_MESH
        self._add(body, type=kind, meshname=mesh.name, **others)

    def _add(self, body: Any, **values: Any) -> None:
        body.add_geom(
            conaffinity=BUMPER,
            condim=3,
            friction=[BUMPER_FRICTION, 0.005, 0.0001],
            solref=self._solref,
            **values,
        )


def make_quaternion(heading: float) -> list[float]:
    """Returns the quaternion w, x, y, z of a rotation about the vertical [rad]."""
    return [float(np.cos(0.5 * heading)), 0.0, 0.0, float(np.sin(0.5 * heading))]
