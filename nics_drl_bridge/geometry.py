"""Plane geometry: angles, poses, arcs, outlines and steered robots.

Axes are those of REP-103, angles in radians. A pose (..., 3) is x, y [m] and a heading in
[-pi, pi).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# turns below this use Taylor series, which do not divide by the turn [rad]
SMALL_TURN = 1e-4
# ellipsoid of WGS 84
EQUATOR_RADIUS_M = 6378137.0
ECCENTRICITY_SQUARED = 0.00669437999014


def wrap_angle(angle: ArrayLike) -> Array:
    """Wraps angles (...) [rad] to [-pi, pi)."""
    wrapped = np.mod(np.asarray(angle, dtype=np.float64) + np.pi, 2.0 * np.pi) - np.pi
    # A tiny negative sum rounds up to 2 pi in np.mod, which would leave +pi here.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


def rotate(vector: ArrayLike, angle: ArrayLike) -> Array:
    """Rotates plane vectors (..., 2) by angles (...) [rad], counter-clockwise."""
    vector = np.asarray(vector, dtype=np.float64)
    angle = np.asarray(angle, dtype=np.float64)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    x = vector[..., 0]
    y = vector[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def compose(pose: ArrayLike, relative: ArrayLike) -> Array:
    """Returns the pose (..., 3) that is `relative` (..., 3) in the frame of `pose` (..., 3)."""
    pose = np.asarray(pose, dtype=np.float64)
    relative = np.asarray(relative, dtype=np.float64)
    position = pose[..., :2] + rotate(relative[..., :2], pose[..., 2])
    heading = wrap_angle(pose[..., 2] + relative[..., 2])
    return np.concatenate([position, heading[..., None]], axis=-1)


def between(pose: ArrayLike, target: ArrayLike) -> Array:
    """Returns `target` (..., 3) in the frame of `pose` (..., 3), which inverts `compose`."""
    pose = np.asarray(pose, dtype=np.float64)
    target = np.asarray(target, dtype=np.float64)
    position = rotate(target[..., :2] - pose[..., :2], -pose[..., 2])
    heading = wrap_angle(target[..., 2] - pose[..., 2])
    return np.concatenate([position, heading[..., None]], axis=-1)


def exp(twist: ArrayLike) -> Array:
    """Returns the relative pose (..., 3) at the end of an arc: the exponential map of SE(2).

    `twist` (..., 3) is a constant body twist times its duration: ahead, left [m] and turn [rad].
    """
    twist = np.asarray(twist, dtype=np.float64)
    ahead = twist[..., 0]
    left = twist[..., 1]
    turn = twist[..., 2]
    is_small = np.abs(turn) < SMALL_TURN
    divisor = np.where(is_small, 1.0, turn)
    # The integral of the rotation over the arc is [[sinc, -cosc], [cosc, sinc]].
    sinc = np.where(is_small, 1.0 - turn * turn / 6.0, np.sin(divisor) / divisor)
    cosc_series = turn / 2.0 - turn**3 / 24.0
    cosc = np.where(is_small, cosc_series, (1.0 - np.cos(divisor)) / divisor)
    x = sinc * ahead - cosc * left
    y = cosc * ahead + sinc * left
    return np.stack([x, y, wrap_angle(turn)], axis=-1)


def log(relative: ArrayLike) -> Array:
    """Inverts `exp` for turns below pi: returns the body twist times its duration (..., 3)."""
    relative = np.asarray(relative, dtype=np.float64)
    x = relative[..., 0]
    y = relative[..., 1]
    turn = wrap_angle(relative[..., 2])
    is_small = np.abs(turn) < SMALL_TURN
    half = turn / 2.0
    safe_half = np.where(is_small, 1.0, turn) / 2.0
    # The inverse of the matrix in `exp` is [[half_cot, half], [-half, half_cot]].
    half_cot = np.where(
        is_small, 1.0 - turn * turn / 12.0, safe_half / np.tan(safe_half)
    )
    ahead = half_cot * x + half * y
    left = -half * x + half_cot * y
    return np.stack([ahead, left, turn], axis=-1)


def east_and_north(longitude: Array, latitude: Array) -> tuple[Array, Array]:
    """Returns the positions (T,) east and north of the first one [m], for WGS 84 positions [rad].

    They are those on the ground, projected onto the tangent plane at the first position: distances
    shrink by less than a centimetre within 10 km.
    """
    shrinkage = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    # of curvature, in the prime vertical
    radius = EQUATOR_RADIUS_M / np.sqrt(shrinkage)
    turned = wrap_angle(longitude - longitude[0])
    # Earth-centred coordinates, with x in the meridian of the first position
    from_axis = radius * np.cos(latitude)
    x = from_axis * np.cos(turned)
    y = from_axis * np.sin(turned)
    z = radius * (1.0 - ECCENTRICITY_SQUARED) * np.sin(latitude)
    sine = np.sin(latitude[0])
    cosine = np.cos(latitude[0])
    north = cosine * (z - z[0]) - sine * (x - x[0])
    return y, north


def accumulate(steps: ArrayLike) -> Array:
    """Returns the running totals (T + 1,) of steps (T,), which begin with 0."""
    return np.append(0.0, np.cumsum(steps))


def measure_path(positions: Array) -> Array:
    """Returns the path length (T,) from the first of positions or poses (T, 2 or more) [m]."""
    return accumulate(np.hypot(*np.diff(positions[:, :2], axis=0).T))


def has_crossing_edges(corners: Array) -> bool:
    """True if an edge of a closed outline (K, 2) touches or crosses another one.

    Neighbours share a corner, but may not run back along each other. Edges without length count
    as touching.
    """
    start = corners
    end = np.roll(corners, -1, axis=0)
    edge = end - start
    if (start == end).all(axis=1).any():
        return True
    # Two edges cross if each one's line separates the ends of the other, and their boxes overlap,
    # which matters for edges on one line. Matrices (K, K) have a row and a column for each edge.
    end_sides = _find_sides(end, start, edge)
    is_separated = _find_sides(start, start, edge) * end_sides <= 0.0
    low = np.minimum(start, end)
    high = np.maximum(start, end)
    reaches_above = (low[:, None] <= high[None]).all(axis=-1)
    crossing = reaches_above & reaches_above.T & is_separated & is_separated.T
    index = np.arange(len(corners))
    gap = (index[None] - index[:, None]) % len(corners)
    are_neighbours = (gap <= 1) | (gap >= len(corners) - 1)
    if (crossing & ~are_neighbours).any():
        return True
    is_parallel = end_sides[index, (index + 1) % len(corners)] == 0.0
    is_reversed = (edge * np.roll(edge, -1, axis=0)).sum(axis=1) <= 0.0
    return bool((is_parallel & is_reversed).any())


def _find_sides(points: Array, start: Array, edge: Array) -> Array:
    """Returns on which side of each edge each point lies (K, K): 1 left, -1 right, 0 on its line.

    Edges begin at `start` (K, 2) and lead along `edge` (K, 2).
    """
    to_point = points[None] - start[:, None]
    along = edge[:, None]
    cross = along[..., 0] * to_point[..., 1] - along[..., 1] * to_point[..., 0]
    return np.asarray(np.sign(cross))


def compute_depths(points: Array, corners: Array) -> Array:
    """Returns how deep points (N, 2) lie in a closed outline (K, 2) [m]; negative outside it."""
    edge = np.roll(corners, -1, axis=0) - corners
    to_point = points[:, None] - corners  # (N, K, 2) from each corner
    # Two corners may coincide.
    length_squared = np.maximum((edge * edge).sum(axis=-1), 1e-300)
    fraction = np.clip((to_point * edge).sum(axis=-1) / length_squared, 0.0, 1.0)
    from_nearest = to_point - fraction[..., None] * edge
    distance = np.linalg.norm(from_nearest, axis=-1).min(axis=1)
    # A point is inside if a ray from it to the right crosses the outline an odd number of times.
    is_above = to_point[..., 1] >= 0.0
    meets_height = is_above != np.roll(is_above, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # how far the point lies to the right of the edge, at the point's height [m]
        right_of_edge = to_point[..., 0] - to_point[..., 1] * edge[:, 0] / edge[:, 1]
    crossings = (meets_height & (right_of_edge < 0.0)).sum(axis=1)
    is_inside = crossings % 2 == 1
    return np.asarray(np.where(is_inside, distance, -distance))


@dataclass(frozen=True)
class Bicycle:
    """A steered robot with `base_link` in the middle of the unsteered axle.

    One steered wheel, a wheelbase ahead, stands for the wheels of its axle.
    """

    wheelbase: float  # [m]
    # True: a speed is that of the steered wheel, which it drives along its rolling direction
    front_drive: bool = False

    def twist(self, speed: Array, angle: Array) -> Array:
        """Returns the body twist (..., 3) of speeds [m/s] and steering angles [rad] (...)."""
        if self.front_drive:
            forward = speed * np.cos(angle)
            yaw_rate = speed * np.sin(angle) / self.wheelbase
        else:
            forward = speed
            yaw_rate = speed * np.tan(angle) / self.wheelbase
        return np.stack([forward, np.zeros_like(forward), yaw_rate], axis=-1)

    def command(self, twist: Array) -> tuple[Array, Array]:
        """Returns speeds, steering angles (...) for twists (..., 3); zeros for turns in place."""
        forward = twist[..., 0]
        # The steered wheel rolls in the direction of its velocity, or the opposite one.
        sideways = self.wheelbase * twist[..., 2]
        direction = np.sign(forward)
        angle = np.arctan2(sideways * direction, np.abs(forward))
        if self.front_drive:
            return direction * np.hypot(forward, sideways), angle
        return forward, angle
