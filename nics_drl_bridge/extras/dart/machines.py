"""Robots as skeletons of DART; tyres are spheres, which touch the floor in one point."""

from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.dart import scenery
from nics_drl_bridge.extras.physics.machines import (
    ROLLER_MASS,
    Machine,
    Physics,
    Roller,
    Wheel,
    place_rollers,
)
from nics_drl_bridge.interface import Array

GRAVITY = 9.81  # [m/s^2]
Z = np.array([0.0, 0.0, 1.0])
Y = np.array([0.0, 1.0, 0.0])
SPHERES = 9  # that form a roller
# fraction of a roller's length beyond which its spheres would end in a point
ROLLER_END = 0.95
CASTOR_MASS = 0.03  # [kg]
PIVOT_MASS = 0.02  # of what steers a wheel [kg]
PIVOT_INERTIA = 1e-4  # [kg m^2]
ROTOR_INERTIA = 2e-7  # added to a roller's, which is too small to compute with [kg m^2]
UPRIGHT = 0.9  # minimum component of an axle along y, or of a pivot along z


class Builder:
    """Builds skeletons of one machine."""

    def __init__(self, dart: Any, machine: Machine, physics: Physics) -> None:
        self._dart = dart
        self._machine = machine
        self._physics = physics

    def build(self, name: str) -> Any:
        """Returns a robot, whose root is `base_link`, with its motors."""
        machine = self._machine
        skeleton = self._dart.dynamics.Skeleton(name)
        _, base = skeleton.createFreeJointAndBodyNodePair()
        base.setName("base_link")
        mass = self._physics.mass
        squares = np.square(machine.size)
        moment = mass * (squares.sum() - squares) / 12.0
        self._weigh(base, mass, moment, machine.centre)
        if machine.castor is not None:
            self._add_castor(base, *machine.castor)
        for wheel in machine.wheels:
            self._add_wheel(base, wheel)
        return skeleton

    def _weigh(
        self,
        body: Any,
        mass: float,
        moment: Array,
        centre: tuple[float, ...] = (0, 0, 0),
    ) -> None:
        inertia = self._dart.dynamics.Inertia(mass, np.array(centre), np.diag(moment))
        body.setInertia(inertia)

    def _tread(self, body: Any, shape: Any) -> None:
        scenery.let_touch(scenery.add_shape(body, shape), self._physics.friction)

    def _add_joint(self, parent: Any, name: str, axis: Array, place: Array) -> Any:
        joint, body = parent.getSkeleton().createRevoluteJointAndBodyNodePair(parent)
        joint.setName(name)
        body.setName(f"{name}_link")
        joint.setAxis(axis)
        transform = scenery.make_transform(self._dart, place)
        joint.setTransformFromParentBodyNode(transform)
        return body

    def _add_castor(self, base: Any, behind: float, radius: float) -> None:
        joint, body = base.getSkeleton().createBallJointAndBodyNodePair(base)
        place = np.array([behind, 0.0, radius - self._machine.radius])
        transform = scenery.make_transform(self._dart, place)
        joint.setTransformFromParentBodyNode(transform)
        self._weigh(body, CASTOR_MASS, np.full(3, 0.4 * CASTOR_MASS * radius**2))
        ball = self._dart.dynamics.SphereShape(radius)
        self._tread(body, ball)

    def _add_wheel(self, base: Any, wheel: Wheel) -> None:
        radius = self._machine.radius
        parent = base
        place = np.array([*wheel.place, 0.0])
        if wheel.steering:
            parent = self._add_joint(base, wheel.steering, Z, place)
            self._weigh(parent, PIVOT_MASS, np.full(3, PIVOT_INERTIA))
            place = np.zeros(3)
        body = self._add_joint(parent, wheel.name, Y, place)
        mass = self._physics.wheel_mass
        width = 0.4 * radius
        if wheel.lean:
            mass -= self._physics.rollers * ROLLER_MASS
            radius *= 0.7
            for roller in place_rollers(
                self._machine.radius, self._physics.rollers, wheel.lean
            ):
                self._add_roller(body, roller)
        else:
            tyre = self._dart.dynamics.SphereShape(radius)
            self._tread(body, tyre)
        across = mass * (3.0 * radius**2 + width**2) / 12.0
        self._weigh(body, mass, np.array([across, 0.5 * mass * radius**2, across]))

    def _add_roller(self, wheel: Any, roller: Roller) -> None:
        x, z = roller.place
        axle = np.array(roller.axle) / np.linalg.norm(roller.axle)
        name = f"{wheel.getName()}_{wheel.getNumChildBodyNodes()}"
        body = self._add_joint(wheel, name, axle, np.array([x, 0.0, z]))
        a = roller.across
        b = roller.along
        # Each sphere touches the ellipsoid from within.
        places = np.linspace(-ROLLER_END, ROLLER_END, SPHERES) * (b - a * a / b)
        radii = a * np.sqrt(1.0 - places**2 / (b * b - a * a))
        for r, s in zip(radii, places, strict=True):
            transform = scenery.make_transform(self._dart, s * axle)
            ball = scenery.add_shape(
                body, self._dart.dynamics.SphereShape(r), transform
            )
            scenery.let_touch(ball, self._physics.friction)
        across = 0.2 * ROLLER_MASS * (a * a + b * b)
        self._weigh(body, ROLLER_MASS, np.full(3, across + ROTOR_INERTIA))


def read_robot(dart: Any, path: Path, machine: Machine) -> Any:
    """Reads a robot from a URDF or SDF file, and names its joints as the machine's.

    Raises ConfigError if it can't be read, or its joints do not match.
    """
    uri = dart.common.Uri(path.absolute().as_uri())
    if not path.is_file():
        raise ConfigError(f"robot {str(path)!r}: no such file.")
    if path.suffix == ".sdf":
        skeleton = dart.utils.SdfParser.readSkeleton(uri)
    else:
        skeleton = dart.utils.DartLoader().parseSkeleton(uri)
    if skeleton is None:
        raise ConfigError(f"robot {str(path)!r}: DART can't read it; mend the file.")
    return skeleton
