"""Poses, twists and bounds of the standard's messages, in the plane of a world."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3
from simulation_interfaces.msg import Bounds

from nics_drl_bridge import geometry
from nics_drl_bridge.extras.simulation_interfaces.host import RefusalError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.recording.messages import is_rotation
from nics_drl_bridge.sim.entities import Entities

HEIGHT = 0.5  # of whatever stands in a plane world, as in MuJoCo [m]
LEAN = 0.02  # maximum angle of what stands upright [rad]


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
