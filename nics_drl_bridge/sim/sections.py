"""Solid bodies in space, and the shapes that a horizontal plane cuts out of them."""

import math
from collections.abc import Callable
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.shapes import (
    SMALLEST,
    Circle,
    Polygon,
    Rectangle,
    Shape,
    convex_hull,
)
from nics_drl_bridge.sim.world import Obstacles, Region

TILT = 1e-3  # up to this angle [rad] a body counts as upright: a millimetre in a metre
DIGITS = 6  # shapes and poses are rounded to a micrometre
AROUND = 1.0  # margin of the bounds around starts and goals [m]


class Box(NamedTuple):
    """A box centred at its own origin."""

    size: tuple[float, ...]  # along x, y, z [m]


class Cylinder(NamedTuple):
    """A cylinder along its own z, centred at its origin."""

    radius: float  # [m]
    length: float  # [m]


class Capsule(NamedTuple):
    """A cylinder with a hemisphere at either end."""

    radius: float  # [m]
    length: float  # of the cylinder alone [m]


class Sphere(NamedTuple):
    """A sphere around its own origin."""

    radius: float  # [m]


class Prism(NamedTuple):
    """An outline extruded upwards from its own z = 0."""

    points: tuple[tuple[float, ...], ...]  # x, y of the corners [m]
    height: float  # [m]


class ShapelessError(ValueError):
    """A body whose section is not a shape of a world; the text names the body."""

    def __init__(self, body: str, missing: bool = False) -> None:
        super().__init__(body)
        self.missing = missing  # its file is missing


Solid = Box | Cylinder | Capsule | Sphere | Prism
_Cut = tuple[Shape, float, float, float] | None  # with its pose, before rounding
Placed = tuple[Shape, tuple[float, float, float]]  # a shape and its pose in the plane


class Standing(NamedTuple):
    """Shapes that stand in a field at the height of a plane."""

    placed: tuple[Placed, ...]
    left_out: tuple[str, ...]  # a clause for each model that a world can't hold
    missing: bool = False  # the file of one of these models is missing

    @property
    def obstacles(self) -> tuple[Obstacles, ...]:
        """Group of obstacles of one shape each, for a `World`."""
        groups: dict[Shape, list[tuple[float, float, float]]] = {}
        for shape, pose in self.placed:
            groups.setdefault(shape, []).append(pose)
        return tuple(
            Obstacles(shapes=(shape,), at=tuple(at)) for shape, at in groups.items()
        )

    def bounds(self, *places: tuple[float, ...]) -> Region:
        """Return the smallest field with all shapes, and 1 m around places x, y, ... [m]."""
        around = AROUND * np.array([(-1.0, -1.0), (1.0, 1.0)])
        corners = [around + place[:2] for place in places]
        for shape, pose in self.placed:
            outline = geometry.rotate(shape.outline, pose[2])
            corners.append(
                (outline if len(outline) else shape.radius / AROUND * around) + pose[:2]
            )
        points = np.concatenate(corners)
        x1, y1 = (np.floor(points.min(axis=0) * 1e3) / 1e3).tolist()
        x2, y2 = (np.ceil(points.max(axis=0) * 1e3) / 1e3).tolist()
        return x1, y1, x2, y2


def section(solid: Solid, pose: Array, height: float) -> Placed | None:
    """Cut a body at a height above the ground.

    Args:
        solid: the body.
        pose: (4, 4) of the body in the world [m].
        height: of the plane [m].

    Returns:
        The shape, and its pose x, y [m], heading [rad]; None if the body is all above or below.

    Raises:
        ShapelessError: it leans, and its section is neither circle, rectangle nor polygon.
    """
    section = _CUTS[type(solid)](solid, pose, height - float(pose[2, 3]))
    if section is None or not section[0].radius > SMALLEST:
        return None
    shape, *place = section
    x, y, heading = (round(value, DIGITS) + 0.0 for value in place)
    return shape, (x, y, heading)


