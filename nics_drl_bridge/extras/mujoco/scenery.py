"""A MuJoCo scene: robots with bumpers, walls, map and obstacles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.extras.mujoco.machines import write_mjcf
from nics_drl_bridge.extras.physics.machines import Machine, Physics
from nics_drl_bridge.extras.physics.scenery import (
    BUMPER_FRICTION,
    HEIGHT,
    Box,
    Cylinder,
    Solid,
    cut_shape,
    cut_world,
    split_convex,
)
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.shapes import Circle, Shape
from nics_drl_bridge.sim.world import Motion, World

BUMPER = 4  # bit for bumper contacts in MuJoCo's `contype` and `conaffinity`
BUMPER_NAME = "bumper_"
OBSTACLE_NAME = "obstacle_"


def make_prefix(robot: int) -> str:
    """Returns the prefix of the names of a robot's parts."""
    return f"robot_{robot}/" if robot else ""


def compile_scene(
    mujoco: Any,
    machine: Machine,
    physics: Physics,
    footprint: Shape,
    robots: int,
    world: World,
    motions: Sequence[Motion | None],
    shapes: Sequence[Shape],
    bodies: Array,
) -> Any:
    """Compiles robots of one kind in a world; moving bodies among the (K, 7) are mocap bodies."""
    xml = write_mjcf(machine, physics)
    spec = mujoco.MjSpec.from_string(xml)
    maker = _Maker(mujoco, spec, physics)
    maker.bumper(spec.body("base_link"), footprint)
    for m in range(1, robots):
        another = mujoco.MjSpec.from_string(xml)
        another.delete(another.geom("floor"))
        _Maker(mujoco, another, physics).bumper(another.body("base_link"), footprint)
        spec.attach(another, prefix=make_prefix(m), frame=spec.worldbody.add_frame())
    for solid in cut_world(world):
        maker.solid(spec.worldbody, solid)
    for k, body in enumerate(bodies):
        if body[RADIUS] > 0.0:
            maker.obstacle(
                k, shapes[int(body[SHAPE])], body[:3], motions[k] is not None
            )
    return spec.compile()


def find_bumpers(model: Any, robots: int) -> NDArray[np.int64]:
    """Returns (geoms,) the robot whose bumper each geom of a scene belongs to; -1 if none."""
    names = [model.geom(i).name for i in range(model.ngeom)]
    heads = [f"{make_prefix(m)}{BUMPER_NAME}" for m in range(robots)]
    owners = np.full(len(names), -1, np.int64)
    for m, head in reversed(list(enumerate(heads))):
        owners[[name.startswith(head) for name in names]] = m
    return owners


class _Maker:
    def __init__(self, mujoco: Any, spec: Any, physics: Physics) -> None:
        self._kinds = mujoco.mjtGeom
        self._spec = spec
        self._solref = [physics.softness, 1.0]

    def bumper(self, base: Any, footprint: Shape) -> None:
        # The bumper has no mass: the chassis has it.
        half = 0.5 * float(base.pos[2])
        contact = {"contype": BUMPER, "mass": 0.0}
        if isinstance(footprint, Circle):
            # The round edge touches a wall in one point, at the height of the axles.
            size = [footprint.radius, footprint.radius, half]
            kind = self._kinds.mjGEOM_ELLIPSOID
            self._add(base, type=kind, size=size, name=f"{BUMPER_NAME}0", **contact)
        else:
            for i, part in enumerate(split_convex(footprint.outline)):
                self._prism(
                    base, part, (-half, half), name=f"{BUMPER_NAME}{i}", **contact
                )

    def obstacle(self, k: int, shape: Shape, pose: Array, moves: bool) -> None:
        x, y, heading = pose
        body = self._spec.worldbody.add_body(
            name=f"{OBSTACLE_NAME}{k}",
            pos=[x, y, 0.0],
            quat=make_quaternion(heading),
            mocap=moves,
        )
        for solid in cut_shape(shape):
            self.solid(body, solid)

    def solid(self, body: Any, solid: Solid) -> None:
        half = 0.5 * HEIGHT
        if isinstance(solid, Cylinder):
            kind = self._kinds.mjGEOM_CYLINDER
            size = [solid.radius, half, 0.0]
            self._add(body, type=kind, size=size, pos=[0, 0, half])
        elif isinstance(solid, Box):
            size = [*(0.5 * s for s in solid.size), half]
            pos = [*solid.middle, half]
            quat = make_quaternion(solid.heading)
            self._add(body, type=self._kinds.mjGEOM_BOX, size=size, pos=pos, quat=quat)
        else:
            self._prism(body, solid.corners, (0.0, HEIGHT))

    def _prism(
        self, body: Any, corners: Array, z: tuple[float, float], **others: Any
    ) -> None:
        mesh = self._spec.add_mesh(name=f"prism_{len(self._spec.meshes)}")
        layers = [
            np.column_stack([corners, np.full(len(corners), height)]) for height in z
        ]
        mesh.uservert = np.concatenate(layers).ravel()
        self._add(body, type=self._kinds.mjGEOM_MESH, meshname=mesh.name, **others)

    def _add(self, body: Any, **values: Any) -> None:
        common = {
            "conaffinity": BUMPER,
            "condim": 3,
            "friction": [BUMPER_FRICTION, 0.005, 0.0001],
        }
        body.add_geom(**common, solref=self._solref, **values)


def make_quaternion(heading: float) -> list[float]:
    """Returns the quaternion w, x, y, z of a rotation about the vertical [rad]."""
    return [float(np.cos(0.5 * heading)), 0.0, 0.0, float(np.sin(0.5 * heading))]
