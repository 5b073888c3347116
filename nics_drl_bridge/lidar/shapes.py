"""Shapes of obstacles and footprints, and their arrays for the kernels.

A shape is data with a `kind`, as in YAML files. It has an outline (V, 2) of corners in its own
frame, counter-clockwise, and the radius of the circle around its origin that encloses it. A circle
has no corners.

Kernels refer to shapes by their index in `Outlines`, which lists the corners of all
shapes in one array. `place` turns shapes at poses into bodies (..., 7): x, y, heading,
cosine and sine of the heading, radius, and the index of the shape.

Baking needs two more properties of a shape. `find_convex_hull` determines its
silhouette: seen from outside, the leftmost and rightmost corners are corners of the
hull. `find_rotational_order` counts the rotations that map the shape onto itself, so
that a table needs only one of their sectors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator, model_validator

from nics_drl_bridge.config import Schema
from nics_drl_bridge.errors import ModelError
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.exact_kernels import COS, RADIUS, SHAPE, SIN, OutlineArrays

MOST_CORNERS = 16_384
MOST_SHAPES = 1_000  # in one group of obstacles
# minimum and maximum extent of a shape [m]: smaller ones are invisible, larger ones fit
# in no world
SMALLEST = 1e-6
LARGEST = 1e4
# corners within this distance, as a fraction of the shape's radius, coincide
SAME_PLACE = 1e-9
FARTHEST = 1e8  # maximum coordinate in a map [m], enough for UTM
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Place = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Size = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]


class Outlined(Schema):
    """A shape with corners."""

    @property
    def outline(self) -> Array:
        """(V, 2) corners, counter-clockwise [m]."""
        raise NotImplementedError

    @property
    def radius(self) -> float:
        """Radius of the circle around the origin that encloses the shape [m]."""
        return _reach(self.outline)


class Circle(Schema):
    """A disc around its own origin."""

    kind: Literal["circle"] = "circle"  # which kind of shape this is
    radius: Size  # [m]

    @property
    def outline(self) -> Array:
        """(0, 2): a circle has no corners."""
        return np.zeros((0, 2))


class Rectangle(Outlined):
    """A rectangle centred at its own origin, along its own axes."""

    kind: Literal["rectangle"] = "rectangle"  # which kind of shape this is
    size: tuple[Size, Size]  # length along x and width along y [m]

    @field_validator("size", mode="before")
    @classmethod
    def _check_extent(cls, size: Any) -> Any:
        if isinstance(size, list | tuple) and any(part == 0.0 for part in size):
            raise ValueError(
                "size must be greater than 0; a wall without thickness is a segment"
            )
        return size

    @property
    def outline(self) -> Array:
        """(4, 2) corners, counter-clockwise [m]."""
        x = self.size[0] / 2.0
        y = self.size[1] / 2.0
        return np.array([(x, y), (-x, y), (-x, -y), (x, -y)])


class Polygon(Outlined):
    """An outline of straight edges, convex or concave; the last corner is joined to the first."""

    kind: Literal["polygon"] = "polygon"  # which kind of shape this is
    # in the shape's own frame, in either orientation [m]
    points: tuple[tuple[Place, Place], ...] = Field(
        min_length=3, max_length=MOST_CORNERS
    )

    @field_validator("points")
    @classmethod
    def _check_distinct(
        cls, points: tuple[tuple[float, float], ...]
    ) -> tuple[tuple[float, float], ...]:
        if len(set(points)) < 3:
            raise ValueError("a polygon needs at least 3 different corners")
        if np.ptp(points, axis=0).max() < SMALLEST:
            raise ValueError(f"a polygon must extend over {SMALLEST:g} m")
        return points

    @property
    def outline(self) -> Array:
        """(V, 2) corners, counter-clockwise [m]."""
        corners = np.array(self.points, np.float64)
        x, y = corners.T
        twice_area = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
        if twice_area >= 0.0:
            return corners
        return np.ascontiguousarray(corners[::-1])


class Segment(Outlined):
    """A straight wall without thickness."""

    kind: Literal["segment"] = "segment"  # which kind of shape this is
    # in the shape's own frame [m]
    ends: tuple[tuple[Place, Place], tuple[Place, Place]]

    @model_validator(mode="after")
    def _check_extent(self) -> "Segment":
        if self.ends[0] == self.ends[1]:
            raise ValueError("ends must be two different points")
        if np.ptp(self.ends, axis=0).max() < SMALLEST:
            raise ValueError(f"ends must be {SMALLEST:g} m apart")
        return self

    @property
    def outline(self) -> Array:
        """(2, 2) ends [m]."""
        return np.array(self.ends, np.float64)


Shape = Annotated[Circle | Rectangle | Polygon | Segment, Field(discriminator="kind")]


SQUARE = Rectangle(size=(0.3, 0.3))
STRIP = Rectangle(size=(0.6, 0.06))
BODY = 7  # number of columns of a placed body


def _reach(outline: Array) -> float:
    return float(np.hypot(*outline.T).max())


def place(poses: ArrayLike, radii: ArrayLike, shapes: ArrayLike) -> Array:
    """Place shapes (...) of radii (...) [m], 0 if absent, at poses (..., 3) as bodies (..., 7)."""
    poses = np.asarray(poses, np.float64)
    bodies = np.empty((*poses.shape[:-1], BODY))
    bodies[..., :3] = poses
    # a body with an infinite heading is NaN, and not visible
    with np.errstate(invalid="ignore"):
        bodies[..., COS] = np.cos(poses[..., 2])
        bodies[..., SIN] = np.sin(poses[..., 2])
    bodies[..., RADIUS] = radii
    bodies[..., SHAPE] = shapes
    return bodies


def find_outline(body: Array, shapes: Sequence[Shape]) -> Array:
    """Return the outline (V, 2) of a body in its own frame; each shape may have several sizes."""
    shape = shapes[int(body[SHAPE]) % len(shapes)]
    return np.asarray(shape.outline * (body[RADIUS] / shape.radius))


def find_convex_hull(points: Array) -> Array:
    """Corners (P, 2) of the convex hull, counter-clockwise; Andrew's monotone chain (1979)."""
    ordered = sorted({(float(x), float(y)) for x, y in points})
    if len(ordered) < 3:
        return np.array(ordered)
    reach = _reach(points)
    smallest_area = 1e-12 * reach * reach
    lower = _find_half_hull(ordered, smallest_area)
    upper = _find_half_hull(ordered[::-1], smallest_area)
    return np.array(lower + upper)


