"""Poses, twists and bounds of the standard's messages, in the plane of a world."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3
from simulation_interfaces.msg import Bounds, Result

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.simulation_interfaces.host import RefusalError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.shapes import convex_hull
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.recording.messages import is_rotation
from nics_drl_bridge.sim.entities import Entities, overlap

HEIGHT = 0.5  # of whatever stands in a plane world, as in MuJoCo [m]
LEAN = 0.02  # maximum angle of what stands upright [rad]
# For each type of bounds: fewest and most points, and these in words.
SIZES = {
    Bounds.TYPE_EMPTY: (0, 0, "no points"),
    Bounds.TYPE_BOX: (2, 2, "two points"),
    Bounds.TYPE_SPHERE: (2, 2, "two points"),
    Bounds.TYPE_CONVEX_HULL: (3, math.inf, "three points or more"),
}


def pose_from_ros(pose: Any, base: Array, code: int) -> Array:
    """Return x, y, heading (3,) in `map` of a pose in a frame that has a pose (3,) there.

    Raises RefusalError with a code for what is no pose in the plane; z is not looked at.
    """
    place = pose.position
    turn = pose.orientation
    quaternion = turn.x, turn.y, turn.z, turn.w
    words = f"quaternion x {turn.x:g}, y {turn.y:g}, z {turn.z:g}, w {turn.w:g}"
    if not all(map(math.isfinite, (place.x, place.y, place.z, *quaternion))):
        raise RefusalError(code, "the pose holds NaN or inf; give finite numbers.")
    if not is_rotation(*quaternion):
        raise RefusalError(
            code, f"the {words} is no rotation; give one of unit length."
        )
    if 1.0 - 2.0 * (turn.x**2 + turn.y**2) < math.cos(LEAN):
        raise RefusalError(
            code, f"the {words} leans, but the world is flat; turn about z alone."
        )
    local = np.array([place.x, place.y, conversions.heading_of(*quaternion)])
    pose_in_map: Array = geometry.compose(base, local)
    return pose_in_map


def frame_pose(
    frame: str, entities: Entities, frames: Sequence[Any], code: int
) -> Array:
    """Return the pose (3,) of a frame in `map`: itself, or an entity's; RefusalError."""
    map_frames = {"", "world", *(robot.map for robot in frames)}
    if frame in map_frames:
        return np.zeros(3)
    bases = {
        robot.base: name
        for robot, name in zip(frames, entities.robot_names, strict=False)
    }
    name = bases.get(frame, frame)
    entity = next((entity for entity in entities if entity.name == name), None)
    if entity is None:
        fix = "leave it empty for the world, or name an entity"
        raise RefusalError(code, f"the frame {frame!r} is not known here; {fix}.")
    return entities.pose(entity)


def twist_from_ros(twist: Any, heading: float, code: int) -> Array:
    """Return vx, vy, wz (3,) along the axes of `map`, of a twist in a frame of a heading there."""
    values = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
    if not np.isfinite(values).all():
        raise RefusalError(code, "the twist holds NaN or inf; give finite numbers.")
    return np.array([*geometry.rotate(values[:2], heading), values[2]])


def box_to_ros(outlines: Sequence[Array]) -> Bounds:
    """Return the box around outlines (V, 2): its upper right corner, then its lower left one."""
    points = np.concatenate([np.zeros((0, 2)), *outlines])
    high = points.max(axis=0).tolist()
    low = points.min(axis=0).tolist()
    corners = [
        Vector3(x=high[0], y=high[1], z=HEIGHT),
        Vector3(x=low[0], y=low[1], z=0.0),
    ]
    return Bounds(type=Bounds.TYPE_BOX, points=corners)


class Region:
    """Bounds of a filter. Raises RefusalError for what bounds nothing."""

    def __init__(self, bounds: Any) -> None:
        kind = bounds.type
        self._points = np.array([[p.x, p.y, p.z] for p in bounds.points]).reshape(-1, 3)
        self.empty = kind == Bounds.TYPE_EMPTY
        if kind not in SIZES:
            fault = f"bounds of type {kind} are none of the standard"
            raise RefusalError(
                Result.RESULT_FEATURE_UNSUPPORTED, f"{fault}; give 0 to 3."
            )
        self._sphere = kind == Bounds.TYPE_SPHERE
        count = len(self._points)
        fewest, most, needed = SIZES[kind]
        if not fewest <= count <= most:
            raise RefusalError(
                Result.RESULT_OPERATION_FAILED,
                f"bounds of type {kind} have {count} points; give {needed}.",
            )
        radius = self._points[1, 0] if self._sphere else 1.0
        if not (np.isfinite(self._points).all() and radius > 0.0):
            fault = "bounds must have finite points, and a sphere a radius (x of the second)"
            raise RefusalError(
                Result.RESULT_OPERATION_FAILED, f"{fault} above 0; mend them."
            )
        self._corners = self._outline(kind)

    def _outline(self, kind: int) -> Array:
        flat = self._points[:, :2]
        if kind == Bounds.TYPE_BOX:
            (x1, y1), (x2, y2) = flat.min(axis=0), flat.max(axis=0)
            return np.array([(x1, y1), (x2, y1), (x2, y2), (x1, y2)])
        if kind == Bounds.TYPE_CONVEX_HULL:
            corners = convex_hull(flat)
            if len(corners) < 3:
                fault = (
                    "the points of the convex hull lie on one line; give one beside it."
                )
                raise RefusalError(Result.RESULT_OPERATION_FAILED, fault)
            return corners
        return flat

    def touches(self, outline: Array) -> bool:
        """True if what stands on an outline (V, 2) in `map` has a point in common with it."""
        if self.empty:
            return True
        low = self._points[:, 2].min()
        high = self._points[:, 2].max()
        if not self._sphere:
            return bool(
                low <= HEIGHT and high >= 0.0 and overlap(self._corners, outline)
            )
        x, y, z = self._points[0]
        room = self._points[1, 0] ** 2 - max(-z, z - HEIGHT, 0.0) ** 2
        apart = -float(
            geometry.compute_depths(np.array([[x, y]]), outline)[0]
        )  # below 0 inside
        return bool(room >= 0.0 and apart <= math.sqrt(room))
