"""Guesses by name what measured a pose: odometry, which drifts, or something that does not."""

import re
from collections.abc import Iterable

from nics_drl_bridge.recording import topic_roles as roles
from nics_drl_bridge.recording.recording import MeasuredBy

TRACKED = re.compile(
    r"vrpn|mocap|motion_?capture|optitrack|vicon|qualisys|phasespace|motive|ground_?truth|truth"
    r"|(^|[^a-z])gt([^a-z]|$)|slam|amcl|locali[sz]|(^|[^a-z])(pf|map|gps|rtk|gnss|utm|uwb)([^a-z]|$)"
    r"|aruco|april_?tag|tracker|tracked|(^|/)pf|particle_?filter",
    re.IGNORECASE,
)
ODOMETRY = re.compile(r"odom|wheel|encoder|dead_?reckon", re.IGNORECASE)
# Message types that odometry does not use, unless its name says so
TRACKERS_TYPES = (roles.POSE, roles.POSE_COVARIANCE, roles.TRANSFORM)


def guess_source_by_names(names: Iterable[str], kind: str) -> MeasuredBy:
    """Guesses what measured poses by all names that belong to them; empty if it is unclear."""
    names = [*names]
    if any(TRACKED.search(name) for name in names):
        return "tracker"
    if kind == roles.ODOMETRY or any(ODOMETRY.search(name) for name in names):
        return "odometry"
    if kind in TRACKERS_TYPES:
        return "tracker"
    return ""