def _find_half_hull(
    ordered: Sequence[tuple[float, float]], smallest_area: float
) -> list[tuple[float, float]]:
    """Lower hull of points from left to right, or upper hull from right to left, without its end.

    Corners that span less than `smallest_area` [m^2] count as collinear.
    """
    chain: list[tuple[float, float]] = []
    for x, y in ordered:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            area = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
            if area > smallest_area:  # a left turn
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]


def find_rotational_order(outline: Array, hull: Array) -> int:
    """Order of the rotational symmetry of a shape: 4 for a square, 1 for most shapes."""
    if len(outline) < 3:
        return 1
    tolerance = SAME_PLACE * _reach(outline)
    for order in range(len(outline), 1, -1):
        if _is_symmetric(outline, order, tolerance) and _is_symmetric(
            hull, order, tolerance
        ):
            return order
    return 1


def _is_symmetric(corners: Array, order: int, tolerance: float) -> bool:
    """Return True if a rotation by a full turn / order only renumbers the corners (V, 2)."""
    if len(corners) % order:
        return False
    angle = 2.0 * np.pi / order
    c = np.cos(angle)
    s = np.sin(angle)
    turned = corners @ np.array([[c, s], [-s, c]])
    renumbered = np.roll(corners, -len(corners) // order, axis=0)
    return bool(np.abs(turned - renumbered).max() < tolerance)


@dataclass(frozen=True)
class Outlines:
    """Shapes as flat arrays. Hulls are stored twice, so that indices may pass the end."""

    shapes: tuple[Shape, ...]  # H
    corners: Array  # (sum V, 2) of all outlines, one after the other [m]
    # (H + 1,) first corner of each outline; a circle has none
    corner: Integers
    # (sum 2 V, 2) corners of all convex hulls [m]; a circle's is its centre
    hulls: Array
    hull: Integers  # (H + 1,) first corner of each hull
    radii: Array  # (H,) [m]
    orders: Integers  # (H,) rotational order

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> "Outlines":
        """Create the arrays of some shapes."""
        outlines = []
        hulls = []
        orders = []
        for shape in shapes:
            outline = shape.outline
            hull = find_convex_hull(outline) if len(outline) else np.zeros((1, 2))
            outlines.append(outline)
            hulls.append(hull)
            orders.append(find_rotational_order(outline, hull))
        twice = [np.concatenate([hull, hull]) for hull in hulls]
        nothing = np.zeros((0, 2))
        radii = np.array([shape.radius for shape in shapes], np.float64)
        return cls(
            tuple(shapes),
            np.concatenate([nothing, *outlines]),
            np.cumsum([0, *map(len, outlines)]),
            np.concatenate([nothing, *twice]),
            np.cumsum([0, *map(len, twice)]),
            radii,
            np.array(orders, np.int64),
        )

    @property
    def arguments(self) -> OutlineArrays:
        """The outlines for the kernels."""
        return OutlineArrays(self.corners, self.corner)

    def index_of(self, shape: Shape) -> int:
        """Return the index of a shape. Raises ModelError if it is not among them."""
        try:
            return self.shapes.index(shape)
        except ValueError:
            held = ", ".join(map(describe, self.shapes)) or "none"
            raise ModelError(
                f"the shape {describe(shape)} is not in the lidar table, which "
                f"contains {held}; bake it as well."
            ) from None


def describe(shape: Shape) -> str:
    """Describe a shape in a few words."""
    if isinstance(shape, Circle):
        return f"circle of radius {shape.radius:g} m"
    if isinstance(shape, Rectangle):
        return f"rectangle of {shape.size[0]:g} x {shape.size[1]:g} m"
    if isinstance(shape, Segment):
        return f"segment of {np.hypot(*np.subtract(*shape.ends)):.3g} m"
    return f"polygon of {len(shape.points)} corners, radius {shape.radius:.3g} m"
