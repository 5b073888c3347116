"""Plane geometry: angles, poses, bicycles. REP-103 axes, radians; heading is in [-pi, pi)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


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
    c = np.cos(angle)
    s = np.sin(angle)
    x = vector[..., 0]
    y = vector[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def compose(pose: ArrayLike, relative: ArrayLike) -> Array:
    """Returns the pose that lies at `relative` in the frame of `pose`; (..., 3): x, y, heading."""
    pose = np.asarray(pose, dtype=np.float64)
    relative = np.asarray(relative, dtype=np.float64)
    position = pose[..., :2] + rotate(relative[..., :2], pose[..., 2])
    heading = wrap_angle(pose[..., 2] + relative[..., 2])
    return np.concatenate([position, heading[..., None]], axis=-1)


def between(pose: ArrayLike, target: ArrayLike) -> Array:
    """Returns `target` in the frame of `pose`, (..., 3); `compose(pose, result) == target`."""
    pose = np.asarray(pose, dtype=np.float64)
    target = np.asarray(target, dtype=np.float64)
    position = rotate(target[..., :2] - pose[..., :2], -pose[..., 2])
    return np.concatenate(
        [position, wrap_angle(target[..., 2] - pose[..., 2])[..., None]], axis=-1
    )


def exp(twist: ArrayLike) -> Array:
    """Returns the relative pose (..., 3) after an exact arc in SE(2): body twist x duration."""
    twist = np.asarray(twist, dtype=np.float64)
    w = twist[..., 2]
    small = np.abs(w) < 1e-4
    safe = np.where(small, 1.0, w)
    a = np.where(small, 1.0 - w * w / 6.0, np.sin(safe) / safe)
    b = np.where(small, w / 2.0 - w**3 / 24.0, (1.0 - np.cos(safe)) / safe)
    x = twist[..., 0]
    y = twist[..., 1]
    return np.stack([a * x - b * y, b * x + a * y, wrap_angle(w)], axis=-1)


def log(relative: ArrayLike) -> Array:
    """Inverts `exp` below half turns: returns body twist x duration (..., 3) of a pose (..., 3)."""
    relative = np.asarray(relative, dtype=np.float64)
    w = wrap_angle(relative[..., 2])
    small = np.abs(w) < 1e-4
    safe = np.where(small, 1.0, w)
    half = w / 2.0
    cot = np.where(small, 1.0 - w * w / 12.0, (safe / 2.0) / np.tan(safe / 2.0))
    x = relative[..., 0]
    y = relative[..., 1]
    return np.stack([cot * x + half * y, -half * x + cot * y, w], axis=-1)


def east_and_north(longitude: Array, latitude: Array) -> tuple[Array, Array]:
    """Projects WGS 84 positions [rad] onto the tangent plane at the first position [m].

    The error is below a centimetre within 10 km.
    """
    flattening = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude[0]) ** 2
    east_radius = EQUATOR_RADIUS_M / np.sqrt(flattening)
    north_radius = east_radius * (1.0 - ECCENTRICITY_SQUARED) / flattening
    east = east_radius * np.cos(latitude[0]) * wrap_angle(longitude - longitude[0])
    return east, north_radius * (latitude - latitude[0])


def has_crossing_edges(corners: Array) -> bool:
    """Returns True if an edge of a closed outline (K, 2) touches or crosses a non-neighbour."""
    start = corners
    end = np.roll(corners, -1, axis=0)
    edge = end - start
    if (start == end).all(axis=1).any():
        return True

    def find_sides(points: Array) -> Array:
        """Returns on which side of each edge each point lies (K, K): 1 left, -1 right, 0 on it."""
        to_point = points[None] - start[:, None]
        along = edge[:, None]
        cross = along[..., 0] * to_point[..., 1] - along[..., 1] * to_point[..., 0]
        return np.asarray(np.sign(cross))

    low = np.minimum(start, end)
    high = np.maximum(start, end)
    starts_below = low[:, None] <= high[None]
    ends_above = low[None] <= high[:, None]
    boxes_overlap = (starts_below & ends_above).all(axis=-1)
    end_sides = find_sides(end)
    # -1 where the line through one edge separates the ends of another edge
    separation = find_sides(start) * end_sides
    index = np.arange(len(corners))
    gap = (index[None] - index[:, None]) % len(corners)
    are_neighbours = (gap <= 1) | (gap >= len(corners) - 1)
    crossing = boxes_overlap & (separation <= 0.0) & (separation.T <= 0.0)
    # An edge may not run back along its predecessor.
    is_parallel = end_sides[index, (index + 1) % len(corners)] == 0.0
    runs_back = (edge * np.roll(edge, -1, axis=0)).sum(axis=1) <= 0.0
    return bool((crossing & ~are_neighbours).any() or (is_parallel & runs_back).any())


def compute_depths(points: Array, corners: Array) -> Array:
    """Returns distances (n,) of points (n, 2) to an outline (V, 2) [m], negative outside it."""
    edge = np.roll(corners, -1, axis=0) - corners
    to_point = points[:, None] - corners
    # Two corners may coincide.
    length_squared = np.maximum((edge * edge).sum(axis=-1), 1e-300)
    fraction = np.clip((to_point * edge).sum(axis=-1) / length_squared, 0.0, 1.0)
    to_edge = to_point - fraction[..., None] * edge
    distance = np.linalg.norm(to_edge, axis=-1).min(axis=1)
    # A point is inside if a ray from it to the right crosses the outline an odd number of times.
    is_above = to_point[..., 1] >= 0.0
    crosses_height = is_above != np.roll(is_above, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = to_point[..., 0] - to_point[..., 1] * edge[:, 0] / edge[:, 1]
    crossings = (crosses_height & (beyond < 0.0)).sum(axis=1)
    return np.asarray(np.where(crossings % 2 == 1, distance, -distance))


@dataclass(frozen=True)
class Bicycle:
    """Geometry of a steered robot with `base_link` in the middle of the unsteered axle."""

    wheelbase: float  # [m]
    # True: speeds are those of the steered wheel, along its rolling direction
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
        # lateral velocity of the front wheel, positive to the left
        sideways = self.wheelbase * twist[..., 2]
        sign = np.sign(forward)
        angle = np.arctan2(sideways * sign, np.abs(forward))
        if self.front_drive:
            return sign * np.hypot(forward, sideways), angle
        return forward, angle
