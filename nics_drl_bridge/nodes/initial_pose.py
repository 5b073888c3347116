"""The message of `initialpose`, as RViz sends it."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.nodes import conversions

INITIAL_POSE = "initialpose"


def initial_pose(message: PoseWithCovarianceStamped, map_frame: str) -> Array:
    """Returns the pose (3,) in the map of a message. Raises ConfigError if it can't be used."""
    frame, pose = message.header.frame_id.strip("/"), conversions.pose_from_ros(message)[0]
    if frame not in ("", map_frame):
        fix = f"give it in {map_frame!r}, as RViz does if that is its fixed frame."
        raise ConfigError(f"{INITIAL_POSE}: a pose in the frame {frame!r} is refused; {fix}")
    if not np.isfinite(pose).all():
        fix = "give finite numbers and a quaternion of unit length."
        raise ConfigError(f"{INITIAL_POSE}: a pose that is none is refused; {fix}")
    return pose
