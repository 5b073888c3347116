"""Worlds of DART: floor, solids, collisions, and scans by DART's own ray casting."""

from collections.abc import Iterable
from typing import Any

import dartpy
import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.physics.machines import Physics
from nics_drl_bridge.extras.physics.scenery import (
    BUMPER_FRICTION,
    HEIGHT,
    Box,
    Cylinder,
    Solid,
    aim_beams,
    make_scan,
)
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.arrays import Singles
from nics_drl_bridge.lidar.spec import LidarSpec

ORIGIN = np.zeros(3)
EDGE = 1e-5  # radius of the edges of a prism [m]
RIM = 0.01  # thickness of the sides of a prism [m]
# settings of the contact solver, chosen by comparison with the textbook
TOLERANCE = 1e-3
MOST_SWEEPS = 30


def make_world(physics: Physics) -> Any:
    """Returns a world with a floor, whose skeleton is the first."""
    world = dartpy.simulation.World()
    world.setTimeStep(physics.timestep)
    # As in Gazebo. Bullet, which casts the rays, would round colliding shapes by 0.04 m.
    world.setCollisionDetector(dartpy.collision.OdeCollisionDetector())
    sleep = world.getDeactivationOptions()
    sleep.mEnabled = False
    world.setDeactivationOptions(sleep)
    # By default, friction is limited along x and y separately: robots skid too little in turns.
    solver = dartpy.constraint.NsgsFrictionSolver()
    options = solver.getOptions()
    options.tolerance = TOLERANCE
    options.maxSweeps = MOST_SWEEPS
    solver.setOptions(options)
    world.getConstraintSolver().setBoxedLcpSolver(solver)
    floor = add_fixed_body(world, "floor")
    plane = dartpy.dynamics.PlaneShape([0.0, 0.0, 1.0], 0.0)
    let_touch(add_shape(floor, plane), physics.friction)
    return world


def add_fixed_body(world: Any, name: str) -> Any:
    """Adds an immobile body at the origin; returns it."""
    skeleton = dartpy.dynamics.Skeleton(name)
    _, body = skeleton.createFreeJointAndBodyNodePair()
    body.setName(name)
    skeleton.setMobile(False)
    world.addSkeleton(skeleton)
    return body


def place_body(body: Any, pose: Array, height: float = 0.0) -> None:
    """Puts a free body at x, y, heading (3,) and a height [m], at rest."""
    x, y, heading = pose
    skeleton = body.getSkeleton()
    positions = np.zeros(skeleton.getNumDofs())
    positions[2:6] = heading, x, y, height
    skeleton.setPositions(positions)
    skeleton.resetVelocities()


def add_shape(body: Any, shape: Any, transform: Any = None) -> Any:
    """Adds a shape to a body that rays hit but that does not collide; returns its node."""
    node = body.createShapeNode(shape)
    if transform is not None:
        node.setRelativeTransform(transform)
    return node


def let_touch(node: Any, friction: float = BUMPER_FRICTION) -> None:
    """Lets the shape of a node touch others."""
    node.createCollisionAspect()
    node.createDynamicsAspect()
    node.getDynamicsAspect().setFrictionCoeff(friction)


def _add_sides(body: Any, corners: Array, level: float, height: float) -> None:
    """Adds a thin box along each side of a polygon with corners (V, 2)."""
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = end - start
        length = float(np.hypot(*along))
        inward = np.array([-along[1], along[0]]) / length
        middle = 0.5 * (start + end + RIM * inward)
        heading = float(np.arctan2(along[1], along[0]))
        side = dartpy.dynamics.BoxShape([length, RIM, height])
        transform = make_transform([*middle, level], heading)
        let_touch(add_shape(body, side, transform))


def add_solid(
    body: Any,
    solid: Solid,
    level: float,
    height: float = HEIGHT,
    pose: Array = ORIGIN,
) -> Any:
    """Adds a solid at a pose (3,) in a body's frame; returns the node that rays see.

    The solid is centred at the `level` [m]. For collisions, a capsule stands in for a cylinder and
    boxes along the sides for a prism, because ODE computes their contacts exactly.
    """
    shapes = dartpy.dynamics
    if isinstance(solid, Box):
        x, y, heading = geometry.compose(pose, [*solid.middle, solid.heading])
        transform = make_transform([x, y, level], heading)
        node = add_shape(body, shapes.BoxShape([*solid.size, height]), transform)
        let_touch(node)
        return node
    if isinstance(solid, Cylinder):
        transform = make_transform([*pose[:2], level])
        capsule = shapes.CapsuleShape(solid.radius, height)
        let_touch(add_shape(body, capsule, transform))
        return add_shape(body, shapes.CylinderShape(solid.radius, height), transform)
    corners = pose[:2] + geometry.rotate(solid.corners, pose[2])
    return _add_prism(body, corners, level, height)


def _add_prism(body: Any, corners: Array, level: float, height: float) -> Any:
    _add_sides(body, corners, level, height)
    middle = corners.mean(axis=0)
    ends = (-0.5 * height, 0.5 * height)
    spheres = [(EDGE, [x, y, end]) for x, y in corners - middle for end in ends]
    hull = dartpy.dynamics.MultiSphereConvexHullShape(spheres)
    return add_shape(body, hull, make_transform([*middle, level]))


def make_transform(place: ArrayLike, heading: float = 0.0) -> Any:
    """Returns a transform by a place (3,) [m] and a rotation about the vertical [rad]."""
    transform = dartpy.math.Isometry3()
    transform.set_translation(place)
    c = np.cos(heading)
    s = np.sin(heading)
    transform.set_rotation(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    return transform


def forbid_contact(world: Any, bodies: Iterable[Any], others: Iterable[Any]) -> None:
    """Lets bodies pass through others."""
    forbidden = world.getConstraintSolver().getCollisionOption().collisionFilter
    others = list(others)
    for body in bodies:
        for other in others:
            forbidden.addBodyNodePairToBlackList(body, other)


def make_group(nodes: Iterable[Any]) -> Any:
    """Returns the shapes of nodes as a group for `cast_scan`."""
    group = dartpy.collision.BulletCollisionDetector().createCollisionGroup()
    for node in nodes:
        group.addShapeFrame(node)
    return group


def cast_scan(group: Any, lidar: LidarSpec, pose: Array, height: float) -> Singles:
    """Scans (B,) [m], REP-117, from a robot's pose (3,), at a height [m] among a group's shapes."""
    start, ends = aim_beams(lidar, pose, height)
    option = dartpy.collision.RaycastOption()
    result = dartpy.collision.RaycastResult()
    fractions = np.full(lidar.beams, np.inf)
    for i, end in enumerate(ends):
        result.clear()
        if group.raycast(start, end, option, result):
            fractions[i] = result.mRayHits[0].mFraction
    return make_scan(lidar, fractions)