def _axis(pose: Array) -> int | None:
    """The body's own axis that is vertical, 0 to 2; None if none is."""
    upright = np.abs(pose[2, :3]) > math.cos(TILT)
    return int(np.argmax(upright)) if upright.any() else None


def _turn(pose: Array, axis: int) -> float:
    return math.atan2(pose[1, axis], pose[0, axis])


def _disc(pose: Array, radius2: float) -> _Cut:
    """A circle of a radius squared around the body's origin, if it is positive."""
    radius = round(math.sqrt(max(radius2, 0.0)), DIGITS)
    return (Circle(radius=radius), pose[0, 3], pose[1, 3], 0.0) if radius else None


def _rectangle(
    pose: Array, along: int, size: tuple[float, float]
) -> tuple[Shape, float, float, float]:
    x, y = (max(round(side, DIGITS), SMALLEST) for side in size)
    return Rectangle(size=(x, y)), pose[0, 3], pose[1, 3], _turn(pose, along)


def _of_cylinder(body: Cylinder, pose: Array, up: float) -> _Cut:
    if _axis(pose) == 2:
        return _disc(pose, body.radius**2) if abs(up) < body.length / 2.0 else None
    if abs(pose[2, 2]) >= math.sin(TILT):
        raise ShapelessError("a cylinder that leans")
    width2 = body.radius**2 - up**2
    if width2 <= 0.0:
        return None
    return _rectangle(pose, 2, (body.length, 2.0 * math.sqrt(width2)))


def _of_capsule(body: Capsule, pose: Array, up: float) -> _Cut:
    if _axis(pose) != 2:
        raise ShapelessError("a capsule that leans or lies")
    return _disc(pose, body.radius**2 - max(abs(up) - body.length / 2.0, 0.0) ** 2)


def _of_box(box: Box, pose: Array, up: float) -> _Cut:
    vertical = _axis(pose)
    if vertical is None:
        return _of_leaning_box(box, pose, up)
    if not abs(up) < box.size[vertical] / 2.0:
        return None
    along, across = (axis for axis in range(3) if axis != vertical)
    return _rectangle(pose, along, (box.size[along], box.size[across]))


def _of_leaning_box(box: Box, pose: Array, up: float) -> _Cut:
    """The convex polygon through the points where the plane cuts the edges."""
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    corners = signs * box.size @ pose[:3, :3].T  # around the box's middle
    cuts = []
    for a, b in combinations(range(8), 2):
        if np.count_nonzero(signs[a] != signs[b]) > 1:
            continue  # no edge
        below = corners[a, 2] - up
        above = corners[b, 2] - up
        if below * above < 0.0:
            cuts.append(
                corners[a] + below / (below - above) * (corners[b] - corners[a])
            )
    hull = convex_hull(np.array(cuts)[:, :2]) if cuts else np.zeros((0, 2))
    if len(hull) < 3 or np.ptp(hull, axis=0).min() < SMALLEST:
        return None
    return _polygon(hull), pose[0, 3], pose[1, 3], 0.0


def _of_prism(prism: Prism, pose: Array, up: float) -> _Cut:
    if _axis(pose) != 2:
        raise ShapelessError("a polyline that leans or lies")
    upwards = float(np.sign(pose[2, 2]))
    if not 0.0 < up * upwards < prism.height:
        return None
    return (
        _polygon(np.array(prism.points) * (1.0, upwards)),
        pose[0, 3],
        pose[1, 3],
        _turn(pose, 0),
    )


def _polygon(points: Array) -> Polygon:
    return Polygon(
        points=tuple((float(x), float(y)) for x, y in np.round(points, DIGITS))
    )


_CUTS: dict[type[Solid], Callable[..., _Cut]] = {
    Box: _of_box,
    Cylinder: _of_cylinder,
    Capsule: _of_capsule,
    Prism: _of_prism,
    Sphere: lambda sphere, pose, up: _disc(pose, sphere.radius**2 - up**2),
}
