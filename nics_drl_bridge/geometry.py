"""Plane geometry: angles, poses, bicycles. REP-103 axes, radians; heading is in [-pi, pi)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


# of WGS 84
EQUATOR_M = 6378137.0
ECCENTRICITY_2 = 0.00669437999014


def wrap_angle(angle: ArrayLike) -> Array:
    """Brings angles (...) [rad] into [-pi, pi)."""
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
    """The pose that lies at `relative` as seen from `pose`; both (..., 3): x, y, heading."""
    pose = np.asarray(pose, dtype=np.float64)
    relative = np.asarray(relative, dtype=np.float64)
    position = pose[..., :2] + rotate(relative[..., :2], pose[..., 2])
    heading = wrap_angle(pose[..., 2] + relative[..., 2])
    return np.concatenate([position, heading[..., None]], axis=-1)


def between(pose: ArrayLike, other: ArrayLike) -> Array:
    """The pose `other` as seen from `pose`; both (..., 3). `compose(pose, result) == other`."""
    pose = np.asarray(pose, dtype=np.float64)
    other = np.asarray(other, dtype=np.float64)
    position = rotate(other[..., :2] - pose[..., :2], -pose[..., 2])
    return np.concatenate(
        [position, wrap_angle(other[..., 2] - pose[..., 2])[..., None]], axis=-1
    )


def exp(twist: ArrayLike) -> Array:
    """Relative pose (..., 3) along the exact arc of a body twist x duration (..., 3), in SE(2)."""
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
    """Inverse of `exp` below half turns: body twist x duration (..., 3) to a pose (..., 3)."""
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
    """Returns places of WGS 84 [rad] on the plane that touches it at the first one [m].

    Off by less than a centimetre within 10 km.
    """
    share = 1.0 - ECCENTRICITY_2 * np.sin(latitude[0]) ** 2
    across = EQUATOR_M / np.sqrt(share)  # radii of curvature
    along = across * (1.0 - ECCENTRICITY_2) / share
    east = across * np.cos(latitude[0]) * wrap_angle(longitude - longitude[0])
    return east, along * (latitude - latitude[0])


def has_crossing_edges(corners: Array) -> bool:
    """True if edges of a closed outline (K, 2) cross or touch others than their neighbours."""
    start, stop = corners, np.roll(corners, -1, axis=0)
    if (start == stop).all(axis=1).any():
        return True

    def side(points: Array) -> Array:
        along = (stop - start)[:, None]
        to = points[None] - start[:, None]
        return np.asarray(
            np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])
        )

    low = np.minimum(start, stop)
    high = np.maximum(start, stop)
    boxes = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=-1)
    apart = side(start) * side(stop)
    index = np.arange(len(corners))
    gap = (index[None] - index[:, None]) % len(corners)
    distant = (gap > 1) & (gap < len(corners) - 1)
    # An edge may not run back along its predecessor.
    folded = side(stop)[index, (index + 1) % len(corners)] == 0.0
    ahead = ((stop - start) * (np.roll(stop - start, -1, axis=0))).sum(axis=1) > 0.0
    crossing = boxes & (apart <= 0.0) & (apart.T <= 0.0) & distant
    return bool(crossing.any() or (folded & ~ahead).any())


def compute_depths(points: Array, corners: Array) -> Array:
    """Distances (n,) of points (n, 2) to the border of an outline (V, 2), below 0 outside [m]."""
    side = np.roll(corners, -1, axis=0) - corners
    apart = points[:, None] - corners
    length2 = np.maximum((side * side).sum(axis=-1), 1e-300)  # two corners may coincide
    share = np.clip((apart * side).sum(axis=-1) / length2, 0.0, 1.0)
    away = np.linalg.norm(apart - share[..., None] * side, axis=-1).min(axis=1)
    above = apart[..., 1] >= 0.0
    crosses = above != np.roll(above, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        where = apart[..., 0] - apart[..., 1] * side[:, 0] / side[:, 1]
    return np.asarray(
        np.where((crosses & (where < 0.0)).sum(axis=1) % 2 == 1, away, -away)
    )


@dataclass(frozen=True)
class Bicycle:
    """Geometry of a robot that steers; `base_link` is the middle of the unsteered axle."""

    wheelbase: float  # [m]
    # the speed is that of the steered wheel, along its own direction
    front_drive: bool = False

    def twist(self, speed: Array, angle: Array) -> Array:
        """Returns the body twist (..., 3) of speeds [m/s] and steering angles [rad] (...)."""
        if self.front_drive:
            forward = speed * np.cos(angle)
            turn = speed * np.sin(angle) / self.wheelbase
        else:
            forward = speed
            turn = speed * np.tan(angle) / self.wheelbase
        return np.stack([forward, np.zeros_like(forward), turn], axis=-1)

    def command(self, twist: Array) -> tuple[Array, Array]:
        """Returns speeds and steering angles (...) of twists (..., 3), both 0 of a turn at rest."""
        forward = twist[..., 0]
        turn = twist[..., 2]
        across = self.wheelbase * turn  # speed of the front wheel to the left
        sign = np.sign(forward)
        angle = np.arctan2(across * sign, np.abs(forward))
        return (
            sign * np.hypot(forward, across) if self.front_drive else forward
        ), angle
