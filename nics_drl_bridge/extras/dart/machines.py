"""Robots as skeletons of DART; tyres are spheres, which touch the floor in one point."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dartpy
import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.dart import scenery
from nics_drl_bridge.extras.physics.machines import (
    CASTOR_MASS,
    PIVOT_INERTIA,
    PIVOT_MASS,
    ROLLER_MASS,
    Machine,
    Physics,
    Roller,
    Wheel,
    place_rollers,
    weigh_chassis,
    weigh_wheel,
)
from nics_drl_bridge.interface import Array

Z = np.array([0.0, 0.0, 1.0])
Y = np.array([0.0, 1.0, 0.0])
ALIGNED = 0.9  # minimum component of an axle along y, or of a pivot along z


@dataclass(frozen=True)
class DartBody:
    """A robot that is not yet in a world."""

    skeleton: Any
    joints: list[Any]  # joints with encoders, in the order of the machine
    height: float  # height of its root above the floor [m]


def make_body(machine: Machine, physics: Physics, file: Path | None = None) -> DartBody:
    """Builds the robot of a machine, or reads it from a file. Raises ConfigError."""
    if file is not None:
        return _read_robot(file, machine, physics)
    return _Builder(machine, physics).build()


class _Builder:
    def __init__(self, machine: Machine, physics: Physics) -> None:
        self._machine = machine
        self._physics = physics

    def build(self) -> DartBody:
        machine = self._machine
        skeleton = dartpy.dynamics.Skeleton("robot")
        _, base = skeleton.createFreeJointAndBodyNodePair()
        base.setName("base_link")
        moment = weigh_chassis(machine, self._physics)
        self._weigh(base, self._physics.mass, moment, machine.centre)
        if machine.castor is not None:
            behind, radius = machine.castor
            joint, ball = skeleton.createBallJointAndBodyNodePair(base)
            place = np.array([behind, 0.0, radius - machine.radius])
            joint.setTransformFromParentBodyNode(scenery.make_transform(place))
            self._weigh(ball, CASTOR_MASS, np.full(3, 0.4 * CASTOR_MASS * radius**2))
            self._add_tread(ball, dartpy.dynamics.SphereShape(radius))
        for wheel in machine.wheels:
            self._add_wheel(base, wheel)
        joints = [skeleton.getJoint(joint) for joint in machine.joints]
        return DartBody(skeleton, joints, machine.radius)

    def _weigh(
        self,
        body: Any,
        mass: float,
        moment: Array,
        centre: tuple[float, ...] = (0, 0, 0),
    ) -> None:
        inertia = dartpy.dynamics.Inertia(mass, np.array(centre), np.diag(moment))
        body.setInertia(inertia)

    def _add_tread(self, body: Any, shape: Any, transform: Any = None) -> None:
        node = scenery.add_shape(body, shape, transform)
        scenery.let_touch(node, self._physics.friction)

    def _add_joint(self, parent: Any, name: str, axis: Array, place: Array) -> Any:
        joint, body = parent.getSkeleton().createRevoluteJointAndBodyNodePair(parent)
        joint.setName(name)
        body.setName(f"{name}_link")
        joint.setAxis(axis)
        joint.setTransformFromParentBodyNode(scenery.make_transform(place))
        return body

    def _add_wheel(self, base: Any, wheel: Wheel) -> None:
        parent = base
        place = np.array([*wheel.place, 0.0])
        if wheel.steering:
            parent = self._add_joint(base, wheel.steering, Z, place)
            self._weigh(parent, PIVOT_MASS, np.full(3, PIVOT_INERTIA))
            place = np.zeros(3)
        body = self._add_joint(parent, wheel.name, Y, place)
        radius = self._machine.radius
        if wheel.lean:
            for roller in place_rollers(radius, self._physics.rollers, wheel.lean):
                self._add_roller(body, roller)
        else:
            self._add_tread(body, dartpy.dynamics.SphereShape(radius))
        self._weigh(body, *weigh_wheel(wheel, self._machine, self._physics))

    def _add_roller(self, wheel: Any, roller: Roller) -> None:
        x, z = roller.place
        axle = np.array(roller.axle) / np.linalg.norm(roller.axle)
        name = f"{wheel.getName()}_{wheel.getNumChildBodyNodes()}"
        body = self._add_joint(wheel, name, axle, np.array([x, 0.0, z]))
        for radius, along in zip(*roller.spheres, strict=True):
            transform = scenery.make_transform(along * axle)
            self._add_tread(body, dartpy.dynamics.SphereShape(radius), transform)
        self._weigh(body, ROLLER_MASS, np.full(3, roller.inertia))


def _read_skeleton(path: Path) -> Any:
    """Reads links and joints from a URDF or SDF file. Raises ConfigError."""
    if not path.is_file():
        raise ConfigError(f"robot {str(path)!r}: no such file.")
    uri = dartpy.common.Uri(path.absolute().as_uri())
    reader = dartpy.utils.DartLoader().parseSkeleton
    if path.suffix == ".sdf":
        reader = dartpy.utils.SdfParser.readSkeleton
    try:
        skeleton = reader(uri)
    except RuntimeError as error:
        raise ConfigError(f"robot {str(path)!r}: {error}; correct the file.") from None
    if skeleton is None:
        raise ConfigError(f"robot {str(path)!r}: DART can't read it; correct the file.")
    if not skeleton.getNumBodyNodes() or skeleton.getRootJoint().getNumDofs() != 6:
        fault = "its first link is fixed to the world, or it has none"
        raise ConfigError(f"robot {str(path)!r}: {fault}; give it a free base.")
    skeleton.resetPositions()
    return skeleton


def _read_robot(path: Path, machine: Machine, physics: Physics) -> DartBody:
    """Reads a robot from a URDF or SDF file; finds its wheels by their axles and places.

    Raises ConfigError if it can't be read, or unless one joint fits each joint of the machine.
    """
    skeleton = _read_skeleton(path)
    root = skeleton.getRootBodyNode()
    _set_friction(root, 0.0)  # a castor that is part of the base slides
    hinges = [
        _Hinge(joint, root)
        for joint in skeleton.getJoints()
        if joint.getType() == "RevoluteJoint"
    ]
    wheels = [hinge for hinge in hinges if abs(hinge.axis[1]) > ALIGNED]
    pivots = [hinge for hinge in hinges if abs(hinge.axis[2]) > ALIGNED]
    for wheel in wheels:
        _set_friction(wheel.joint.getChildBodyNode(), physics.friction)
    joints = []
    levels = []  # heights of the wheels' axles above the root
    for name in machine.joints:
        fitting = _find_fitting(name, pivots if name.startswith("steer") else wheels)
        _require_one(path, name, fitting, hinges)
        fitting[0].turn_positive()
        joints.append(fitting[0].joint)
        if fitting[0] in wheels:
            levels.append(fitting[0].place[2])
    return DartBody(skeleton, joints, machine.radius - float(np.mean(levels)))


def _require_one(
    path: Path, name: str, fitting: list["_Hinge"], hinges: list["_Hinge"]
) -> None:
    """Raises ConfigError unless one of the hinges fits a joint of the machine."""
    if len(fitting) != 1:
        there = ", ".join(hinge.joint.getName() for hinge in hinges) or "none"
        raise ConfigError(
            f"robot {str(path)!r}: {len(fitting)} joints could be {name!r}, where one is needed; "
            f"it has {there}."
        )


def _set_friction(body: Any, friction: float) -> None:
    for node in body.getShapeNodes():
        if node.hasDynamicsAspect():
            node.getDynamicsAspect().setFrictionCoeff(friction)


class _Hinge:
    """A revolute joint, with its axis and place in the root's frame while the robot is at rest."""

    def __init__(self, joint: Any, root: Any) -> None:
        self.joint = joint
        transform = joint.getChildBodyNode().getTransform(root)
        self.axis = transform.rotation() @ joint.getAxis()
        self.place = transform.translation()

    def turn_positive(self) -> None:
        """Makes positive speeds drive ahead, or turn to the left."""
        if self.axis.sum() < 0.0:
            self.joint.setAxis(-self.joint.getAxis())


def _find_fitting(name: str, hinges: list[_Hinge]) -> list[_Hinge]:
    """Returns the hinges on the side and at the end that a name such as `rear_left` denotes."""
    x, y, _ = np.array([hinge.place for hinge in hinges]).reshape(-1, 3).T
    half_width = 0.5 * np.abs(y).max(initial=0.0)
    middle = 0.5 * (x.min(initial=np.inf) + x.max(initial=-np.inf))
    places = {
        "left": y > half_width,
        "right": y < -half_width,
        "front": x > middle,
        "rear": x < middle,
    }
    fits = np.ones(len(hinges), np.bool_)
    for word in name.split("_"):
        fits &= places.get(word, True)
    return [hinge for hinge, is_fit in zip(hinges, fits, strict=True) if is_fit]
